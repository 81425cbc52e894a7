"""The statistics by which LeRobot normalises, compared with the data that they are said to describe."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.configs import NormalizationMode
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_swr.dataset_checks import edit_command
from lerobot_swr.dataset_files import is_numeric

Statistics = dict[str, dict[str, Any]]

NEEDED = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}
TOLERANCE = 0.2  # of mean and standard deviation, in units of the latter; what is nearer does no harm
EDGE_TOLERANCE = 0.05  # of least and largest value, in units of the range
EPSILON = float(np.finfo(np.float32).eps)
ROWS = 2**20  # of frames that are converted to double precision together

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Moments:
    """Mean, standard deviation, least and largest value of the d dimensions of a feature."""

    mean: np.ndarray
    std: np.ndarray
    low: np.ndarray
    high: np.ndarray
    longest: int  # episode, in frames

    @property
    def rounding(self) -> np.ndarray:
        """(d,) the error of LeRobot's mean, which sums up an episode in single precision."""
        return EPSILON * self.longest * np.maximum(np.abs(self.low), np.abs(self.high))

    @property
    def square_rounding(self) -> np.ndarray:
        """(d,) that of its variance, which is a difference of mean squares."""
        return self.rounding**2 / (EPSILON * self.longest)


def usable_statistics(
    meta: LeRobotDatasetMetadata,
    columns: Mapping[str, np.ndarray],
    modes: Mapping[str, NormalizationMode],
    longest: int,
) -> Statistics | None:
    """The dataset's statistics as vectors, fit to normalise with, once they agree with the data.

    A standard deviation that LeRobot's rounding has spoiled (a joint that moves little, far from 0) is
    replaced by that of the data. Where a dimension is constant it is 1: LeRobot divides by it.

    Args:
        meta: The dataset's metadata.
        columns: Feature to (frames, d) values of all of its episodes.
        modes: How each feature is normalised.
        longest: Frames of the longest episode.

    Raises:
        ValueError: If statistics that are needed are missing or not those of the data, naming the feature and
            LeRobot's command that computes them.
    """
    stats: Statistics = dict(meta.stats or {})
    for key, column in columns.items():
        needed = NEEDED.get(modes[key])
        if needed is None:
            continue
        given, shape = stats.get(key, {}), meta.features[key]["shape"]
        missing = [name for name in needed if name not in given]
        if missing:
            raise _error(meta, f"meta/stats.json has no {' and no '.join(missing)} of feature {key!r}")
        vectors = {}
        for name, value in given.items():
            vector = _vector(value, shape)
            if vector is not None:
                vectors[name] = vector
        for name in needed:
            if name not in vectors:
                found = list(np.shape(given[name]))
                raise _error(
                    meta,
                    f"meta/stats.json: {name} of feature {key!r} has shape {found} instead of {list(shape)}",
                )
            if not np.isfinite(vectors[name]).all():
                raise _error(meta, f"meta/stats.json: {name} of feature {key!r} is not finite")
        rows = vectors[needed[0]].reshape(-1, shape[-1])
        pooled = len(rows) > 1 and bool((rows == rows[0]).all())
        moments = _pooled_moments(column, shape, longest) if pooled else _moments(column, longest)
        checked = {**given, **vectors}
        if modes[key] is NormalizationMode.MEAN_STD:
            checked["std"] = _checked_std(meta, key, checked, moments)
        elif modes[key] is NormalizationMode.MIN_MAX:
            _check_edges(meta, key, checked, moments)
        else:
            _check_quantiles(meta, key, checked, moments, needed)
        stats[key] = checked
    return stats or None


def _checked_std(
    meta: LeRobotDatasetMetadata, key: str, given: Mapping[str, np.ndarray], moments: _Moments
) -> np.ndarray:
    """(d,) standard deviations to divide by."""
    mean, std = np.asarray(given["mean"], float), np.asarray(given["std"], float)
    off_mean = np.abs(mean - moments.mean) > TOLERANCE * moments.std + moments.rounding
    constant = moments.low == moments.high
    off_std = (np.abs(std - moments.std) > TOLERANCE * moments.std) & ~constant
    rounded = np.abs(std**2 - moments.std**2) <= moments.square_rounding
    wrong = np.flatnonzero(off_mean | (off_std & ~rounded))
    if len(wrong):
        k = wrong[0]
        raise _error(
            meta,
            f"meta/stats.json says that dimension {k} of feature {key!r} has mean {mean[k]:.4g} and standard "
            f"deviation {std[k]:.4g}, the data have {moments.mean[k]:.4g} and {moments.std[k]:.4g}",
        )
    spoiled = np.flatnonzero(off_std)
    if len(spoiled):
        logger.info(
            "dataset %s: standard deviation of dimensions %s of feature %r, which LeRobot's rounding has "
            "spoiled, taken from the data",
            meta.root,
            spoiled.tolist(),
            key,
        )
    return np.where(constant, 1.0, np.where(off_std, moments.std, std))


def _check_edges(
    meta: LeRobotDatasetMetadata, key: str, given: Mapping[str, np.ndarray], moments: _Moments
) -> None:
    tolerance = EDGE_TOLERANCE * (moments.high - moments.low) + moments.rounding
    off = np.abs(given["min"] - moments.low) > tolerance
    wrong = np.flatnonzero(off | (np.abs(given["max"] - moments.high) > tolerance))
    if len(wrong):
        k = wrong[0]
        raise _error(
            meta,
            f"meta/stats.json says that dimension {k} of feature {key!r} goes from {given['min'][k]:.4g} to "
            f"{given['max'][k]:.4g}, the data go from {moments.low[k]:.4g} to {moments.high[k]:.4g}",
        )


def _check_quantiles(
    meta: LeRobotDatasetMetadata,
    key: str,
    given: Mapping[str, np.ndarray],
    moments: _Moments,
    names: Sequence[str],
) -> None:
    """LeRobot averages quantiles over episodes, so little more than their place and order can be checked."""
    low, high = (np.asarray(given[name], float) for name in names)
    tolerance = EDGE_TOLERANCE * (moments.high - moments.low) + moments.rounding
    wrong = np.flatnonzero((low < moments.low - tolerance) | (high > moments.high + tolerance) | (low > high))
    if len(wrong):
        k = wrong[0]
        raise _error(
            meta,
            f"meta/stats.json says that dimension {k} of feature {key!r} has quantiles {low[k]:.4g} and "
            f"{high[k]:.4g}, the data go from {moments.low[k]:.4g} to {moments.high[k]:.4g}",
        )
    empty = np.flatnonzero((low == high) & (moments.low < moments.high))
    if len(empty):
        raise ValueError(
            f"dataset {meta.root}: {names[0]} and {names[1]} of dimension {empty[0]} of feature {key!r} are "
            "equal though it moves, so it cannot be normalised by them; choose another "
            "policy.normalization_mapping, e.g. MEAN_STD"
        )


def _error(meta: LeRobotDatasetMetadata, reason: str) -> ValueError:
    command = f"{edit_command(meta, 'recompute_stats')} --operation.overwrite=true"
    if any(is_numeric(ft) and len(ft["shape"]) > 1 for ft in meta.features.values()):
        command = "see docs/datasets.md (LeRobot's own command fails on features of several dimensions)"
    return ValueError(f"dataset {meta.root}: {reason}; compute the statistics anew: {command}")


def _vector(value: Any, shape: Sequence[int]) -> np.ndarray | None:
    """(d,) of a statistic; None if it has another size. LeRobot pools the rows of a grid."""
    try:
        array, d = np.asarray(value, dtype=np.float64), int(np.prod(shape))
    except (TypeError, ValueError):
        return None
    if array.size == d:
        return array.reshape(d)
    if len(shape) > 1 and array.size == shape[-1]:
        return np.tile(array.reshape(-1), d // shape[-1])
    return None


def _pooled_moments(column: np.ndarray, shape: Sequence[int], longest: int) -> _Moments:
    """Moments over the rows of a grid together, for each of its cells."""
    times = column.shape[1] // shape[-1]
    rows = _moments(column.reshape(-1, shape[-1]), longest * times)
    return _Moments(
        np.tile(rows.mean, times),
        np.tile(rows.std, times),
        np.tile(rows.low, times),
        np.tile(rows.high, times),
        rows.longest,
    )


def _moments(column: np.ndarray, longest: int) -> _Moments:
    mean = sum(block.sum(axis=0) for block in _blocks(column)) / len(column)
    variance = sum(np.square(block - mean).sum(axis=0) for block in _blocks(column)) / len(column)
    low, high = (extreme.astype(np.float64) for extreme in (column.min(axis=0), column.max(axis=0)))
    return _Moments(mean, np.sqrt(variance), low, high, longest)


def _blocks(column: np.ndarray) -> Iterator[np.ndarray]:
    return (column[first : first + ROWS].astype(np.float64) for first in range(0, len(column), ROWS))
