"""The definition: distances of demonstrations, dissimilarities ν and weights W."""

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
import torch
from scipy.spatial.distance import squareform

Normalization = Literal["row", "global"]
NORMALIZATIONS: tuple[Normalization, ...] = get_args(Normalization)
Episodes = int | np.ndarray
"""One episode or an array of them."""

BLOCK_ELEMENTS = 16_000_000  # padded values held at once, in float64: 128 MB


def pairwise_distances(states: Sequence[np.ndarray]) -> np.ndarray:
    """Euclidean distances of state sequences padded to a common length by repeating their last state.

    The common length is that of the longest episode of all, so that every episode is one vector and the
    distances form a metric.

    Differences are squared directly, in float64 and over blocks of time, so that equal episodes have distance
    exactly 0 (the faster expansion |x|² − 2x·y + |y|² loses small distances) and memory stays bounded.

    Args:
        states: N arrays (T_i, d).

    Returns:
        (N, N) float64, symmetric with a zero diagonal, in the units of the states.

    Raises:
        ValueError: If an episode is empty, has another dimension than the others or holds NaN.
    """
    _check_states(states)
    n, dim = len(states), states[0].shape[1]
    longest = max(len(episode) for episode in states)
    block_length = max(1, BLOCK_ELEMENTS // (n * dim))
    squared = torch.zeros(n * (n - 1) // 2, dtype=torch.float64)  # of the pairs i < j
    for start in range(0, longest, block_length):
        stop = min(start + block_length, longest)
        padded = np.empty((n, stop - start, dim))  # (N, block, d)
        for row, episode in zip(padded, states, strict=True):
            part = episode[start:stop]
            row[: len(part)] = part
            row[len(part) :] = episode[-1]
        squared += torch.pdist(torch.from_numpy(padded.reshape(n, -1))).square_()
    return squareform(squared.sqrt_().numpy()) if n > 1 else np.zeros((1, 1))


def _check_states(states: Sequence[np.ndarray]) -> None:
    if len(states) == 0:
        raise ValueError("states: expected at least one episode")
    for i, episode in enumerate(states):
        if episode.ndim != 2 or len(episode) == 0 or episode.shape[1] != states[0].shape[-1]:
            raise ValueError(
                f"states[{i}] has shape {episode.shape}; expected (T, {states[0].shape[-1]}) with T >= 1"
            )
        if not np.isfinite(episode).all():
            raise ValueError(f"states[{i}] holds NaN or infinite values; repair or drop this episode")


def dissimilarities(distances: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """ν: distances divided by the largest one, that of their row (the paper) or of all; 0 where that is 0.

    Args:
        distances: Distances of any shape.
        largest: What each is divided by; of that shape, or broadcast to it.
    """
    return np.divide(distances, largest, out=np.zeros(np.shape(distances)), where=np.asarray(largest) > 0)


def similarity_weights(nu: np.ndarray, beta: float) -> np.ndarray:
    """Weights W(τ_i, τ_j) = exp(−β ν(τ_i, τ_j)).

    Args:
        nu: Dissimilarities of any shape.
        beta: Inverse temperature; 0 weights every pair 1, large values leave only (near-)equal episodes.

    Raises:
        ValueError: If `beta` is negative or not finite.
    """
    check_beta(beta)
    return np.exp(-beta * np.asarray(nu))


def check_normalization(normalization: str) -> Normalization:
    """The normalization of that name.

    Raises:
        ValueError: For anything but ``row`` and ``global``.
    """
    for known in NORMALIZATIONS:
        if known == normalization:
            return known
    raise ValueError(f"normalization={normalization!r}: expected 'row' or 'global'")


def check_beta(beta: float) -> None:
    """Refuse inverse temperatures below 0.

    Raises:
        ValueError: If `beta` is negative or not finite.
    """
    if not (np.isfinite(beta) and beta >= 0):
        raise ValueError(f"beta={beta}: expected a finite number >= 0 (0 treats all demonstrations alike)")
