"""Corrective labels: states beside a demonstration's path, with the action that leads back to it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from lerobot.utils.constants import OBS_STATE
from scipy.special import ndtri

from lerobot_swr.corrective.feedback import Feedback
from lerobot_swr.corrective.inverse_model import InverseModel
from lerobot_swr.corrective.paths import CANDIDATES
from lerobot_swr.trajectories import Trajectories

Kind = Literal["noise", "demos"]

SMALLEST_NOISE = 0.1  # in units of the largest


@dataclass(frozen=True)
class CorrectiveFrames:
    """Frames beside demonstrations.

    Attributes:
        episodes: (P,) the demonstrations, whose styles they teach.
        observations: Feature name to (P, d_k), raw: the state beside the path, and everything else as it was
            at the matched frame.
        actions: (P, A), raw.
    """

    episodes: np.ndarray
    observations: dict[str, np.ndarray]
    actions: np.ndarray


class CorrectiveLabels:
    """Draws states beside demonstrations' paths, with the actions that lead back.

    ``noise`` takes the state of a frame with Gaussian noise, whose standard deviation is log-uniform between
    a tenth of `scale` and `scale`; ``demos`` a state of another demonstration, near ones more often: c, the
    distance of its future, has the weight exp(−c / scale). Only ``observation.state`` differs from a
    demonstrated frame: it is what actions move.

    A pure function of uniform numbers that the caller draws. NumPy, and many frames at once: for so few
    numbers most of the time is the overhead of each operation.

    Args:
        trajectories: The dataset, with all observations that a policy sees.
        model: Its inverse model.
        kind: ``noise`` or ``demos``.
        scale: In units of each state dimension's range.
        observation_keys: Features that a policy sees.
    """

    def __init__(
        self,
        trajectories: Trajectories,
        model: InverseModel,
        kind: Kind,
        scale: float,
        observation_keys: list[str],
    ):
        self.kind, self.scale = kind, scale
        self.feedback = Feedback(trajectories, model)
        self._others = {k: trajectories.columns[k] for k in observation_keys if k != OBS_STATE}

    @property
    def draws_per_frame(self) -> int:
        """How many uniform numbers one frame takes."""
        if self.kind == "noise":
            return 2 + self.feedback.paths.states.shape[1]
        return 2 + 2 * CANDIDATES

    def draw(self, uniforms: np.ndarray, candidates: np.ndarray) -> CorrectiveFrames:
        """Draw frames of all candidates, every frame alike, and move beside them.

        Args:
            uniforms: (P, `draws_per_frame`) independent, uniform in [0, 1).
            candidates: (M,) sorted episodes whose frames may be used. With a single one there are no
                partners: ``demos`` then gives its own frames.
        """
        paths = self.feedback.paths
        ends = paths.lengths[candidates].cumsum()
        count = (uniforms[:, 0] * ends[-1]).astype(np.int64)
        place = np.searchsorted(ends, count, side="right")
        episodes = candidates[place]
        rows = paths.starts[episodes] + count - (ends[place] - paths.lengths[episodes])
        states, matched = self._beside(rows, episodes, uniforms[:, 1:], candidates)
        observations = {key: column[matched] for key, column in self._others.items()}
        return CorrectiveFrames(
            episodes, {OBS_STATE: states, **observations}, self.feedback.act(states, matched)
        )

    def _beside(
        self, rows: np.ndarray, episodes: np.ndarray, uniforms: np.ndarray, candidates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """States (P, d) beside the paths of frames, and the (P,) rows that they are matched with."""
        paths = self.feedback.paths
        if self.kind == "noise":
            scale = self.scale * SMALLEST_NOISE ** uniforms[:, :1]
            normal = ndtri(np.clip(uniforms[:, 1:], 1e-9, 1 - 1e-9))
            states = (paths.states[rows] + scale * normal * paths.range).astype(np.float32)
            return states, paths.nearest(states, rows)
        if len(candidates) < 2:
            return paths.states[rows], rows
        partners, around = paths.draw_partners(episodes, candidates, self.scale, uniforms)
        states = paths.states[partners]
        return states, paths.nearest(states, around)
