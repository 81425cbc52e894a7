"""Episodes as paths of a common number of points, so that speed, pauses and length are not strategy."""

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter1d

TIME_POINTS = 200  # of the first, even, resampling in time
JITTER = 1.5  # standard deviation of the smoothing, in these points: sensors' noise is no way
PACE = 0.05  # share of time in the pace along a path; the rest is the way that was covered
STILL = 0.02  # share of an episode's extent up to which its beginning and its end are waiting
BLUR = 1.0  # standard deviation of the smoothing along the path, in its points


def walk(states: np.ndarray, points: int) -> np.ndarray:
    """A path walked at an even pace.

    Args:
        states: (T, d), in units in which all dimensions count alike.
        points: P.

    Returns:
        (P, d), almost evenly spaced along the way that the states covered.
    """
    states = without_waiting(states)
    even = _interpolate(states, np.linspace(0, len(states) - 1, TIME_POINTS), np.arange(len(states)))
    even = gaussian_filter1d(even, JITTER, axis=0, mode="nearest")
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(even, axis=0), axis=1).cumsum()])
    phase = np.linspace(0, 1, TIME_POINTS)
    if way[-1] > 0:
        phase = (1 - PACE) * way / way[-1] + PACE * phase
    path = _interpolate(even, np.linspace(0, 1, points), phase)
    return gaussian_filter1d(path, BLUR, axis=0, mode="nearest")


def without_waiting(states: np.ndarray) -> np.ndarray:
    """(T', d) of (T, d) states without those before it sets out and after it has come to rest.

    A rollout goes on after its task is done; where it waits is no part of its way.
    """
    least = STILL * np.linalg.norm(np.ptp(states, axis=0))
    away_from_first, away_from_last = (
        np.flatnonzero(np.linalg.norm(states - states[at], axis=1) > least) for at in (0, -1)
    )
    if not len(away_from_first) or not len(away_from_last):
        return states
    begin, end = away_from_first[0] - 1, away_from_last[-1] + 2
    return states[begin:end] if end - begin > 2 else states


def walk_all(episodes: Sequence[np.ndarray], points: int) -> np.ndarray:
    """(N, P, d) paths of N episodes (T_i, d)."""
    return np.stack([walk(states, points) for states in episodes])


def beginnings(paths: np.ndarray, share: float) -> np.ndarray:
    """(N, P, d) the first part, up to a share of the way, of (N, P, d) paths, as paths of their own."""
    points = paths.shape[1]
    at = np.linspace(0, share * (points - 1), points)
    left = np.minimum(at.astype(int), points - 2)
    weight = (at - left)[None, :, None]
    return paths[:, left] * (1 - weight) + paths[:, left + 1] * weight


def _interpolate(values: np.ndarray, at: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(Q, d) of (T, d) values at `known` places, linearly."""
    right = np.clip(np.searchsorted(known, at, side="right"), 1, max(len(known) - 1, 1))
    if len(known) == 1:
        return np.repeat(values, len(at), axis=0)
    left = right - 1
    share = ((at - known[left]) / (known[right] - known[left]))[:, None]
    return values[left] * (1 - share) + values[right] * share
