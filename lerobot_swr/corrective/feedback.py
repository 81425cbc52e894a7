"""The action beside a demonstration's path: the demonstrated one, corrected for the deviation, limited."""

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_swr.corrective.inverse_model import InverseModel
from lerobot_swr.corrective.paths import DemonstratedPaths
from lerobot_swr.corrective.relative_actions import relative_to_state
from lerobot_swr.trajectories import Trajectories


class Feedback:
    """a' = limit(a_u + J (x − s_u)), with u the matched frame of a demonstration.

    The limiter scales the whole action down until it lies in the demonstrations' symmetric range, ± the
    largest magnitude of each dimension. Clipping it to [min, max] instead would change its direction, and
    forbid to move backwards where nobody did. Targets are limited relative to the state.

    Args:
        trajectories: Episodes with ``observation.state`` and ``action``.
        model: Their inverse model.
    """

    def __init__(self, trajectories: Trajectories, model: InverseModel):
        self.paths = DemonstratedPaths(trajectories.columns[OBS_STATE], trajectories.lengths)
        self.actions = torch.from_numpy(trajectories.columns[ACTION])
        self.gain = torch.from_numpy(model.gain.astype(np.float32))  # (A, d)
        self.targets = torch.from_numpy(model.targets)
        self.corrected = (self.gain != 0).any(dim=1)  # (A,) bool
        self._has_targets = bool((self.targets >= 0).any())
        demonstrated = relative_to_state(self.actions, self.paths.states, self.targets)
        # (A,); above 0, so that an action dimension that is never used is limited to (almost) nothing
        self.limits = demonstrated.abs().amax(dim=0).clamp(min=torch.finfo(torch.float32).tiny)

    def to(self, device: torch.device) -> None:
        """Move everything to a device; nothing happens if it is there."""
        self.paths.to(device)
        if self.actions.device != device:
            for name in ("actions", "gain", "corrected", "targets", "limits"):
                setattr(self, name, getattr(self, name).to(device))

    def act(self, states: Tensor, matched: Tensor) -> Tensor:
        """(B, A) actions in raw units for states (B, d) whose matched frames are the (B,) rows `matched`."""
        corrected = self.actions[matched] + (states - self.paths.states[matched]) @ self.gain.T
        if not self._has_targets:
            return self.limit(corrected)
        relative = relative_to_state(corrected, states, self.targets)
        return corrected - relative + self.limit(relative)

    def limit(self, actions: Tensor) -> Tensor:
        """Scale each of the (B, A) actions, relative where they are targets, into the symmetric range.

        Dimensions that are not corrected neither ask for it nor take part.
        """
        excess = torch.where(self.corrected, actions.abs() / self.limits, 0).amax(dim=1)
        return torch.where(self.corrected, actions / excess.clamp(min=1)[:, None], actions)
