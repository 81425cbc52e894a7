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
_ROUNDING = 1e-4  # deviations are equal that differ by less than this share of a column's mean step
_FAR_SMALLER = 0.5  # share of the deviation that has to go for a displacement to be believed

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
        best_offset: The offset at which more than half of the episodes agree best, else 0; None if the
            columns never move, or no episode is long enough.
        displaced: Whether they agree but for a constant displacement in each episode, since the state that
            the replay started from was late, too.
        agreement: Share of the episodes that agree best at `best_offset`, on average over the columns.
        deviation_by_offset: Offset to the mean distance over the columns, in the feature's units, over the
            frames that can be compared at every offset; without that displacement, if they are displaced.
    """

    feature: str
    columns: list[str]
    best_offset: int | None
    displaced: bool
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
        differences = []
        for r, o in zip(recorded, observed, strict=True):
            length = min(len(r[feature]), len(o[feature]))
            differences.append(np.abs(r[feature][:length].astype(np.float64) - o[feature][:length]))
        difference = np.concatenate(differences)  # (frames, d)
        distance = np.linalg.norm(difference, axis=1)
        dimensions = {
            name: {"mean": float(column.mean()), "largest": float(column.max())}
            for name, column in zip(columns, difference.T, strict=True)
        }
        found[feature] = Deviation(float(distance.mean()), float(distance.max()), dimensions)
    return found


def column_groups(
    recorded: Sequence[Episode], observed: Sequence[Episode], names: Names
) -> list[ColumnGroup]:
    """Find the offset of every column, and group the columns of a feature that share it.

    Every episode in which a column moves votes for the offset at which its mean deviation is smallest; ties
    are for the smaller shift. Thus a noisy column is judged over all its frames, and replays that part from
    their recording for another reason (a contact that goes otherwise) decide nothing while they are few.

    A replay that starts from a late state is displaced all the way, and is nearest where the shift makes up
    for that, not where it is in step. Episodes therefore vote once more with the mean difference taken off,
    and a shift that halves what is left is believed.

    Args: As those of `deviations`.
    """
    groups = []
    for feature, columns in names.items():
        pairs = [(r[feature], o[feature]) for r, o in zip(recorded, observed, strict=True)]
        windows = [window for r, o in pairs if (window := _differences(r, o)) is not None]
        found = [_finding([window[:, :, j] for window in windows]) for j in range(len(columns))]
        kinds = dict.fromkeys((one.offset, one.displaced) for one in found)
        for offset, displaced in kinds:
            chosen = [j for j, one in enumerate(found) if (one.offset, one.displaced) == (offset, displaced)]
            names_of_them = [columns[j] for j in chosen]
            if offset is None:
                groups.append(ColumnGroup(feature, names_of_them, None, False, None, None))
                continue
            agreement = float(np.mean([found[j].agreement for j in chosen]))
            distances = _mean_distances([window[:, :, chosen] for window in windows], displaced)
            groups.append(ColumnGroup(feature, names_of_them, offset, displaced, agreement, distances))
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
    late = sorted((group for group in moving if group.best_offset), key=lambda group: -len(group.columns))
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


def _differences(recorded: np.ndarray, observed: np.ndarray) -> np.ndarray | None:
    """(K, frames, d) differences at every offset, over the frames that all offsets have; None if none are.

    Columns that do not move are NaN.
    """
    end = min(len(observed), len(recorded) - MAX_OFFSET)
    if end <= MAX_OFFSET:
        return None
    seen = recorded[: end + MAX_OFFSET].astype(np.float64)
    shown = observed[MAX_OFFSET:end].astype(np.float64)
    still = np.ptp(seen, axis=0) <= _STILL * np.abs(seen).max(axis=0)
    shifted = np.stack([seen[MAX_OFFSET + k : end + k] for k in OFFSETS])
    return np.where(still, np.nan, shifted - shown)


@dataclass(frozen=True)
class _Finding:
    offset: int | None
    displaced: bool
    agreement: float


def _finding(windows: Sequence[np.ndarray]) -> _Finding:
    """Offset of one column from its (K, frames) differences in every episode."""
    moving = [window for window in windows if not np.isnan(window).any()]
    if not moving:
        return _Finding(None, False, 0.0)
    offset, agreement = _elected([_vote(window) for window in moving])
    other, other_agreement = _elected([_vote(_centred(window), _FAR_SMALLER) for window in moving])
    if other not in (0, offset):
        return _Finding(other, True, other_agreement)
    return _Finding(offset, False, agreement)


def _elected(votes: Sequence[int]) -> tuple[int, float]:
    """Offset that more than half of the votes are for, else 0, and the share of those for it."""
    winner = max(set(votes), key=votes.count)
    winner = winner if 2 * votes.count(winner) > len(votes) else 0
    return winner, votes.count(winner) / len(votes)


def _vote(differences: np.ndarray, at_most: float = 1.0) -> int:
    """The offset with the smallest mean deviation, of equal ones the smallest; 0 unless it is smaller there.

    Args:
        differences: (K, frames) of one column in one episode.
        at_most: Share of the deviation at offset 0 that a shift may leave.
    """
    deviation = np.abs(differences).mean(axis=1)
    step = np.abs(np.diff(differences, axis=0)).mean()  # differences at k + 1 and k are a step apart
    rounding = _ROUNDING * float(step)
    best = next(place for place in _BY_SIZE if deviation[place] <= deviation.min() + rounding)
    return OFFSETS[best] if deviation[best] <= at_most * deviation[MAX_OFFSET] else 0


def _centred(differences: np.ndarray) -> np.ndarray:
    return differences - differences.mean(axis=1, keepdims=True)


def _mean_distances(windows: Sequence[np.ndarray], displaced: bool) -> dict[str, float]:
    """Offset to the mean distance over columns (K, frames, d), over the episodes in which one moves."""
    moving = [window for window in windows if not np.isnan(window).all()]
    parts = [_centred(window) if displaced else window for window in moving]
    distances = np.concatenate([np.sqrt(np.nansum(np.square(part), axis=2)) for part in parts], axis=1)
    return {str(k): float(value) for k, value in zip(OFFSETS, distances.mean(axis=1), strict=True)}
