"""Where on a demonstration is a state, and which frames of other demonstrations lie near it?"""

import numpy as np

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
        states: (F, d) float32, raw.
        range: (d,) of each dimension.
        lengths: (N,) frames per episode.
        starts: (N,) row at which each episode starts.
        episode: (F,) episode of each frame.
        phase: (F,) progress of each frame in its episode, 0 to 1.
        window: How far from where it is expected a frame is looked for, in frames.

    Args:
        states: (F, d) float32, episodes one after the other, in raw units.
        lengths: (N,) frames per episode.
    """

    def __init__(self, states: np.ndarray, lengths: np.ndarray):
        self.states, self.lengths = states, lengths
        self.range = np.ptp(states, axis=0)
        moving = self.range > 0
        metric = np.divide(1, self.range, out=np.zeros_like(self.range), where=moving)
        self._metric = (metric / max(int(moving.sum()), 1) ** 0.5).astype(np.float32)  # (d,)
        self._scaled = states * self._metric  # Euclidean distances of these are the distances
        self.starts = lengths.cumsum() - lengths
        self._last = self.starts + lengths - 1  # (N,) last row of each episode
        self.episode = np.repeat(np.arange(len(lengths)), lengths)
        progress = np.arange(len(states)) - self.starts[self.episode]
        self.phase = (progress / np.maximum(lengths[self.episode] - 1, 1)).astype(np.float32)
        share = np.linspace(0, 1, GRID)
        # (N, GRID) rows evenly spread over every episode
        self._grid = self.starts[:, None] + np.rint(share * (lengths[:, None] - 1)).astype(np.int64)
        self.window = max(1, round(WINDOW * float(lengths.mean())))
        self._offsets = np.arange(-self.window, self.window + 1)
        self.future = np.rint(np.linspace(0, LOOKAHEAD * float(lengths.mean()), FUTURE)).astype(np.int64)

    def nearest(self, states: np.ndarray, around: np.ndarray) -> np.ndarray:
        """The frame of a demonstration that is nearest to a state, near a frame where it is expected.

        Args:
            states: (B, d), raw.
            around: (B,) rows of expected frames; the window is cut at the ends of their episodes.

        Returns:
            (B,) rows.
        """
        return self._nearest_among(states, around[:, None] + self._offsets, self.episode[around])

    def nearest_of_episode(self, states: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        """The nearest frame of the whole episode: (B,) rows for states (B, d) and (B,) episodes."""
        rows = self.starts[episodes][:, None] + np.arange(self.lengths[episodes].max())
        return self._nearest_among(states, rows, episodes)

    def _nearest_among(self, states: np.ndarray, rows: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        """The nearest of (B, W) rows, after these have been moved into their (B,) episodes."""
        rows = np.clip(rows, self.starts[episodes][:, None], self._last[episodes][:, None])
        apart = self._scaled.take(rows, axis=0) - (states * self._metric)[:, None]
        return rows[np.arange(len(rows)), np.einsum("bwd,bwd->bw", apart, apart).argmin(axis=1)]

    # --- Partner frames ---

    def draw_partners(
        self, rows: np.ndarray, candidates: np.ndarray, bandwidth: float, uniforms: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw frames of other demonstrations that lie near those of given frames.

        `CANDIDATES` frames are drawn uniformly over the other episodes, where these have progressed like the
        given frame, within `PHASE_WINDOW`. One of them is chosen by its share in exp(−c / bandwidth), where c
        is the mean distance of its next frames to the demonstration, or none by a share of 1, that of a frame
        at no distance. The work per frame does not grow with the dataset.

        Args:
            rows: (B,) frames of demonstrations j, all of them candidates.
            candidates: (M,) sorted episodes that may be drawn, M >= 2.
            bandwidth: In units of distances.
            uniforms: (B, 2 `CANDIDATES` + 1) uniform in [0, 1).

        Returns:
            (B,) rows of the partner frames, (B,) rows of demonstration j near them, and (B,) False where no
            partner was chosen.
        """
        episodes, phase = self.episode[rows], self.phase[rows][:, None]
        place = (uniforms[:, :CANDIDATES] * (len(candidates) - 1)).astype(np.int64)
        place += place >= np.searchsorted(candidates, episodes)[:, None]  # skips the frame's own episode
        partners = candidates[place]  # (B, C)
        low, high = np.maximum(phase - PHASE_WINDOW, 0), np.minimum(phase + PHASE_WINDOW, 1)
        progress = low + uniforms[:, CANDIDATES : 2 * CANDIDATES] * (high - low)
        found = self.starts[partners] + (progress * self.lengths[partners]).astype(np.int64)
        grid = self._grid[episodes]  # (B, GRID)
        cost = self._costs(found, partners, grid)
        cumulative = np.exp(-cost / bandwidth).cumsum(axis=1)
        chosen = (cumulative <= uniforms[:, -1:] * (cumulative[:, -1:] + 1)).sum(axis=1)
        partner = found[np.arange(len(found)), np.minimum(chosen, CANDIDATES - 1)]
        return partner, self._expected(partner, grid), chosen < CANDIDATES

    def _costs(self, rows: np.ndarray, episodes: np.ndarray, grid: np.ndarray) -> np.ndarray:
        """(B, C) mean distance of the next frames of rows (B, C) to the nearest of (B, GRID) rows."""
        ahead = np.minimum(rows[..., None] + self.future, self._last[episodes][..., None])  # (B, C, FUTURE)
        x, y = (self._scaled.take(some, axis=0) for some in (ahead.reshape(len(rows), -1), grid))
        # |x − y|² = |x|² − 2 (x·y − |y|²/2), the bracket being one product of vectors of a dimension more;
        # float32 is exact enough for a coarse cost.
        y = np.concatenate([y, np.einsum("bgd,bgd->bg", y, y)[..., None] / -2], axis=2)
        longer = np.concatenate([x, np.ones_like(x[..., :1])], axis=2)
        product = y @ longer.swapaxes(1, 2)  # (B, GRID, C FUTURE)
        squared = np.einsum("bcd,bcd->bc", x, x) - 2 * product.max(axis=1)
        return np.sqrt(np.maximum(squared, 0)).reshape(ahead.shape).mean(axis=-1, dtype=np.float64)

    def _expected(self, rows: np.ndarray, grid: np.ndarray) -> np.ndarray:
        """(B,) where frames (B,) are expected on other demonstrations, among (B, GRID) rows of these.

        The nearest one that has progressed alike: a path that passes a place twice is not mixed up.
        """
        apart = self._scaled.take(grid, axis=0) - self._scaled[rows][:, None]
        squared = np.einsum("bgd,bgd->bg", apart, apart)
        squared[np.abs(self.phase.take(grid) - self.phase[rows][:, None]) > PHASE_WINDOW] = np.inf
        return grid[np.arange(len(grid)), squared.argmin(axis=1)]
