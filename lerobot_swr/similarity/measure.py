"""Who is how similar to whom: the questions, and what answers them for few and for many episodes."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from lerobot_swr.similarity.cache import cached_survey
from lerobot_swr.similarity.distances import (
    Episodes,
    Normalization,
    check_normalization,
    dissimilarities,
    pairwise_distances,
)
from lerobot_swr.similarity.manner import Manner
from lerobot_swr.similarity.neighbours import Survey, survey
from lerobot_swr.similarity.sketch import Sketch, make_sketch
from lerobot_swr.similarity.vectors import EpisodeVectors
from lerobot_swr.trajectories import Trajectories

DENSE_UP_TO = 4096  # episodes whose distances are all computed and held: 134 MB
SURVEYED = 256  # nearest others that one pass over a large dataset finds, also for who asks for fewer
BLOCK_NUMBERS = 2**24  # numbers of a part of the matrix that are sorted at once


class Similarity(Protocol):
    """Distances of N demonstrations: those of states padded to the longest one by repeating the last state.

    No caller ever asks for all pairs.
    """

    def __len__(self) -> int:
        """N."""
        ...

    def distance(self, i: Episodes, j: Episodes) -> np.ndarray:
        """Distances of episodes i and j, of equal shapes or broadcast to each other, as float64."""
        ...

    def farthest(self, candidates: np.ndarray) -> np.ndarray:
        """(N,) distance of each episode to the farthest of the (M,) `candidates`, sorted episodes."""
        ...

    def nearest(self, rows: np.ndarray, k: int, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The candidates nearest to some episodes, other than themselves.

        Args:
            rows: (R,) episodes.
            k: How many for each; fewer where not every row has as many.
            candidates: (M,) sorted episodes.

        Returns:
            (R, k) episodes by growing distance, equally distant ones by their number, and their distances.
        """
        ...


def similarity_of(
    trajectories: Trajectories, keys: Sequence[str], root: Path, dense_up_to: int = DENSE_UP_TO
) -> Similarity:
    """The similarity of a dataset's episodes.

    Args:
        trajectories: The episodes.
        keys: Features that make up the states.
        root: The dataset's folder, for the cache.
        dense_up_to: Up to how many episodes all distances are computed and held; beyond, nothing that is held
            or kept grows faster than the number of episodes.
    """
    if len(trajectories) <= dense_up_to:
        return DenseSimilarity(pairwise_distances(trajectories.states(keys)))
    return SketchedSimilarity(trajectories, keys, root)


def similarity_by(trajectories: Trajectories, manner: Manner, root: Path) -> Similarity:
    """The similarity of a dataset's episodes by what is to be compared of them, see `similarity_of`."""
    return similarity_of(manner.of(trajectories), manner.columns, root)


class DenseSimilarity:
    """Few episodes, by the matrix of their distances.

    Args:
        distances: (N, N), as `pairwise_distances` computes them.
    """

    def __init__(self, distances: np.ndarray):
        self._distances = distances

    def __len__(self) -> int:
        """N."""
        return len(self._distances)

    def distance(self, i: Episodes, j: Episodes) -> np.ndarray:
        """See `Similarity`."""
        return self._distances[i, j]

    def farthest(self, candidates: np.ndarray) -> np.ndarray:
        """See `Similarity`."""
        return self._distances[:, candidates].max(axis=1, initial=0)

    def nearest(self, rows: np.ndarray, k: int, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Similarity`."""
        k = _available(rows, k, candidates)
        episodes, distances = np.empty((len(rows), k), dtype=np.int32), np.empty((len(rows), k))
        size = max(1, BLOCK_NUMBERS // max(1, len(candidates)))
        for start in range(0, len(rows), size):
            part = slice(start, start + size)
            apart = self._distances[np.ix_(rows[part], candidates)]
            apart[candidates == rows[part, None]] = np.inf
            order = np.argsort(apart, axis=1, kind="stable")[:, :k]
            episodes[part], distances[part] = candidates[order], np.take_along_axis(apart, order, axis=1)
        return episodes, distances


class SketchedSimilarity:
    """Many episodes: pairs are measured when they are asked for, the rest is found by one pass over them.

    Args:
        trajectories: The episodes.
        keys: Features that make up the states.
        root: The dataset's folder, for the cache.
    """

    def __init__(self, trajectories: Trajectories, keys: Sequence[str], root: Path):
        self._vectors = EpisodeVectors(trajectories.joined(keys), trajectories.lengths)
        self._fingerprint, self._root = trajectories.fingerprint(keys), root
        self._sketches: dict[int, Sketch] = {}
        self._surveys: dict[bytes, Survey] = {}

    def __len__(self) -> int:
        """N."""
        return len(self._vectors)

    def distance(self, i: Episodes, j: Episodes) -> np.ndarray:
        """See `Similarity`; relative errors are below 1e-6."""
        return self._vectors.distance(i, j)

    def farthest(self, candidates: np.ndarray) -> np.ndarray:
        """See `Similarity` and, for its exactness, `survey`."""
        return self._survey(candidates, SURVEYED).farthest

    def nearest(self, rows: np.ndarray, k: int, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Similarity` and, for its exactness, `survey`."""
        k = _available(rows, k, candidates)
        if len(rows) < len(self) // 2:
            found = survey(self._vectors, self._sketch(k), rows, candidates, k)
            return found.nearest, found.distances
        found = self._survey(candidates, max(k, SURVEYED))
        return found.nearest[rows, :k], found.distances[rows, :k]

    def _sketch(self, k: int) -> Sketch:
        """The sketch that serves the k nearest; one is kept."""
        k = max(k, SURVEYED)
        if k not in self._sketches:
            self._sketches = {k: make_sketch(self._vectors, k)}
        return self._sketches[k]

    def _survey(self, candidates: np.ndarray, k: int) -> Survey:
        """The survey of all episodes among the candidates, for the k nearest; the last one is kept."""
        everyone = np.arange(len(self))
        k = _available(everyone, k, candidates)
        name = candidates.astype(np.int64).tobytes()
        known = self._surveys.get(name)
        if known is None or known.nearest.shape[1] < k:
            key = hashlib.sha256(f"{self._fingerprint} {k} ".encode() + name).hexdigest()[:32]
            known = cached_survey(
                self._root,
                key,
                (len(self), k),
                lambda: survey(self._vectors, self._sketch(k), everyone, candidates, k),
            )
            self._surveys = {name: known}
        return known


def _available(rows: np.ndarray, k: int, candidates: np.ndarray) -> int:
    """How many nearest others, at most k, every row has."""
    return max(0, min(k, len(candidates) - int(np.isin(rows, candidates).any())))


class Dissimilarity:
    """ν(τ_i, τ_j): distances divided by the largest to a candidate, so that the farthest candidate has ν = 1.

    Args:
        similarity: Of N demonstrations.
        candidates: (M,) sorted episodes.
        normalization: ``row`` divides the distances of i by its own largest, which is the paper's formula and
            makes ν asymmetric; ``global`` by the largest of all candidates, which keeps it symmetric.

    Raises:
        ValueError: For an unknown normalization.
    """

    def __init__(self, similarity: Similarity, candidates: np.ndarray, normalization: Normalization = "row"):
        check_normalization(normalization)
        self._similarity, self._largest = similarity, similarity.farthest(candidates)
        if normalization == "global":
            self._largest = np.full(len(self._largest), self._largest[candidates].max(initial=0))

    def nu(self, i: Episodes, j: Episodes) -> np.ndarray:
        """ν(τ_i, τ_j) of episodes i and j, of equal shapes or broadcast to each other."""
        return self.of_distances(i, self._similarity.distance(i, j))

    def of_distances(self, i: Episodes, distances: np.ndarray) -> np.ndarray:
        """ν, given the distances from episodes i, of equal shapes or broadcast to each other."""
        return dissimilarities(distances, self._largest[i])
