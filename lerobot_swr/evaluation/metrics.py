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

    def __format__(self, spec: str) -> str:
        """Both ends in brackets, each as `spec` says."""
        return f"[{self.low:{spec}}, {self.high:{spec}}]"


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
    labels_by_seed: Sequence[Sequence[str]], reference: Mapping[str, float], stratified: bool = False
) -> Interval:
    """Bootstrap 95 % interval of the mean L1 over training seeds and, within a seed, over rollouts.

    Resampled histograms are noisier than the observed ones, which moves all scores upwards: the interval is
    that of their deviations from their own mean, around the observed value.

    Args:
        labels_by_seed: For each training seed the labels of its rollouts.
        reference: Histogram of the demonstrations.
        stratified: Every style was used equally often. Resampled rollouts would no longer be stratified, so
            whole seeds are resampled, if there are several; deviations are widened by √(n / (n − 1)), by
            which the mean of n resampled seeds varies too little.
    """
    rng = np.random.default_rng(0)
    names = sorted({label for labels in labels_by_seed for label in labels} | set(reference))
    place = {label: i for i, label in enumerate(names)}
    goal = np.array([reference.get(label, 0.0) for label in names])
    counts = np.stack(
        [np.bincount([place[label] for label in labels], minlength=len(names)) for labels in labels_by_seed]
    )  # (seeds, labels)
    totals = counts.sum(axis=1)
    by_seed = np.abs(counts / totals[:, None] - goal).sum(axis=1)
    n_seeds = len(counts)
    chosen = rng.integers(n_seeds, size=(BOOTSTRAP_DRAWS, n_seeds))
    if stratified and n_seeds > 1:
        scores, widening = by_seed[chosen].mean(axis=1), (n_seeds / (n_seeds - 1)) ** 0.5
    else:
        resampled = rng.multinomial(totals[chosen], (counts / totals[:, None])[chosen])
        shares = resampled / totals[chosen][..., None]  # (draws, seeds, labels)
        scores, widening = np.abs(shares - goal).sum(axis=2).mean(axis=1), 1.0
    deviations = widening * np.quantile(scores - scores.mean(), [0.025, 0.975])
    low, high = by_seed.mean() + deviations
    return Interval(max(float(low), 0.0), min(float(high), 2.0))


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
    return Interval(*np.quantile(np.median(_resampled(values), axis=1), [0.025, 0.975]).tolist())


def mean_interval(values: Sequence[float]) -> Interval:
    """Bootstrap 95 % interval of a mean."""
    return Interval(*np.quantile(_resampled(values).mean(axis=1), [0.025, 0.975]).tolist())


def _resampled(values: Sequence[float]) -> np.ndarray:
    """(draws, n) values, n at a time with replacement."""
    return np.random.default_rng(0).choice(np.asarray(values, float), size=(BOOTSTRAP_DRAWS, len(values)))
