"""A few numbers for each episode's vector, from which distances of many pairs are bounded quickly.

The numbers are coordinates along the principal directions of some episodes. What they leave out of a vector,
its residual, is known by its norm alone; the triangle inequality turns that into bounds of every distance.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.similarity.vectors import EpisodeVectors

REFERENCES, JUDGES = 2048, 256  # episodes that give the directions; others that say how many are needed
REFERENCE_NUMBERS = 2**26  # of the references together, at most
RESIDUAL_SHARE = 0.02  # of an episode's squared distance to its k-th nearest that may be left out
MOST_NUMBERS = 2**29  # of all coordinates together: 2 GB
ROWS = 512  # episodes that are written out at once
# Sums of n products in float32 err by about √n · 6e-8 of the factors' norms (Higham and Mary, SIAM J. Sci.
# Comput. 41, 2019: beyond 8 times that with probability 1e-13).
ROUNDING = 8 * 2**-24


@dataclass(frozen=True)
class Sketch:
    """Numbers that stand for N episodes.

    Attributes:
        coordinates: (N, m) float32.
        residuals: (N,) float32, at least the norms of what the coordinates leave out; 0 where they are the
            vectors themselves, about their mean.
        norms: (N,) float32, squared norms of the vectors about their mean.
        rounding: By how much a squared distance that is computed of these may err, in units of the sum of
            two squared norms.
    """

    coordinates: Tensor
    residuals: Tensor
    norms: Tensor
    rounding: float

    def bounds(self, rows: Tensor, candidates: Tensor) -> tuple[Tensor, Tensor]:
        """Factors of the lower bounds of squared distances, and their widths; see `neighbours`.

        Args:
            rows: (R,) int64 episodes.
            candidates: (M,) int64 episodes.

        Returns:
            (R, m + 3) and (M, m + 3): row i of one times row j of the other bounds |x_i − x_j|² from below,
            by no more than 4 r_i r_j + 2 c (n_i + n_j), for residuals r, squared norms n, rounding c.
        """
        scaled = (1 - self.rounding) * self.norms
        ones = torch.ones_like(scaled)
        left = torch.column_stack([-2 * self.coordinates, -2 * self.residuals, scaled, ones])
        right = torch.column_stack([self.coordinates, self.residuals, ones, scaled])
        return left[rows], right[candidates]


def make_sketch(vectors: EpisodeVectors, k: int) -> Sketch:
    """Sketch episodes so that the k nearest of each can be told from most others.

    Coordinates are as few as leave a small share of the squared distance to the k-th nearest out. Where half
    of all would not do, all are taken, if they fit into memory.

    Args:
        vectors: N episodes of D numbers.
        k: As for `survey`.
    """
    count, dimension = len(vectors), vectors.dimension
    order = np.random.default_rng(0).permutation(count)
    some = order[: max(2, min(REFERENCES, REFERENCE_NUMBERS // dimension))]
    references = vectors.padded(some)
    mean = references.mean(axis=0, dtype=np.float64).astype(np.float32)
    references -= mean
    directions = _principal_directions(references)  # (D, r)
    judges = vectors.padded(order[-JUDGES:]) - mean
    nearest = max(1, round(k * len(some) / count))
    needed = _needed(judges, references, directions, nearest)
    if needed > min(dimension // 2, directions.shape[1]) and count * dimension <= MOST_NUMBERS:
        return _sketch(vectors, mean, None)
    width = max(1, min(needed, directions.shape[1], MOST_NUMBERS // count))
    return _sketch(vectors, mean, torch.from_numpy(np.ascontiguousarray(directions[:, :width])))


def _principal_directions(references: np.ndarray) -> np.ndarray:
    """(D, r) float32 orthonormal directions of (S, D) centred vectors, those of most variance first."""
    products = _products(references, references)
    values, combinations = torch.linalg.eigh(torch.from_numpy(products))
    kept = values > 1e-10 * values[-1].clamp(min=1e-30)
    combined = (combinations[:, kept] / values[kept].sqrt()).flip(1).numpy()  # (S, r)
    return (references.T @ combined).astype(np.float32)


def _products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(A, B) float64 inner products of (A, D) and (B, D) float32 vectors."""
    step = 8192
    parts = (a[:, k : k + step].astype(np.float64) @ b[:, k : k + step].T for k in range(0, a.shape[1], step))
    return sum(parts, np.zeros((len(a), len(b))))


def _needed(judges: np.ndarray, references: np.ndarray, directions: np.ndarray, nearest: int) -> int:
    """How many directions leave little out of the distance to the `nearest`-th nearest reference."""
    squares = np.einsum("jd,jd->j", judges, judges, dtype=np.float64)
    others = np.einsum("sd,sd->s", references, references, dtype=np.float64)
    apart = squares[:, None] + others - 2 * _products(judges, references)  # (J, S)
    rank = min(nearest, len(references) - 1)
    scale = np.median(np.partition(apart.clip(min=0), rank, axis=1)[:, rank])
    covered = np.square(_products(judges, directions.T)).cumsum(axis=1)  # (J, r)
    left_out = np.median(squares[:, None] - covered, axis=0)  # (r,) falling
    return int((left_out > RESIDUAL_SHARE * scale).sum()) + 1


def _sketch(vectors: EpisodeVectors, mean: np.ndarray, directions: Tensor | None) -> Sketch:
    count, width = len(vectors), vectors.dimension if directions is None else directions.shape[1]
    coordinates, norms = torch.empty(count, width), torch.empty(count, dtype=torch.float64)
    rows = max(1, min(ROWS, REFERENCE_NUMBERS // vectors.dimension))
    for start in range(0, count, rows):
        block = torch.from_numpy(vectors.padded(np.arange(start, min(start + rows, count))) - mean)
        part = slice(start, start + len(block))
        norms[part] = block.double().square().sum(dim=1)
        coordinates[part] = block if directions is None else block @ directions
    rounding = ROUNDING * vectors.dimension**0.5
    residuals = torch.zeros(count)
    if directions is not None:
        covered = coordinates.double().square().sum(dim=1)
        residuals = ((norms - covered).clamp(min=0) + rounding * norms).sqrt().float()
    return Sketch(coordinates, residuals, norms.float(), rounding)
