"""The action beside a demonstration's path: the demonstrated one, corrected for the deviation, limited."""

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_swr.corrective.inverse_model import InverseModel
from lerobot_swr.corrective.paths import DemonstratedPaths
from lerobot_swr.corrective.relative_actions import relative_to_state
from lerobot_swr.trajectories import Trajectories


class Feedback:
    """a' = limit(a_u + J (x − s_u)), with u the matched frame of a demonstration.

    The limiter scales the whole action down until it lies in the demonstrations' symmetric range, ± the
    largest magnitude of each dimension. Clipping it to [min, max] instead would change its direction, and
    forbid to move backwards where nobody did. Targets are limited relative to the state.

    Attributes:
        paths: Where the demonstrations went.
        actions: (F, A) what was done there.
        corrected: (A,) bool, the dimensions that are corrected.
        limits: (A,) largest demonstrated magnitudes.

    Args:
        trajectories: Episodes with ``observation.state`` and ``action``.
        model: Their inverse model.
    """

    def __init__(self, trajectories: Trajectories, model: InverseModel):
        self.paths = DemonstratedPaths(trajectories.columns[OBS_STATE], trajectories.lengths)
        self.actions = trajectories.columns[ACTION]
        self._gain = model.gain.astype(np.float32)  # (A, d)
        self._targets = model.targets
        self.corrected = (self._gain != 0).any(axis=1)
        self._has_targets = bool((model.targets >= 0).any())
        demonstrated = relative_to_state(self.actions, self.paths.states, model.targets)
        # Above 0, so that an action dimension that is never used is limited to (almost) nothing.
        self.limits = np.maximum(np.abs(demonstrated).max(axis=0), np.finfo(np.float32).tiny)

    def act(self, states: np.ndarray, matched: np.ndarray) -> np.ndarray:
        """(B, A) actions in raw units for states (B, d) whose matched frames are the (B,) rows `matched`."""
        corrected = self.actions[matched] + (states - self.paths.states[matched]) @ self._gain.T
        if not self._has_targets:
            return self.limit(corrected)
        relative = relative_to_state(corrected, states, self._targets)
        return corrected - relative + self.limit(relative)

    def limit(self, actions: np.ndarray) -> np.ndarray:
        """Scale each of the (B, A) actions, relative where they are targets, into the symmetric range.

        Dimensions that are not corrected neither ask for it nor take part.
        """
        excess = np.where(self.corrected, np.abs(actions) / self.limits, 0).max(axis=1, keepdims=True)
        return np.where(self.corrected, actions / np.maximum(excess, 1), actions)
