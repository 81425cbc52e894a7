"""The contract between a style policy and what it learns actions with."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION
from torch import Tensor, nn


class Backbone(nn.Module, ABC):
    """π_θ(a | s, z): learns and predicts actions for observations and a style.

    Where styles come from, whose style a frame teaches and how much the frame counts is decided before: a
    backbone uses the styles and weights that it is given. It passes the loss's gradient on to the styles.

    Attributes:
        numbers: What it logs of the last loss beside it.
    """

    def __init__(self) -> None:
        super().__init__()
        self.numbers: dict[str, float] = {}

    def fit(self, columns: Mapping[str, np.ndarray], normalize: Callable[[dict], dict]) -> None:
        """Take what is needed of the training dataset before training begins; nothing, by default.

        Args:
            columns: Feature name to raw (F, d).
            normalize: Normalises such features, given as tensors.
        """

    @property
    def units(self) -> dict[str, Tensor]:
        """Those of its buffers, by name, that say how the dataset at hand is normalised."""
        return {}

    @abstractmethod
    def loss(
        self, batch: dict[str, Tensor], style: Tensor | None, weight: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Training loss of a batch; a pure function of it and of the parameters.

        Args:
            batch: Normalised observations (B, ...) and ``action`` (B, ...).
            style: (B, style_dim); None for a policy without styles.
            weight: (B,) factor of each frame's loss.

        Returns:
            The mean weighted loss, and each frame's weighted loss (B,), None if they are not known singly.
        """

    def frame_losses(self, batch: dict[str, Tensor], style: Tensor | None, weight: Tensor) -> Tensor | None:
        """(B,) each frame's weighted loss, at whatever cost; None if they cannot be known."""
        return self.loss(batch, style, weight)[1]

    @abstractmethod
    def predict_action_chunk(self, batch: dict[str, Tensor], style: Tensor | None) -> Tensor:
        """(B, K, A) normalised actions, now and next, for normalised observations (B, ...).

        A backbone whose policy has further options of acting (noise, the rest of the last chunk) takes them
        as keywords.
        """

    def select_action(self, batch: dict[str, Tensor], style: Tensor | None) -> Tensor:
        """(B, A) normalised actions to take now; a backbone that executes chunks overrides it.

        The style is that of the rollout under way. Where another one comes in the middle of a chunk, it takes
        effect at the next.
        """
        return self.predict_action_chunk(batch, style)[:, 0]

    def param_groups(self) -> list[dict[str, Any]] | dict[str, nn.Parameter]:
        """Parameters for the optimizer: groups with options of their own where they need some, or by name."""
        return [{"params": list(self.parameters())}]

    def reset(self) -> None:
        """Start a rollout: forget what was planned."""

    def update(self) -> None:
        """What is to be done after each step of the optimizer."""

    def peft_targets(self) -> dict[str, Any] | None:
        """Which modules adapters (PEFT) are put on by default, by their names in the style policy."""
        return None

    def supports_rtc(self) -> bool:
        """Whether `predict_action_chunk` takes the options of LeRobot's real-time chunking."""
        return False

    def init_rtc_processor(self, options: Any) -> None:
        """Set real-time chunking up, where it is supported, with LeRobot's options of it."""


def weighted_mean(losses: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """What `Backbone.loss` returns, of (B,) losses and weights."""
    weighted = losses * weight
    return weighted.mean(), weighted


def squared_errors(predicted: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """(B,) squared error of (B, A) actions, mean over the action's dimensions.

    Raises:
        ValueError: If the batch's actions have another shape than those that are predicted, which would be
            broadcast to each other.
    """
    check_same_shape(predicted, batch[ACTION])
    return (predicted - batch[ACTION]).square().mean(dim=-1)


def check_same_shape(predicted: Tensor, actions: Tensor) -> None:
    """Refuse to compare tensors that would be broadcast.

    Raises:
        ValueError: Naming both shapes.
    """
    if predicted.shape != actions.shape:
        raise ValueError(
            f"the batch's actions have shape {list(actions.shape)}, those predicted {list(predicted.shape)}: "
            "let the policy's preprocessor prepare the batch (make_pre_post_processors)"
        )
