"""Swapping z against swapping the observation: which of the two does a style policy obey?"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.utils.constants import OBS_PREFIX
from torch import Tensor


@dataclass(frozen=True)
class SwappedActions:
    """How far normalised actions move, root mean square over a batch.

    Attributes:
        style: When each frame gets the style of another one's episode.
        observation: When each style gets the observation of another frame.
    """

    style: float
    observation: float


@torch.no_grad()
def swapped_actions(policy: Any, batch: Mapping[str, Any], seed: int = 0) -> SwappedActions:
    """Predict a batch's actions as it is, with styles of other frames, and with observations of other frames.

    Args:
        policy: A style policy, in evaluation mode.
        batch: Frames as the preprocessor gives them, with ``episode_index`` (B,).
        seed: Of the order in which they are swapped.

    Raises:
        ValueError: If the policy has no styles.
    """
    if not hasattr(policy, "styles"):
        raise ValueError(f"a {policy.config.type!r} policy has no styles to swap")
    styles = policy.styles(batch["episode_index"])
    order = torch.randperm(len(styles), generator=torch.Generator().manual_seed(seed)).to(styles.device)
    others = {
        key: value[order] if key.startswith(OBS_PREFIX) and isinstance(value, Tensor) else value
        for key, value in batch.items()
    }
    actions = policy.predict(dict(batch), styles)

    def moved(swapped: Tensor) -> float:
        return float((swapped - actions).square().mean().sqrt())

    policy.reset()
    result = SwappedActions(
        moved(policy.predict(dict(batch), styles[order])), moved(policy.predict(others, styles))
    )
    policy.reset()
    return result
