"""The backbones to choose from: ``--policy.backbone.type=…``, with the options of each beside it.

They are this package's own, which register themselves here, and every policy that LeRobot knows: its own,
those of plugins and this package's baselines. What a style policy asks of either is in `traits`.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import draccus
import lerobot.policies  # noqa: F401  (registers LeRobot's policies)
import numpy as np
from lerobot.configs import PreTrainedConfig

from lerobot_swr.object_poses import Names
from lerobot_swr.policies.backbones.backbone import Backbone

DEFAULT = "mlp"


@dataclass
class BackboneConfig(draccus.ChoiceRegistry):
    """Options of a backbone; one of this package's own registers itself with `register_subclass`.

    Policies are looked up when they are asked for, so those that a plugin registers later count, too.
    """

    # Whether many policies can be trained as one: the loss draws nothing at random, sees the observations of
    # `make` alone, and `torch.vmap` takes it.
    is_stackable: ClassVar[bool] = False

    @classmethod
    def get_known_choices(cls) -> dict[str, Any]:
        """Names and classes of all backbones' configurations."""
        policies = {
            name: policy
            for name, policy in PreTrainedConfig.get_known_choices().items()
            if not getattr(policy, "has_backbone", False)
        }
        return {**policies, **cls._choice_registry}

    @classmethod
    def get_choice_class(cls, name: str) -> Any:
        """The configuration's class.

        Raises:
            KeyError: If there is none.
        """
        return cls.get_known_choices()[name]

    @classmethod
    def get_choice_name(cls, subcls: type) -> str:
        """The name of a configuration's class.

        Raises:
            ValueError: If it is none of a backbone.
        """
        for name, known in cls.get_known_choices().items():
            if known is subcls:
                return name
        raise ValueError(f"Cannot find choice name for {subcls}")

    @classmethod
    def default_choice_name(cls) -> str:
        """The type where options are given without one."""
        return DEFAULT

    @property
    def type(self) -> str:
        """The name by which the backbone is chosen."""
        return self.get_choice_name(self.__class__)

    @property
    def looks_for_things(self) -> bool:
        """Whether it needs the names of the observations' dimensions."""
        return False

    def adopt(self, columns: Mapping[str, np.ndarray], lengths: np.ndarray, names: Names) -> None:
        """Fill in the options that the training dataset decides; none, by default.

        Args:
            columns: Feature name to raw (F, d), episodes one after the other.
            lengths: (N,) frames per episode.
            names: Of the features' dimensions.

        Raises:
            ValueError: If the dataset lacks what the options ask for.
        """

    def make_named(
        self, observations: Mapping[str, int], style_dim: int, action_dim: int, names: Names
    ) -> Backbone:
        """As `make`, for a backbone that also looks at the names of features' dimensions."""
        return self.make(observations, style_dim, action_dim)

    @abstractmethod
    def make(self, observations: Mapping[str, int], style_dim: int, action_dim: int) -> Backbone:
        """A new backbone.

        Args:
            observations: Names of the observations to their dimensions, in order.
            style_dim: Dimension of a style; 0 for a policy without styles.
            action_dim: A.
        """
