"""Where on a demonstration is a state, and which frames of other demonstrations lie near it?"""

import numpy as np
import torch
from torch import Tensor

# As shares of the mean episode length, so that they do not depend on the control rate. In the medium maze
# (76 steps) they are the 15 and 25 steps with which the method was found.
WINDOW = 0.2  # how far from where it was expected a frame is looked for
LOOKAHEAD = 0.33  # over how much of its future a partner frame is compared

PHASE_WINDOW = 0.25  # frames are matched where their episodes have progressed alike, within this share
GRID = 32  # evenly spread frames of a demonstration that stand for it in coarse comparisons
FUTURE = 5  # frames that stand for a partner frame's future
CANDIDATES = 16  # partner frames that are drawn uniformly, of which one is chosen by its cost


class DemonstratedPaths:
    """The states of all demonstrations, with their distances.

    A distance is the root mean square over the state's dimensions, each in units of its range; dimensions
    that never change do not count.

    Attributes:
        states: (F, d), raw.
        range: (d,) of each dimension.
        episode: (F,) episode of each frame.
        phase: (F,) progress of each frame in its episode, 0 to 1.
        window: How far from where it is expected a frame is looked for, in frames.

    Args:
        states: (F, d) float32, episodes one after the other, in raw units.
        lengths: (N,) frames per episode.
    """

    def __init__(self, states: np.ndarray, lengths: np.ndarray):
        self.states = torch.from_numpy(states)
        self.range = torch.from_numpy(np.ptp(states, axis=0))  # (d,)
        moving = self.range > 0
        count = max(int(moving.sum()), 1)
        self.metric = torch.where(moving, 1 / self.range, 0.0) / count**0.5  # (d,)
        self._scaled = self.states * self.metric  # Euclidean distances of these are the distances
        self.lengths = torch.from_numpy(lengths)
        self.starts = self.lengths.cumsum(0) - self.lengths
        self.episode = torch.arange(len(lengths)).repeat_interleave(self.lengths)  # (F,)
        self.last = (self.starts + self.lengths - 1)[self.episode]  # (F,) last frame of a frame's episode
        progress = torch.arange(len(states)) - self.starts[self.episode]
        self.phase = progress / (self.lengths[self.episode] - 1).clamp(min=1)  # (F,) from 0 to 1
        share = torch.linspace(0, 1, GRID)
        # (N, GRID) rows evenly spread over every episode
        self._grid = self.starts[:, None] + (share * (self.lengths[:, None] - 1)).round().long()
        self.window = max(1, round(WINDOW * float(lengths.mean())))
        future = torch.linspace(0, LOOKAHEAD * float(lengths.mean()), FUTURE)
        self._future = future.round().long()

    def to(self, device: torch.device) -> None:
        """Move everything to a device; nothing happens if it is there."""
        if self.states.device != device:
            for name, value in vars(self).items():
                if isinstance(value, Tensor):
                    setattr(self, name, value.to(device))

    def nearest(self, states: Tensor, around: Tensor) -> Tensor:
        """The frame of a demonstration that is nearest to a state, near a frame where it is expected.

        Args:
            states: (B, d), raw.
            around: (B,) rows of expected frames; the window is cut at the ends of their episodes.

        Returns:
            (B,) rows.
        """
        offsets = torch.arange(-self.window, self.window + 1, device=states.device)
        return self._nearest_among(states, self._inside(around[:, None] + offsets, self.episode[around]))

    def nearest_of_episode(self, states: Tensor, episodes: Tensor) -> Tensor:
        """The nearest frame of the whole episode: (B,) rows for states (B, d) and (B,) episodes."""
        offsets = torch.arange(int(self.lengths[episodes].max()), device=states.device)
        rows = self.starts[episodes][:, None] + offsets
        return self._nearest_among(states, self._inside(rows, episodes))

    def _inside(self, rows: Tensor, episodes: Tensor) -> Tensor:
        """Rows (B, ...) moved into their episodes (B,)."""
        shape = (-1, *[1] * (rows.dim() - 1))
        first = self.starts[episodes].view(shape)
        return torch.clamp(rows, first, first + self.lengths[episodes].view(shape) - 1)

    def _nearest_among(self, states: Tensor, rows: Tensor) -> Tensor:
        scaled = (states * self.metric)[:, None]
        place = (self._scaled[rows] - scaled).square().sum(dim=-1).argmin(dim=1)
        return rows.gather(1, place[:, None]).squeeze(1)

    # --- Partner frames ---

    def draw_partners(
        self, episodes: Tensor, candidates: Tensor, bandwidth: float, uniforms: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Draw frames of other demonstrations that lie near given ones.

        `CANDIDATES` frames are drawn uniformly over the other episodes, and one of them by its share in
        exp(−c / bandwidth), where c is the mean distance of its next frames to the demonstration. For many
        candidates that is a draw from all frames; the work per frame does not grow with the dataset.

        Args:
            episodes: (B,) demonstrations j, all of them candidates.
            candidates: (M,) sorted episodes that may be drawn, M >= 2.
            bandwidth: In units of distances.
            uniforms: (B, 2 `CANDIDATES` + 1) uniform in [0, 1).

        Returns:
            (B,) rows of the partner frames, and (B,) rows of demonstration j near them.
        """
        others = len(candidates) - 1
        place = (uniforms[:, :CANDIDATES] * others).long().clamp(max=others - 1)
        place += place >= torch.searchsorted(candidates, episodes)[:, None]  # skips the frame's own episode
        partners = candidates[place]  # (B, C)
        progress = uniforms[:, CANDIDATES : 2 * CANDIDATES] * self.lengths[partners]
        rows = self.starts[partners] + torch.minimum(progress.long(), self.lengths[partners] - 1)
        grid = self._grid[episodes]  # (B, GRID)
        cumulative = (-self._costs(rows, grid) / bandwidth).softmax(dim=1).double().cumsum(dim=1)
        threshold = uniforms[:, -1:].double() * cumulative[:, -1:]
        chosen = torch.searchsorted(cumulative, threshold, right=True).clamp(max=CANDIDATES - 1)
        partner = rows.gather(1, chosen).squeeze(1)
        return partner, self._expected(partner, grid)

    def _costs(self, rows: Tensor, grid: Tensor) -> Tensor:
        """(B, C) mean distance of the next frames of (B, C) rows to the nearest of (B, GRID) rows."""
        ahead = torch.minimum(rows[..., None] + self._future, self.last[rows][..., None])  # (B, C, FUTURE)
        x, y = self._scaled[ahead.flatten(1)], self._scaled[grid]
        # |y|² − 2 x·y, to which |x|² is added after the minimum; float32 is exact enough for a coarse cost.
        squared = torch.baddbmm(y.square().sum(dim=-1)[:, None], x, y.transpose(1, 2), alpha=-2).amin(dim=-1)
        squared += x.square().sum(dim=-1)
        return squared.clamp(min=0).sqrt().view(ahead.shape).mean(dim=-1)

    def _expected(self, rows: Tensor, grid: Tensor) -> Tensor:
        """(B,) where frames (B,) are expected on other demonstrations, among (B, GRID) rows of these.

        The nearest one that has progressed alike: a path that passes a place twice is not mixed up.
        """
        squared = (self._scaled[rows][:, None] - self._scaled[grid]).square().sum(dim=-1)
        apart = (self.phase[rows][:, None] - self.phase[grid]).abs() > PHASE_WINDOW
        place = squared.masked_fill(apart, torch.inf).argmin(dim=1, keepdim=True)
        return grid.gather(1, place).squeeze(1)
