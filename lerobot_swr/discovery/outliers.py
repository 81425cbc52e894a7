"""Episodes that fit nowhere, and why, in words.

An episode is suspicious if one of a few numbers is far beyond those of the others, on a logarithmic scale:
the distance of its path to the nearest other one, those of its start and its end, its roughness; if it has
few frames or covers little way; or if it is rather far from the others and played backwards, or as a part of
another one, is not. How far is far is measured by the median and the quartiles of all episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sklearn.neighbors import NearestNeighbors

from lerobot_swr.discovery.paths import beginnings

FAR = 5.0  # robust standard deviations of the logarithm
FARTHER = 6.0  # the same, for numbers that vary for good reasons, too
COPY = 0.02  # distance, relative to the size of what is compared, below which episodes count as copies
NEIGHBOURS = 3  # by which starts and ends are judged: several episodes may begin or end oddly
LEAST_FACTOR = 1.6  # and at least this many times the median
SHORT, STILL = 0.35, 0.15  # shares of the median of frames, of the way covered
LEAST_APART = 0.3  # of starts and ends that are far away, in units of a dimension's spread
ROUGH = 5.0  # times the usual roughness that is called noise
COVERED = 0.2, 0.9  # a path that was cut off shows more and less than these shares of the whole one
AS_NEAR = 2.0  # times the usual distance to the nearest path, up to which it follows another one
DOUBTFUL = 2.0  # times the usual distance to the nearest path, from which on these are looked for
CLOSER = 0.5  # a path fits so much better backwards, or as a part
COMPARED = 500  # paths with which it is compared


@dataclass(frozen=True)
class Manner:
    """Simple numbers of N episodes, in standardised units.

    Attributes:
        frames: (N,) number of frames.
        way: (N,) length of the way that was covered, after smoothing.
        roughness: (N,) mean change of the step from frame to frame.
        firsts: (N, m) first states.
        lasts: (N, m) last states.
    """

    frames: np.ndarray
    way: np.ndarray
    roughness: np.ndarray
    firsts: np.ndarray
    lasts: np.ndarray


def describe_manner(states: Sequence[np.ndarray], paths: np.ndarray) -> Manner:
    """Measure N episodes of moving dimensions (T_i, m) and their (N, P, m) paths."""
    return Manner(
        np.array([len(s) for s in states], float),
        np.linalg.norm(np.diff(paths, axis=1), axis=2).sum(axis=1),
        np.array(
            [np.linalg.norm(np.diff(s, 2, axis=0), axis=1).mean() if len(s) > 2 else 0.0 for s in states]
        ),
        np.stack([s[0] for s in states]),
        np.stack([s[-1] for s in states]),
    )


def nearest_distance(points: np.ndarray, kept: np.ndarray, count: int = 1) -> np.ndarray:
    """(N,) mean distance of each of (N, D) points to the `count` nearest others of those that are kept."""
    count = min(count, int(kept.sum()) - 1)
    if count < 1:
        return np.zeros(len(points))
    search = NearestNeighbors(n_neighbors=count + 1, algorithm="brute").fit(points[kept])
    found, _ = search.kneighbors(points)  # (N, count + 1), of the kept ones the first is themselves
    return np.where(kept, found[:, 1:].mean(axis=1), found[:, :count].mean(axis=1))


def far_beyond(values: np.ndarray, kept: np.ndarray, far: float = FAR) -> np.ndarray:
    """(N,) bool, positive numbers that are far beyond those of the kept episodes."""
    logarithms = np.log(np.maximum(values, 1e-12))
    low, median, high = np.quantile(logarithms[kept], [0.25, 0.5, 0.75])
    spread = max((high - median) / 0.6745, (high - low) / 1.349, 0.02)
    return (logarithms > median + far * spread) & (values > LEAST_FACTOR * np.exp(median))


def suspicious(
    paths: np.ndarray, residuals: np.ndarray, manner: Manner | None, kept: np.ndarray
) -> np.ndarray:
    """(N,) bool, the episodes that fit nowhere.

    Args:
        paths: (N, P, m).
        residuals: (N, D) what the paths are compared by.
        manner: None for vectors, of which nothing else is known.
        kept: (N,) bool, the episodes that tell what is usual.
    """
    size = np.sqrt(np.square(residuals[kept]).sum(axis=1).mean())
    # Copies of an episode are no measure of what is usual.
    result = far_beyond(np.maximum(nearest_distance(residuals, kept), COPY * size), kept)
    if manner is None:
        return result
    usual_way, usual_frames = np.median(manner.way[kept]), np.median(manner.frames[kept])
    return (
        result
        | _far_away(manner.firsts, kept)
        | _far_away(manner.lasts, kept)
        | far_beyond(manner.roughness, kept, FARTHER)
        | (manner.way < STILL * usual_way)
        | (manner.frames < SHORT * usual_frames)
        | _spoiled(paths, kept)
    )


def _far_away(places: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """(N,) bool, the starts or ends (N, m) that lie where no other's does."""
    distance = nearest_distance(places, kept, NEIGHBOURS)
    return far_beyond(distance, kept, FARTHER) & (distance > LEAST_APART)


def reasons(
    episodes: Sequence[int],
    paths: np.ndarray,
    residuals: np.ndarray,
    manner: Manner | None,
    kept: np.ndarray,
) -> dict[int, str]:
    """Why episodes fit nowhere.

    Args:
        episodes: Their numbers.
        paths: (N, P, m).
        residuals: (N, P·m).
        manner: See `suspicious`.
        kept: (N,) bool, the episodes that fit somewhere.
    """
    if not len(episodes):
        return {}
    others, distance = np.flatnonzero(kept), nearest_distance(residuals, kept)
    apart = float(np.median(nearest_distance(paths.reshape(len(paths), -1), kept)[kept]))
    usual = float(np.median(distance[kept]))
    times = {i: f"{distance[i] / usual:.1f} times as far from the nearest episode as usual" for i in episodes}
    if manner is None or not usual:
        return {i: f"far from all others: {times[i]}" if usual else "alone" for i in episodes}
    way, frames = manner.way / np.median(manner.way[kept]), np.median(manner.frames[kept])
    roughness = manner.roughness / max(float(np.median(manner.roughness[kept])), 1e-12)
    rough = far_beyond(manner.roughness, kept) & (roughness > ROUGH)
    far_ends = {"start": _far_away(manner.firsts, kept), "end": _far_away(manner.lasts, kept)}
    told = {}
    for i in episodes:
        if way[i] < STILL:
            told[i] = f"frozen: covers {way[i]:.0%} of the usual way"
        elif manner.frames[i] < SHORT * frames:
            told[i] = f"too short: {int(manner.frames[i])} frames, {frames:.0f} are usual"
        elif rough[i]:
            told[i] = f"noise: steps change {roughness[i]:.1f} times as much as usual from frame to frame"
        else:
            ends = [name for name, far in far_ends.items() if far[i]]
            where = f"; its {' and '.join(ends)} lies where no other's does" if ends else ""
            told[i] = _spoiled_how(i, paths, others, apart) or f"path far from any: {times[i]}{where}"
    return told


def _spoiled(paths: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """(N,) bool, the episodes rather far from others that are another one played backwards, or cut off."""
    distance = nearest_distance(paths.reshape(len(paths), -1), kept)
    usual = float(np.median(distance[kept]))
    doubtful = np.flatnonzero(distance > DOUBTFUL * usual)
    doubtful = doubtful[np.argsort(-distance[doubtful])][: max(20, len(paths) // 20)]
    others = np.flatnonzero(kept)
    result = np.zeros(len(paths), dtype=bool)
    for i in doubtful:
        result[i] = _spoiled_how(int(i), paths, others, usual) is not None
    return result


def _spoiled_how(episode: int, paths: np.ndarray, others: np.ndarray, usual: float) -> str | None:
    """Whether an episode is another one played backwards, or cut off, in words; None if it is neither.

    Args:
        episode: Its number.
        paths: (N, P, m).
        others: Numbers of those with which it is compared.
        usual: Distance of a path (P·m,) to the nearest other one.
    """
    near = AS_NEAR * max(usual / len(paths[0]) ** 0.5, COPY * _size(paths[others]))
    others = others[others != episode]
    if len(others) > COMPARED:
        others = others[np.linspace(0, len(others) - 1, COMPARED).astype(int)]
    own, whole = paths[episode], paths[others]
    forward, backward = _apart(own, whole).min(), _apart(own[::-1], whole).min()
    part, share = _as_part(own, whole)
    if backward < CLOSER * forward and backward < part:
        return "reversed: played backwards it follows another episode"
    if part < min(CLOSER * forward, near) and COVERED[0] < share < COVERED[1]:
        return f"cut off: follows another episode for {share:.0%} of its way and ends there"
    return None


def _size(paths: np.ndarray) -> float:
    """Root mean square distance of paths (M, P, m) to their mean."""
    return float(np.sqrt(np.square(paths - paths.mean(axis=0)).sum(axis=2).mean()))


def _apart(path: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(M,) root mean square distance of a path (P, m) to others (M, P, m)."""
    return np.sqrt(np.square(others - path).sum(axis=2).mean(axis=1))


def _as_part(path: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """The least distance of a path to a beginning of one of the others, and what share of it this is."""
    best, best_share = np.inf, 1.0
    for share in np.linspace(0.2, 1.0, 17):
        apart = float(_apart(path, beginnings(others, share)).min())
        if apart < best:
            best, best_share = apart, float(share)
    return best, best_share
