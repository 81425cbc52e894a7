"""Similarity of demonstrations: dissimilarities ν, weights W, and their cache beside the dataset."""

import hashlib
import logging
import os
import stat
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from lerobot.utils.constants import HF_LEROBOT_HOME
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save
from scipy.spatial.distance import squareform

from lerobot_swr.trajectories import Trajectories

Normalization = Literal["row", "global"]

BLOCK_ELEMENTS = 16_000_000  # padded values held at once, in float64: 128 MB
CACHE_FOLDER = "lerobot_swr_cache"

logger = logging.getLogger(__name__)


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


def normalize_distances(distances: np.ndarray, normalization: Normalization = "row") -> np.ndarray:
    """Dissimilarities ν from distances.

    Args:
        distances: (N, N) non-negative distances.
        normalization: ``row`` divides row i by max_k d(i, k), which is the paper's formula and makes ν
            asymmetric; ``global`` divides by the largest distance of all and keeps it symmetric.

    Returns:
        (N, N) in [0, 1]; rows (or a matrix) of zeros stay 0.

    Raises:
        ValueError: For an unknown normalization.
    """
    check_normalization(normalization)
    largest = distances.max(axis=1, keepdims=True) if normalization == "row" else distances.max(keepdims=True)
    return np.divide(distances, largest, out=np.zeros_like(distances), where=largest > 0)


def check_normalization(normalization: str) -> None:
    """Refuse unknown normalizations.

    Raises:
        ValueError: For anything but ``row`` and ``global``.
    """
    if normalization not in ("row", "global"):
        raise ValueError(f"normalization={normalization!r}: expected 'row' or 'global'")


def dissimilarity_matrix(states: Sequence[np.ndarray], normalization: Normalization = "row") -> np.ndarray:
    """Dissimilarities ν(τ_i, τ_j) of demonstrations (the paper's Euclidean choice).

    Args:
        states: N arrays (T_i, d), one per episode.
        normalization: ``row`` (the paper) or ``global`` (symmetric).

    Returns:
        (N, N) float64 in [0, 1]: 0 on the diagonal, 1 for the farthest episode.

    Raises:
        ValueError: If an episode is empty, of another dimension or not finite, or for an unknown
            normalization.
    """
    check_normalization(normalization)
    return normalize_distances(pairwise_distances(states), normalization)


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


def check_beta(beta: float) -> None:
    """Refuse inverse temperatures below 0.

    Raises:
        ValueError: If `beta` is negative or not finite.
    """
    if not (np.isfinite(beta) and beta >= 0):
        raise ValueError(f"beta={beta}: expected a finite number >= 0 (0 treats all demonstrations alike)")


def cached_distances(trajectories: Trajectories, keys: Sequence[str], root: Path) -> np.ndarray:
    """`pairwise_distances` of a dataset, computed once and kept beside it.

    The file's name is a hash of the states that went in, so a changed dataset never meets a stale cache; the
    file is written under a temporary name and renamed, so processes may race; a file that is truncated or
    does not carry the hash of its own content is computed anew.

    Args:
        trajectories: The dataset's episodes.
        keys: Features that make up the states.
        root: The dataset's folder. Where its owner may not write, the cache lies in LeRobot's home instead.

    Returns:
        (N, N) float64.
    """
    key = trajectories.fingerprint(keys)
    path = _cache_folder(root) / f"distances-{key}.safetensors"
    distances = _read_cache(path, len(trajectories))
    if distances is None:
        distances = pairwise_distances(trajectories.states(keys))
        _write_cache(path, distances)
    return distances


def _cache_folder(root: Path) -> Path:
    writable = os.stat(root).st_mode & stat.S_IWUSR and os.access(root, os.W_OK)
    return (root if writable else HF_LEROBOT_HOME) / CACHE_FOLDER


def _read_cache(path: Path, n_episodes: int) -> np.ndarray | None:
    if not path.is_file():
        return None
    try:
        with safe_open(path, framework="np") as file:
            distances = file.get_tensor("distances")
            intact = (file.metadata() or {}).get("sha256") == _checksum(distances)
    except (SafetensorError, OSError) as error:
        logger.warning("Similarity cache %s cannot be read (%s): computed anew.", path, error)
        return None
    if not intact or distances.shape != (n_episodes, n_episodes):
        logger.warning("Similarity cache %s is damaged: computed anew.", path)
        return None
    return distances


def _write_cache(path: Path, distances: np.ndarray) -> None:
    content = save({"distances": distances}, metadata={"sha256": _checksum(distances)})
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        logger.warning("Similarity cache %s cannot be written (%s): going on without it.", path, error)


def _checksum(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
