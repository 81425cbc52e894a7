"""What a style policy takes over from its backbone: inputs, windows, processors, optimizer, network."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.optim import LRSchedulerConfig, OptimizerConfig

from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.backbones.backbone import Backbone
from lerobot_swr.policies.vector_pipelines import Pipelines

if TYPE_CHECKING:
    from lerobot_swr.policies.configuration_swr import BCConfig


class Traits(ABC):
    """Answers for one kind of backbone what LeRobot and a style policy ask."""

    # Whether it sees pictures, or numbers alone.
    sees_images: bool = False
    # Whether it learns the present action from the present observation, one frame at a time.
    is_momentary: bool = True
    # Whether seeds can be trained as one.
    is_stackable: bool = False
    # Relative steps of observations, actions and rewards in a batch; None brings the present one alone.
    observation_delta_indices: list[int] | None = None
    action_delta_indices: list[int] | None = None
    reward_delta_indices: list[int] | None = None

    @abstractmethod
    def settle(self, config: "BCConfig") -> None:
        """Check the options of a style policy and fill in what the backbone says.

        Raises:
            ValueError: Naming the offending key and value.
        """

    def adopt(  # noqa: B027 (most have none)
        self, config: "BCConfig", columns: Mapping[str, np.ndarray], lengths: np.ndarray
    ) -> None:
        """Fill in options that the training dataset decides; none, by default.

        Args:
            config: The style policy's configuration.
            columns: Feature name to raw (F, d), episodes one after the other.
            lengths: (N,) frames per episode.

        Raises:
            ValueError: If the dataset lacks what the options ask for.
        """

    @abstractmethod
    def style_lr(self, config: "BCConfig") -> float:
        """Learning rate of the styles where none is given."""

    @abstractmethod
    def optimizer(self, config: "BCConfig") -> OptimizerConfig:
        """The optimizer."""

    @abstractmethod
    def scheduler(self, config: "BCConfig") -> LRSchedulerConfig | None:
        """The schedule of the learning rate, where the style policy's options name none."""

    @abstractmethod
    def processors(self, config: "BCConfig", stats: Statistics | None, meta: Any | None) -> Pipelines:
        """What prepares batches, and what brings the outputs back to actions."""

    @abstractmethod
    def make(
        self, config: "BCConfig", style_dim: int, stats: Statistics | None, meta: Any | None
    ) -> Backbone:
        """The network, on the features of the style policy; `style_dim` is 0 without styles."""
