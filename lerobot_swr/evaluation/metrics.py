"""Behaviour metrics: histograms, their L1 distance and its sampling floor, success, entropy, fidelity.

Pure functions of labels; numbers only, no pictures.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

Histogram = dict[str, float]
"""Label to share; the shares sum to 1."""

FLOOR_DRAWS = 4000
BOOTSTRAP_DRAWS = 2000


@dataclass(frozen=True)
class Interval:
    """A 95 % interval.

    Attributes:
        low: Lower end.
        high: Upper end.
    """

    low: float
    high: float


@dataclass(frozen=True)
class Floor:
    """What a perfect reproducer of the demonstrations would score.

    Attributes:
        mean: Expected L1.
        band: The central 95 % of its L1.
    """

    mean: float
    band: Interval


def histogram(labels: Sequence[str]) -> Histogram:
    """Share of each label, most frequent first.

    Raises:
        ValueError: If there are no labels.
    """
    if not labels:
        raise ValueError("labels: a histogram needs at least one episode")
    return {label: count / len(labels) for label, count in Counter(labels).most_common()}


def l1_distance(p: Mapping[str, float], q: Mapping[str, float]) -> float:
    """Σ |p − q| over all labels of either histogram, missing labels counting 0: 0 (equal) to 2 (disjoint)."""
    return float(sum(abs(p.get(label, 0.0) - q.get(label, 0.0)) for label in p.keys() | q.keys()))


def l1_floor(
    reference: Sequence[str],
    n_episodes: int,
    stratified: bool = False,
    drawn_from: Sequence[str] | None = None,
    seed: int = 0,
    n_averaged: int = 1,
) -> Floor:
    """L1 of a perfect reproducer that shows the behaviour of a drawn demonstration in every rollout.

    Source: simulation of the two ways of drawing demonstrations; the uniform one is a multinomial sample of
    the reference histogram.

    Args:
        reference: One label per demonstration.
        n_episodes: Number of rollouts.
        drawn_from: The labels of the demonstrations that are drawn; None draws those of the reference.
        stratified: Draw every demonstration once before any is drawn again; otherwise with replacement.
        seed: Seed of the simulation.
        n_averaged: The score is the mean of this many independent evaluations, which narrows the band.
    """
    names = sorted({*reference, *(drawn_from or ())})
    goal = np.array([reference.count(name) for name in names]) / len(reference)
    counts = np.array([(drawn_from or reference).count(name) for name in names])
    rng = np.random.default_rng(seed)
    shape = (FLOOR_DRAWS, n_averaged)
    if stratified:
        rounds, rest = divmod(n_episodes, int(counts.sum()))
        drawn = rounds * counts + rng.multivariate_hypergeometric(counts, rest, size=shape)
    else:
        drawn = rng.multinomial(n_episodes, counts / counts.sum(), size=shape)  # (draws, averaged, labels)
    distances = np.abs(drawn / n_episodes - goal).sum(axis=2).mean(axis=1)
    return Floor(float(distances.mean()), Interval(*np.quantile(distances, [0.025, 0.975]).tolist()))


def l1_interval(
    labels_by_seed: Sequence[Sequence[str]],
    reference: Mapping[str, float],
    styles_by_seed: Sequence[Sequence[int]] | None = None,
) -> Interval:
    """Bootstrap 95 % interval of the mean L1 over training seeds and, within a seed, over rollouts.

    Resampled histograms are noisier than the observed ones, which moves all scores upwards: the interval is
    that of their deviations from their own mean, around the observed value.

    Args:
        labels_by_seed: For each training seed the labels of its rollouts.
        reference: Histogram of the demonstrations.
        styles_by_seed: The style of each rollout, if styles were stratified: where every seed used the same
            ones, a style's rollout is resampled from those of all seeds, so that the styles stay stratified.
    """
    rng = np.random.default_rng(0)
    names = sorted({label for labels in labels_by_seed for label in labels} | set(reference))
    place = {label: i for i, label in enumerate(names)}
    goal = np.array([reference.get(label, 0.0) for label in names])
    shown = [np.array([place[label] for label in labels]) for labels in labels_by_seed]
    counts = np.stack([np.bincount(labels, minlength=len(names)) for labels in shown])  # (seeds, labels)
    totals = counts.sum(axis=1)
    observed = float(np.abs(counts / totals[:, None] - goal).sum(axis=1).mean())
    by_style = None if styles_by_seed is None else _by_style(shown, styles_by_seed)
    if by_style is not None:  # (seeds, rollouts)
        n_seeds, n_rollouts = by_style.shape
        scores = np.empty(BOOTSTRAP_DRAWS)
        for draw in range(BOOTSTRAP_DRAWS):
            seeds = rng.integers(n_seeds, size=by_style.shape)
            drawn = by_style[seeds, np.arange(n_rollouts)] + len(names) * np.arange(n_seeds)[:, None]
            resampled = np.bincount(drawn.ravel(), minlength=n_seeds * len(names)).reshape(n_seeds, -1)
            scores[draw] = np.abs(resampled / n_rollouts - goal).sum(axis=1).mean()
    else:
        chosen = rng.integers(len(counts), size=(BOOTSTRAP_DRAWS, len(counts)))
        shares = (counts / totals[:, None])[chosen]
        multinomial = rng.multinomial(totals[chosen], shares)  # (draws, seeds, labels)
        scores = np.abs(multinomial / totals[chosen][..., None] - goal).sum(axis=2).mean(axis=1)
    low, high = observed + np.quantile(scores - scores.mean(), [0.025, 0.975])
    return Interval(max(float(low), 0.0), min(float(high), 2.0))


def _by_style(shown: Sequence[np.ndarray], styles_by_seed: Sequence[Sequence[int]]) -> np.ndarray | None:
    """(seeds, rollouts) labels in the order of their styles; None unless all seeds used the same styles."""
    orders = [np.argsort(styles, kind="stable") for styles in styles_by_seed]
    ordered = [np.array(styles)[order] for styles, order in zip(styles_by_seed, orders, strict=True)]
    if any(not np.array_equal(styles, ordered[0]) for styles in ordered):
        return None
    return np.stack([labels[order] for labels, order in zip(shown, orders, strict=True)])


def success_interval(successes: Sequence[bool]) -> Interval:
    """Wilson's 95 % interval of a success rate."""
    interval = stats.binomtest(int(sum(successes)), len(successes)).proportion_ci(method="wilson")
    return Interval(float(interval.low), float(interval.high))


def success_entropy(labels: Sequence[str], successes: Sequence[bool], n_behaviors: int) -> float:
    """Entropy of the behaviours of successful rollouts, in units of log `n_behaviors`.

    D3IL's convention for Avoiding (Jia et al., ICLR 2024): failures are left out and the base of the
    logarithm is the number of behaviours in the demonstrations; 1 is uniform, 0 a single behaviour or no
    success.
    """
    counts = np.array(list(Counter(la for la, ok in zip(labels, successes, strict=True) if ok).values()))
    if len(counts) == 0 or n_behaviors < 2:
        return 0.0
    return float(stats.entropy(counts) / np.log(n_behaviors))


def coverage(labels: Sequence[str], reference: Mapping[str, float]) -> float:
    """Share of the demonstrated behaviours that appear at least once."""
    return len(set(labels) & set(reference)) / len(reference)


def style_fidelity(labels: Sequence[str], requested: Sequence[str]) -> float:
    """Share of rollouts that show the behaviour of the demonstration whose style they used."""
    return float(np.mean([shown == wanted for shown, wanted in zip(labels, requested, strict=True)]))


def median_interval(values: Sequence[float]) -> Interval:
    """Bootstrap 95 % interval of a median."""
    drawn = np.random.default_rng(0).choice(np.asarray(values, float), size=(BOOTSTRAP_DRAWS, len(values)))
    return Interval(*np.quantile(np.median(drawn, axis=1), [0.025, 0.975]).tolist())
