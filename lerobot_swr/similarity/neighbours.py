"""The farthest and the nearest of many episodes: bounded by sketches, measured by vectors."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from lerobot_swr.progress import Progress
from lerobot_swr.similarity.sketch import Sketch
from lerobot_swr.similarity.vectors import EpisodeVectors

BLOCK_NUMBERS = 2**24  # bounds held at once: 64 MB
FARTHEST = 64  # episodes that are measured to find the farthest, at most
SPARE = 4  # times k, episodes that are measured to find the k nearest, at most


@dataclass(frozen=True)
class Survey:
    """What was found among M candidates for R episodes.

    Attributes:
        farthest: (R,) float64, largest distance to a candidate.
        nearest: (R, k) int32, the nearest candidates other than itself, by growing distance, equal ones by
            their number.
        distances: (R, k) float32, their distances.
    """

    farthest: np.ndarray
    nearest: np.ndarray
    distances: np.ndarray


def survey(
    vectors: EpisodeVectors, sketch: Sketch, rows: np.ndarray, candidates: np.ndarray, k: int
) -> Survey:
    """Find the farthest and the k nearest candidates of every row.

    The sketches bound all R × M squared distances from below, in blocks. Those that these bounds do not rule
    out are measured. So the result is exact, unless more than `FARTHEST` (`SPARE` times k) candidates cannot
    be told apart by the bounds; then that many of the likeliest are measured, and what is missed is farther
    (nearer) by no more than the bounds' width at that place.

    Args:
        vectors: The episodes.
        sketch: Their sketch.
        rows: (R,) episodes.
        candidates: (M,) episodes, sorted.
        k: At most as many as every row has candidates other than itself.
    """
    workers = torch.get_num_threads()
    search = _Search(vectors, sketch, rows, candidates, k)
    size = max(workers, BLOCK_NUMBERS // len(candidates))
    with ThreadPoolExecutor(workers) as pool, torch.no_grad():
        for start in Progress(
            range(0, len(rows), size), "Comparing demonstrations", disable=len(rows) <= size
        ):
            stop = min(start + size, len(rows))
            lower = search.lower_bounds(start, stop)
            edges = np.linspace(0, len(lower), workers + 1).astype(int)
            parts = [lower[first:last] for first, last in pairwise(edges)]
            list(pool.map(search.measure, (start + edges[:-1]).tolist(), parts))
    return Survey(search.farthest, search.nearest, search.distances)


class _Search:
    """The state of a survey."""

    def __init__(
        self, vectors: EpisodeVectors, sketch: Sketch, rows: np.ndarray, candidates: np.ndarray, k: int
    ):
        self._vectors, self._rows, self._candidates, self._k = vectors, rows, candidates, k
        self._left, right = sketch.bounds(torch.from_numpy(rows), torch.from_numpy(candidates))
        self._right = right.T
        norms, residuals = sketch.norms.numpy(), sketch.residuals.numpy()
        # The bounds' width is 4 r_i r_j + 2 c (n_i + n_j).
        self._rounding = 2 * sketch.rounding
        self._norms, self._residuals = norms[rows], 4 * residuals[rows]
        self._their_norms, self._their_residuals = norms[candidates], residuals[candidates]
        self.farthest = np.zeros(len(rows))
        self.nearest = np.zeros((len(rows), k), dtype=np.int32)
        self.distances = np.zeros((len(rows), k), dtype=np.float32)

    def lower_bounds(self, start: int, stop: int) -> np.ndarray:
        """(stop − start, M) lower bounds of squared distances."""
        return (self._left[start:stop] @ self._right).numpy()

    def measure(self, first: int, lower: np.ndarray) -> None:
        """Fill in what is looked for of rows from the `first` on, whose (B, M) lower bounds are used up."""
        widest = self._their_residuals.max(), self._their_norms.max()
        for row, bounds in enumerate(lower, first):
            episode = int(self._rows[row])
            width = self._residuals[row] * widest[0] + self._rounding * (self._norms[row] + widest[1])
            far = np.flatnonzero(bounds >= bounds.max() - width)
            far = _smallest(far, -bounds[far], FARTHEST)
            self.farthest[row] = self._vectors.distance(episode, self._candidates[far]).max()
            if self._k:
                self._measure_nearest(row, episode, bounds)

    def _measure_nearest(self, row: int, episode: int, bounds: np.ndarray) -> None:
        place = int(np.searchsorted(self._candidates, episode))
        if place < len(bounds) and self._candidates[place] == episode:
            bounds[place] = np.inf
        first = np.flatnonzero(bounds <= np.partition(bounds, self._k - 1)[self._k - 1])
        width = self._residuals[row] * self._their_residuals[first]
        width += self._rounding * (self._norms[row] + self._their_norms[first])
        # Nothing beyond the largest upper bound of these is nearer than all of them.
        near = np.flatnonzero(bounds <= (bounds[first] + width).max())
        episodes = self._candidates[_smallest(near, bounds[near], SPARE * self._k)]
        apart = self._vectors.distance(episode, episodes).astype(np.float32)
        order = np.lexsort((episodes, apart))[: self._k]
        self.nearest[row], self.distances[row] = episodes[order], apart[order]


def _smallest(places: np.ndarray, keys: np.ndarray, count: int) -> np.ndarray:
    """The places of the `count` smallest keys."""
    return places if len(places) <= count else places[np.argpartition(keys, count)[:count]]
