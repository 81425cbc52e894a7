"""Playback with feedback: the baseline without a network.

It plays a demonstration back and corrects deviations as corrective labels do: the action at the nearest frame
of the chosen demonstration, plus J times the distance to it. What a policy with corrective labels gains over
it is that it needs no demonstrations when it acts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from lerobot_swr.corrective.feedback import Feedback
from lerobot_swr.corrective.inverse_model import fit_inverse_model
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.drawing import StyleSampling
from lerobot_swr.trajectories import Trajectories


@dataclass(frozen=True)
class PlaybackConfig:
    """What evaluations read of a policy's configuration.

    Attributes:
        style_sampling: How demonstrations are drawn.
        type: Name of the baseline.
        device: Where it computes.
    """

    style_sampling: StyleSampling
    type: str = "playback"
    device: str = "cpu"


class PlaybackPolicy(nn.Module):
    """Plays one demonstration per rollout back, with feedback; all in raw units.

    Attributes:
        config: See `PlaybackConfig`.
        styles: Draws the demonstrations; the styles themselves are empty.
        feedback: The demonstrations that are played and their inverse model.

    Args:
        trajectories: The demonstrations.
        style_sampling: How they are drawn, as a policy draws its styles.
        episodes: Only these are known and played; None takes all.

    Raises:
        ValueError: If no inverse model fits them, see `fit_inverse_model`.
    """

    def __init__(
        self,
        trajectories: Trajectories,
        style_sampling: StyleSampling = "uniform",
        episodes: Sequence[int] | None = None,
    ):
        super().__init__()
        self.config = PlaybackConfig(style_sampling)
        played = sorted(range(len(trajectories)) if episodes is None else episodes)
        known = trajectories.subset(played)
        self.feedback = Feedback(known, fit_inverse_model(known))
        self._place = np.full(len(trajectories), -1)  # (N,) of an episode among those that are played
        self._place[played] = np.arange(len(played))
        self.styles = StyleCookbook(len(trajectories), 0, 0.0, style_sampling)
        self.styles.trained[played] = 1
        self._matched: np.ndarray | None = None

    def reset(self) -> None:
        """Start a rollout: the next action draws one demonstration per environment."""
        self.styles.end_rollout()
        self._matched = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) raw actions for raw observations (B, d).

        The frame is looked for in the whole demonstration at first, then near the last one.
        """
        given = batch[OBS_STATE]
        states = given.cpu().numpy().astype(np.float32)
        self.styles.active_styles(len(states))
        assert self.styles.active is not None
        paths = self.feedback.paths
        if self._matched is None:
            played = self._place[self.styles.active.cpu().numpy()]
            self._matched = paths.nearest_of_episode(states, played)
        else:
            self._matched = paths.nearest(states, self._matched)
        return torch.from_numpy(self.feedback.act(states, self._matched)).to(given.device)


def playback_checkpoint(
    trajectories: Trajectories,
    style_sampling: StyleSampling = "uniform",
    episodes: Sequence[int] | None = None,
) -> Checkpoint:
    """The baseline in the place of a trained policy; observations and actions stay as they are."""
    policy = PlaybackPolicy(trajectories, style_sampling, episodes)
    return Checkpoint(policy, lambda batch: batch, lambda action: action)
