"""Figures of an evaluation cell over training seeds and rollouts: pure functions of stored results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_swr.evaluation.checks.length import TOLERANCE, length_bins
from lerobot_swr.evaluation.metrics import (
    Floor,
    Histogram,
    Interval,
    coverage,
    histogram,
    l1_distance,
    l1_floor,
    l1_interval,
    median_interval,
    success_interval,
)

BOOTSTRAP_DRAWS = 4000


@dataclass(frozen=True)
class Rate:
    """A share of rollouts.

    Attributes:
        mean: Over all rollouts of all seeds.
        interval: Wilson's 95 % interval, all rollouts taken as independent.
        by_seed: The share of each training seed.
    """

    mean: float
    interval: Interval
    by_seed: list[float]


@dataclass(frozen=True)
class Summary:
    """An evaluation by one way of drawing styles.

    Attributes:
        protocol: ``uniform`` or ``stratified``.
        n_seeds: Training seeds.
        n_rollouts: Rollouts per seed.
        l1: Mean over seeds of the L1 distance of the behaviour histograms.
        l1_interval: Its 95 % bootstrap interval over seeds and rollouts.
        l1_by_seed: Of each seed.
        floor: What perfect reproducers would score as the mean over as many seeds.
        success: Share of successes.
        length_error: Median difference in length to the style's demonstration, in steps, of successful
            rollouts with its behaviour; None without any.
        length_error_interval: Its 95 % bootstrap interval.
        fidelity: Share of rollouts that show their style's demonstration's behaviour (in a maze: those of its
            doors that lie ahead of the start); None without styles.
        coverage: Mean over seeds of the share of the demonstrated behaviours that were shown.
        histogram: Label to share of all rollouts.
        outcomes: For each seed (n_rollouts, 2): success and, with styles, whether the behaviour matched.
    """

    protocol: str
    n_seeds: int
    n_rollouts: int
    l1: float
    l1_interval: Interval
    l1_by_seed: list[float]
    floor: Floor
    success: Rate
    length_error: float | None
    length_error_interval: Interval | None
    fidelity: Rate | None
    coverage: float
    histogram: Histogram
    outcomes: list[np.ndarray]


def summarize(
    result: Mapping[str, Any],
    protocol: str,
    demonstrated: Sequence[str],
    demonstrated_steps: Sequence[int] | None = None,
) -> Summary:
    """Summarise an evaluation cell's result.

    Args:
        result: Of the cell.
        protocol: One that the cell has.
        demonstrated: The label of every demonstration.
        demonstrated_steps: The steps of every demonstration to its end; None leaves the length error out.
    """
    parts = [by_protocol[protocol] for by_protocol in result["rollouts"].values()]
    labels = [part["behavior"] for part in parts]
    reference = histogram(demonstrated)
    l1_by_seed = [l1_distance(histogram(shown), reference) for shown in labels]
    allowed = result["allowed"]
    styled = all(part["match"][0] is not None for part in parts)
    length_errors = [
        abs(length - demonstrated_steps[style])
        for part in parts
        for length, style, success, match in zip(
            part["length"], part["style"], part["success"], part["match"], strict=True
        )
        if demonstrated_steps is not None and style is not None and success and match
    ]
    matches = [[int(bool(match)) for match in part["match"]] for part in parts]
    return Summary(
        protocol=protocol,
        n_seeds=len(parts),
        n_rollouts=len(labels[0]),
        l1=float(np.mean(l1_by_seed)),
        l1_interval=l1_interval(labels, reference, protocol == "stratified"),
        l1_by_seed=l1_by_seed,
        floor=l1_floor(
            demonstrated,
            len(labels[0]),
            stratified=protocol == "stratified",
            drawn_from=None if allowed is None else [demonstrated[i] for i in allowed],
            n_averaged=len(parts),
        ),
        success=rate([part["success"] for part in parts]),
        length_error=float(np.median(length_errors)) if length_errors else None,
        length_error_interval=median_interval(length_errors) if length_errors else None,
        fidelity=rate(matches) if styled else None,
        coverage=float(np.mean([coverage(shown, reference) for shown in labels])),
        histogram=histogram([label for shown in labels for label in shown]),
        outcomes=[
            np.stack([part["success"], match], axis=1) for part, match in zip(parts, matches, strict=True)
        ],
    )


def rate(outcomes_by_seed: Sequence[Sequence[int]]) -> Rate:
    """A share from 0/1 outcomes of each seed's rollouts."""
    pooled = [bool(outcome) for outcomes in outcomes_by_seed for outcome in outcomes]
    return Rate(
        float(np.mean(pooled)),
        success_interval(pooled),
        [float(np.mean(outcomes)) for outcomes in outcomes_by_seed],
    )


def difference_interval(
    first: Sequence[np.ndarray], second: Sequence[np.ndarray], seed: int = 0
) -> tuple[float, Interval]:
    """Difference of two policies' mean outcome, with its 95 % bootstrap interval over seeds and rollouts.

    Args:
        first: Outcomes of the rollouts of each training seed of one policy.
        second: Those of the other.
        seed: Seed of the bootstrap.

    Returns:
        first − second, and the interval.
    """
    rng = np.random.default_rng(seed)

    def resample(outcomes_by_seed: Sequence[np.ndarray]) -> np.ndarray:
        """(BOOTSTRAP_DRAWS,) means of resampled seeds and rollouts."""
        means = [np.mean(outcomes) for outcomes in outcomes_by_seed]
        sizes = [len(outcomes) for outcomes in outcomes_by_seed]
        chosen = rng.integers(len(means), size=(BOOTSTRAP_DRAWS, len(means)))
        drawn = rng.binomial(np.array(sizes)[chosen], np.array(means)[chosen]) / np.array(sizes)[chosen]
        return drawn.mean(axis=1)

    differences = resample(first) - resample(second)
    mean = float(np.mean([np.mean(o) for o in first]) - np.mean([np.mean(o) for o in second]))
    return mean, Interval(*np.quantile(differences, [0.025, 0.975]).tolist())


@dataclass(frozen=True)
class LengthControl:
    """Lengths of rollouts beside those of the demonstrations in a band.

    Attributes:
        l1: Mean over seeds of the L1 distance of the length histograms, in bins of `BIN_WIDTH` steps.
        l1_interval: Its 95 % bootstrap interval over seeds and rollouts.
        l1_by_seed: Of each seed.
        floor: What perfect reproducers of the demonstrations in the band would score as the mean over as many
            seeds.
        in_band: Share of rollouts within the band, ± `TOLERANCE` steps.
    """

    l1: float
    l1_interval: Interval
    l1_by_seed: list[float]
    floor: Floor
    in_band: Rate


def length_control(
    result: Mapping[str, Any], demonstrations: Mapping[str, Any], band: tuple[int, int]
) -> LengthControl:
    """Lengths of all seeds' uniform rollouts beside those of the demonstrations in a band.

    Args:
        result: Of an evaluation cell.
        demonstrations: Of the dataset's cell.
        band: Shortest and longest length, in frames of the demonstrations.
    """
    low, high = band
    after_end = demonstrations["frames_after_end"]
    expected = length_bins([n for n in demonstrations["length"] if low <= n <= high], low)
    lengths = [
        [n + after_end for n in by_protocol["uniform"]["length"]]
        for by_protocol in result["rollouts"].values()
    ]
    shown = [length_bins(of_seed, low) for of_seed in lengths]
    reference = histogram(expected)
    by_seed = [l1_distance(histogram(bins), reference) for bins in shown]
    return LengthControl(
        l1=float(np.mean(by_seed)),
        l1_interval=l1_interval(shown, reference),
        l1_by_seed=by_seed,
        floor=l1_floor(expected, len(shown[0]), n_averaged=len(shown)),
        in_band=rate(
            [[int(low - TOLERANCE <= n <= high + TOLERANCE) for n in of_seed] for of_seed in lengths]
        ),
    )
