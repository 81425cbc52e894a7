"""Episodes as padded vectors that are never all written out, and the distances of given pairs."""

import numpy as np

from lerobot_swr.similarity.distances import Episodes

BLOCK_ELEMENTS = 4_000_000  # numbers written out at once: 16 MB
PIECE = 2048  # squares that are added in float32 before float64 takes over


class EpisodeVectors:
    """N episodes of states, each padded to the longest one's length by repeating its last state.

    Attributes:
        dimension: D, numbers of one padded episode.

    Args:
        frames: (F, d) float32 states, episodes one after the other.
        lengths: (N,) frames per episode.
    """

    def __init__(self, frames: np.ndarray, lengths: np.ndarray):
        longest = int(lengths.max())
        self.dimension = longest * frames.shape[1]
        if (lengths == longest).all():  # an episode is one contiguous piece of memory
            frames, lengths, longest = frames.reshape(len(lengths), -1), np.ones_like(lengths), 1
        self._frames, self._lengths, self._longest = frames, lengths, longest
        self._starts = lengths.cumsum() - lengths

    def __len__(self) -> int:
        """N."""
        return len(self._lengths)

    def padded(self, episodes: np.ndarray) -> np.ndarray:
        """(B, D) float32 vectors of the (B,) `episodes`."""
        return self._first(episodes, self._longest).reshape(len(episodes), -1)

    def _first(self, episodes: np.ndarray, count: int) -> np.ndarray:
        """(B, `count`, d) first frames of the (B,) `episodes`, padded."""
        last = self._lengths[episodes, None] - 1
        return self._frames.take(self._starts[episodes, None] + np.minimum(np.arange(count), last), axis=0)

    def distance(self, i: Episodes, j: Episodes) -> np.ndarray:
        """Distances of pairs of episodes; relative errors are below 1e-6, equal episodes have distance 0.

        Args:
            i: Episodes.
            j: Episodes, of the same shape, or broadcast to it.

        Returns:
            Float64 of that shape.
        """
        one = np.ndim(i) == 0
        if not one:
            i, j = np.broadcast_arrays(i, j)
        own, others = np.ravel(i), np.ravel(j)
        # Beyond the longer of the two episodes a pair differs by the same vector in every frame.
        longer = np.maximum(self._lengths[own], self._lengths[others])  # (P,)
        order = np.argsort(longer, kind="stable") if self._longest > 1 else np.arange(len(others))
        squared = np.empty(len(others))
        start = 0
        while start < len(order):
            stop = self._end_of_block(longer, order, start)
            pairs = order[start:stop]
            count = int(longer[pairs[-1]])
            apart = self._first(others[pairs], count)
            apart -= self._first(own if one else own[pairs], count)
            beyond = (self._longest - count) * _sum_of_squares(apart[:, -1])
            squared[pairs] = _sum_of_squares(apart.reshape(len(pairs), -1)) + beyond
            start = stop
        return np.sqrt(squared).reshape(np.shape(j))

    def _end_of_block(self, longer: np.ndarray, order: np.ndarray, start: int) -> int:
        """Where a block of pairs, sorted by length, ends that begins at `start`: at least one pair."""
        size = max(1, BLOCK_ELEMENTS // (int(longer[order[start]]) * self._frames.shape[1]))
        stop = min(start + size, len(order))
        while stop > start + 1 and longer[order[stop - 1]] > 2 * longer[order[start]]:
            stop = start + (stop - start) // 2
        return stop


def _sum_of_squares(rows: np.ndarray) -> np.ndarray:
    """(P,) float64 of (P, n) float32."""
    parts = (rows[:, k : k + PIECE] for k in range(0, rows.shape[1], PIECE))
    return sum((np.einsum("pn,pn->p", part, part).astype(np.float64) for part in parts), np.zeros(len(rows)))
