"""How far recordings and an environment's observations are apart, and whether by a shift in time.

Pure functions of arrays. At an *offset* of k steps frame t + k of a recording is compared with observation t
of the environment: a recording that agrees at offset 1 is one step behind, since its frame t holds what the
environment showed at t - 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

MAX_OFFSET = 3
OFFSETS = tuple(range(-MAX_OFFSET, MAX_OFFSET + 1))
_BY_SIZE = sorted(range(len(OFFSETS)), key=lambda place: (abs(OFFSETS[place]), -OFFSETS[place]))
_STILL = 1e-5  # a column that varies by less than this share of its largest value does not move
_EQUAL = 1e-6  # relative difference of two deviations that are the same but for rounding

Episode = Mapping[str, np.ndarray]
"""Feature name to (T, d)."""
Names = Mapping[str, Sequence[str]]
"""Feature name to the names of its d columns."""


@dataclass(frozen=True)
class Deviation:
    """Distance at equal index, over all frames, in the feature's units.

    Attributes:
        mean: Its mean.
        largest: Its largest.
        dimensions: Name of a column to the mean and largest absolute difference.
    """

    mean: float
    largest: float
    dimensions: dict[str, dict[str, float]]


@dataclass(frozen=True)
class ColumnGroup:
    """Columns of one feature that are late by the same number of steps.

    Attributes:
        feature: The feature.
        columns: Names of its columns.
        best_offset: The offset at which most episodes agree best, if that is more than half of them, else 0;
            None if the columns never move, or no episode is long enough.
        agreement: Share of the episodes that agree best at `best_offset`, of the columns' mean.
        deviation_by_offset: Offset to the mean distance over the columns, in the feature's units, over the
            frames that can be compared at every offset.
    """

    feature: str
    columns: list[str]
    best_offset: int | None
    agreement: float | None
    deviation_by_offset: dict[str, float] | None


def deviations(
    recorded: Sequence[Episode], observed: Sequence[Episode], names: Names
) -> dict[str, Deviation]:
    """Distances of observations to recordings at equal index.

    Args:
        recorded: Recorded episodes, (T, d) of each feature.
        observed: What the environment showed when they were replayed; may be shorter or longer.
        names: The features to compare.
    """
    found = {}
    for feature, columns in names.items():
        pairs = [_equal_lengths(r[feature], o[feature]) for r, o in zip(recorded, observed, strict=True)]
        difference = np.abs(np.concatenate([o.astype(np.float64) - r for r, o in pairs]))  # (frames, d)
        distance = np.linalg.norm(difference, axis=1)
        found[feature] = Deviation(
            float(distance.mean()),
            float(distance.max()),
            {
                name: {"mean": float(column.mean()), "largest": float(column.max())}
                for name, column in zip(columns, difference.T, strict=True)
            },
        )
    return found


def column_groups(
    recorded: Sequence[Episode], observed: Sequence[Episode], names: Names
) -> list[ColumnGroup]:
    """Find the offset of every column, and group those of a feature that share it.

    Every episode in which a column moves votes for the offset at which its mean deviation is smallest; ties
    are for the smaller shift. Thus a noisy column is judged over all its frames, while replays that part from
    their recording for another reason (a contact that goes otherwise) decide nothing as long as they are the
    minority.

    Args: As those of `deviations`.
    """
    groups = []
    for feature, columns in names.items():
        windows = [
            differences
            for r, o in zip(recorded, observed, strict=True)
            if (differences := _differences(r[feature], o[feature])) is not None
        ]  # each (K, frames, d)
        found = [_column_offset(windows, j) for j in range(len(columns))]
        for offset in sorted({offset for offset, _ in found}, key=lambda k: (k is None, abs(k or 0), k)):
            chosen = [j for j, (k, _) in enumerate(found) if k == offset]
            agreement = [found[j][1] for j in chosen]
            groups.append(
                ColumnGroup(
                    feature,
                    [columns[j] for j in chosen],
                    offset,
                    None if offset is None else float(np.mean(agreement)),
                    None if offset is None else _mean_distances(windows, chosen),
                )
            )
    return groups


def best_offset(groups: Sequence[ColumnGroup]) -> int | None:
    """The offset of the columns that disagree at offset 0, if any do; of several that of most columns.

    Returns:
        None if nothing moves.
    """
    moving = [group for group in groups if group.best_offset is not None]
    if not moving:
        return None
    columns = {k: sum(len(g.columns) for g in moving if g.best_offset == k) for k in OFFSETS if k}
    return max((0, *columns), key=lambda k: (columns.get(k, 0), -abs(k), k))


def describe(groups: Sequence[ColumnGroup]) -> str:
    """Whether the recording is in step with the environment, as a sentence without a full stop."""
    moving = [group for group in groups if group.best_offset is not None]
    late = sorted(
        (group for group in moving if group.best_offset), key=lambda group: -len(group.columns)
    )  # the largest first
    if not moving:
        return "nothing moves long enough to tell whether the recording and the environment are in step"
    if not late:
        return "the recording and the environment are in step"
    if len({group.best_offset for group in moving}) == 1:
        return f"the recording is {_shift(late[0].best_offset)} the environment"
    parts = [f"{_shift(g.best_offset)} the environment in {g.feature} ({_listed(g.columns)})" for g in late]
    return f"the recording is {' and '.join(parts)}"


def _shift(offset: int | None) -> str:
    assert offset is not None
    n, more = abs(offset), " or more" if abs(offset) == MAX_OFFSET else ""
    return f"{n}{more} step{'s' if n > 1 else ''} {'behind' if offset > 0 else 'ahead of'}"


def _listed(columns: Sequence[str], at_most: int = 6) -> str:
    rest = len(columns) - at_most
    return ", ".join([*columns[:at_most], *([f"{rest} more"] if rest > 0 else [])])


def _equal_lengths(recorded: np.ndarray, observed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = min(len(recorded), len(observed))
    return recorded[:length], observed[:length]


def _differences(recorded: np.ndarray, observed: np.ndarray) -> np.ndarray | None:
    """(K, frames, d) absolute differences at every offset, over the frames that all offsets have.

    Columns that do not move are NaN. None if there is no such frame.
    """
    end = min(len(observed), len(recorded) - MAX_OFFSET)
    if end <= MAX_OFFSET:
        return None
    shown = observed[MAX_OFFSET:end].astype(np.float64)
    shifted = [recorded[MAX_OFFSET + k : end + k].astype(np.float64) for k in OFFSETS]
    seen = recorded[: end + MAX_OFFSET].astype(np.float64)
    still = np.ptp(seen, axis=0) <= _STILL * np.abs(seen).max(axis=0)
    return np.where(still, np.nan, np.abs(np.stack(shifted) - shown))


def _column_offset(windows: Sequence[np.ndarray], column: int) -> tuple[int | None, float]:
    """Offset that most episodes vote for, and the share of those that do."""
    votes = [_vote(window[:, :, column].mean(axis=1)) for window in windows]
    counts = np.bincount([vote for vote in votes if vote is not None], minlength=len(OFFSETS))
    if counts.sum() == 0:
        return None, 0.0
    winner = int(counts.argmax())
    if 2 * counts[winner] <= counts.sum():
        winner = OFFSETS.index(0)
    return OFFSETS[winner], float(counts[winner] / counts.sum())


def _vote(deviation: np.ndarray) -> int | None:
    """Place of the smallest of (K,) deviations, of equal ones that of the smallest shift; None if NaN."""
    if np.isnan(deviation).any():
        return None
    return next(place for place in _BY_SIZE if deviation[place] <= deviation.min() * (1 + _EQUAL))


def _mean_distances(windows: Sequence[np.ndarray], columns: Sequence[int]) -> dict[str, float]:
    """Offset to the mean distance over some columns, over the frames of the episodes in which they move."""
    squares = [np.square(window[:, :, columns]) for window in windows]
    moving = [part for part in squares if not np.isnan(part).all()]
    distances = np.concatenate([np.sqrt(np.nansum(part, axis=2)) for part in moving], axis=1)  # (K, frames)
    return {str(k): float(value) for k, value in zip(OFFSETS, distances.mean(axis=1), strict=True)}
