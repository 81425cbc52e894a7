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
        borrowed: (P,) bool, whether the state is another demonstration's.
    """

    episodes: np.ndarray
    observations: dict[str, np.ndarray]
    actions: np.ndarray
    borrowed: np.ndarray


class CorrectiveLabels:
    """Draws states beside demonstrations' paths, with the actions that lead back.

    ``noise`` takes the state of a frame with Gaussian noise, whose standard deviation is log-uniform between
    a tenth of `scale` and `scale`; ``demos`` a state of another demonstration, one of a few drawn at random:
    c, the distance of its future, has the weight exp(−c / scale), and none of them, but noise, the weight 1.
    Only ``observation.state`` differs from a demonstrated frame: it is what actions move. Where more than two
    of its dimensions change, d, `scale` is multiplied by √(2 / d): noise then leads as far from the path
    whatever d is.

    A pure function of uniform numbers that the caller draws. NumPy, and many frames at once: for so few
    numbers most of the time is the overhead of each operation.

    Args:
        trajectories: The dataset, with all observations that a policy sees.
        model: Its inverse model.
        kind: ``noise`` or ``demos``.
        scale: In units of each state dimension's range, for a state of two dimensions.
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
        self.kind = kind
        self.feedback = Feedback(trajectories, model)
        dimensions = int((self.feedback.paths.range > 0).sum())
        self.scale = scale * min(1.0, (2 / max(dimensions, 1)) ** 0.5)
        self._others = {k: trajectories.columns[k] for k in observation_keys if k != OBS_STATE}

    @property
    def draws_per_frame(self) -> int:
        """How many uniform numbers one frame takes."""
        partners = 2 * CANDIDATES + 1 if self.kind == "demos" else 0
        return 2 + self.feedback.paths.states.shape[1] + partners

    def draw(self, uniforms: np.ndarray, candidates: np.ndarray) -> CorrectiveFrames:
        """Draw frames of all candidates, every frame alike, and move beside them.

        Args:
            uniforms: (P, `draws_per_frame`) independent, uniform in [0, 1).
            candidates: (M,) sorted episodes whose frames may be used. With a single one there are no
                partners: ``demos`` is then ``noise``.
        """
        paths = self.feedback.paths
        ends = paths.lengths[candidates].cumsum()
        count = (uniforms[:, 0] * ends[-1]).astype(np.int64)
        place = np.searchsorted(ends, count, side="right")
        episodes = candidates[place]
        rows = paths.starts[episodes] + count - (ends[place] - paths.lengths[episodes])
        states, matched, borrowed = self._beside(rows, uniforms[:, 1:], candidates)
        observations = {key: column[matched] for key, column in self._others.items()}
        actions = self.feedback.act(states, matched)
        return CorrectiveFrames(episodes, {OBS_STATE: states, **observations}, actions, borrowed)

    def _beside(
        self, rows: np.ndarray, uniforms: np.ndarray, candidates: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(P, d) states beside the paths of frames, (P,) rows they match, (P,) whether others lent them."""
        paths, d = self.feedback.paths, self.feedback.paths.states.shape[1]
        scale = self.scale * SMALLEST_NOISE ** uniforms[:, :1]
        normal = ndtri(np.clip(uniforms[:, 1 : 1 + d], 1e-9, 1 - 1e-9))
        states = (paths.states[rows] + scale * normal * paths.range).astype(np.float32)
        borrowed = np.zeros(len(rows), dtype=bool)
        if self.kind == "demos" and len(candidates) > 1:
            numbers = uniforms[:, 1 + d :]
            partners, around, borrowed = paths.draw_partners(rows, candidates, self.scale, numbers)
            states = np.where(borrowed[:, None], paths.states[partners], states)
            rows = np.where(borrowed, around, rows)
        return states, paths.nearest(states, rows), borrowed
