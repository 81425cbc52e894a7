"""Episodes as paths of a common number of points, so that speed, pauses and length are not strategy."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

TIME_POINTS = 200  # of the first, even, resampling in time
JITTER = 1.5  # standard deviation of the smoothing, in these points: sensors' noise is no way
PACE = 0.05  # share of time in the pace along a path; the rest is the way that was covered
BLUR = 1.0  # standard deviation of the smoothing along the path, in its points


def walk(states: np.ndarray, points: int) -> np.ndarray:
    """A path walked at an even pace.

    Args:
        states: (T, d), in units in which all dimensions count alike.
        points: P.

    Returns:
        (P, d), almost evenly spaced along the way that the states covered.
    """
    even = _interpolate(states, np.linspace(0, len(states) - 1, TIME_POINTS), np.arange(len(states)))
    even = gaussian_filter1d(even, JITTER, axis=0, mode="nearest")
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(even, axis=0), axis=1).cumsum()])
    phase = np.linspace(0, 1, TIME_POINTS)
    if way[-1] > 0:
        phase = (1 - PACE) * way / way[-1] + PACE * phase
    path = _interpolate(even, np.linspace(0, 1, points), phase)
    return gaussian_filter1d(path, BLUR, axis=0, mode="nearest")


def walk_all(episodes: Sequence[np.ndarray], points: int) -> np.ndarray:
    """(N, P, d) paths of N episodes (T_i, d)."""
    return np.stack([walk(states, points) for states in episodes])


def _interpolate(values: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(Q, d) of (T, d) values at `known` places, linearly."""
    right = np.clip(np.searchsorted(known, at, side="right"), 1, max(len(known) - 1, 1))
    if len(known) == 1:
        return np.repeat(values, len(at), axis=0)
    left = right - 1
    share = ((at - known[left]) / (known[right] - known[left]))[:, None]
    return values[left] * (1 - share) + values[right] * share
