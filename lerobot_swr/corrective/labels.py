"""Corrective labels: states beside a demonstration's path, with the action that leads back to it."""

from dataclasses import dataclass
from typing import Literal

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_swr.corrective.feedback import Feedback
from lerobot_swr.corrective.inverse_model import InverseModel
from lerobot_swr.corrective.paths import CANDIDATES
from lerobot_swr.trajectories import Trajectories

Kind = Literal["noise", "demos"]

SHARE = 0.5  # of the frames are replaced; the others stay as they were demonstrated
SMALLEST_NOISE = 0.1  # in units of the largest
CHUNK = 2048  # frames relabelled at once; bounds memory


@dataclass(frozen=True)
class Relabelled:
    """What takes the place of some frames of a batch.

    Attributes:
        places: (P,) which frames of the batch.
        observations: Feature name to (P, d_k), raw: the state beside the path, and everything else as it was
            at the matched frame.
        actions: (P, A), raw.
    """

    places: Tensor
    observations: dict[str, Tensor]
    actions: Tensor


class CorrectiveLabels:
    """Replaces half of the frames by states beside their demonstration's path.

    ``noise`` takes the frame's own state with Gaussian noise, whose standard deviation is log-uniform between
    a tenth of `scale` and `scale`; ``demos`` a state of another demonstration, near ones more often: c, the
    distance of its future, has the weight exp(−c / scale). Only ``observation.state`` is replaced: it is what
    actions move.

    A pure function of the frames and of uniform numbers that the caller draws, for any number of frames.

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
        self._others = {
            k: torch.from_numpy(trajectories.columns[k]) for k in observation_keys if k != OBS_STATE
        }

    @property
    def draws_per_frame(self) -> int:
        """How many uniform numbers one frame takes."""
        if self.kind == "noise":
            return 2 + self.feedback.paths.states.shape[1]
        return 2 + 2 * CANDIDATES

    def to(self, device: torch.device) -> None:
        """Move everything to a device; nothing happens if it is there."""
        self.feedback.to(device)
        self._others = {key: column.to(device) for key, column in self._others.items()}

    def relabel(self, rows: Tensor, uniforms: Tensor, candidates: Tensor) -> Relabelled:
        """Relabel about half of the frames of a batch.

        Args:
            rows: (B,) frames of the dataset (LeRobot's ``index``).
            uniforms: (B, `draws_per_frame`) independent, uniform in [0, 1).
            candidates: (M,) sorted episodes whose frames may be used, those of `rows` among them. A single
                one has no partners: ``demos`` then replaces nothing.
        """
        places = (uniforms[:, 0] < SHARE).nonzero().squeeze(1)
        if self.kind == "demos" and len(candidates) < 2:
            places = places[:0]
        parts = [
            self._states(rows[some], uniforms[some, 1:], candidates)
            for some in (places.split(CHUNK) if len(places) > CHUNK else [places])
        ]
        states, matched = (torch.cat(part) for part in zip(*parts, strict=True))
        observations = {key: column[matched] for key, column in self._others.items()}
        actions = self.feedback.act(states, matched)
        return Relabelled(places, {OBS_STATE: states, **observations}, actions)

    def _states(self, rows: Tensor, uniforms: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
        """States (P, d) beside the paths of frames, and the (P,) rows that they are matched with."""
        paths = self.feedback.paths
        if self.kind == "noise":
            scale = self.scale * SMALLEST_NOISE ** uniforms[:, :1]
            normal = torch.special.ndtri(uniforms[:, 1:].double().clamp(1e-9, 1 - 1e-9))
            states = paths.states[rows] + (scale * normal).float() * paths.range
            return states, paths.nearest(states, rows)
        partners, around = paths.draw_partners(paths.episode[rows], candidates, self.scale, uniforms)
        states = paths.states[partners]
        return states, paths.nearest(states, around)
