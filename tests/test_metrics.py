"""Behaviour metrics."""

import itertools
from math import comb

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_swr.evaluation.metrics import (
    Interval,
    coverage,
    histogram,
    l1_distance,
    l1_floor,
    l1_interval,
    mean_interval,
    style_fidelity,
    success_entropy,
    success_interval,
)

labels = st.lists(st.sampled_from("abcd"), min_size=1, max_size=30)


@given(labels, st.randoms())
def test_a_histogram_does_not_depend_on_the_order(names, random):
    """Permutation invariance; shares sum to 1."""
    shuffled = random.sample(names, len(names))
    assert histogram(names) == histogram(shuffled)
    assert sum(histogram(names).values()) == pytest.approx(1)


@given(labels, labels)
def test_l1_is_a_metric_between_0_and_2(first, second):
    """Identity gives 0, symmetric, bounded."""
    p, q = histogram(first), histogram(second)
    assert l1_distance(p, p) == 0
    assert l1_distance(p, q) == pytest.approx(l1_distance(q, p))
    assert 0 <= l1_distance(p, q) <= 2 + 1e-12


def test_l1_counts_missing_labels_as_zero():
    """Disjoint histograms are at distance 2; a worked example."""
    assert l1_distance({"a": 1.0}, {"b": 1.0}) == 2
    assert l1_distance({"a": 0.5, "b": 0.5}, {"a": 1.0}) == pytest.approx(1)


def test_the_uniform_floor_equals_the_exact_multinomial_expectation():
    """Two balanced behaviours, 20 rollouts: E|2K/20 − 1| with K binomial, summed exactly."""
    n = 20
    exact = sum(comb(n, k) / 2**n * 2 * abs(k / n - 0.5) for k in range(n + 1))
    floor = l1_floor(["a"] * 5 + ["b"] * 5, n)
    assert floor.mean == pytest.approx(exact, abs=0.01)
    assert floor.band.low <= floor.mean <= floor.band.high


def test_the_stratified_floor_is_zero_for_full_rounds_and_exact_in_between():
    """Each demonstration once has the demonstrations' histogram; 2 of 3 is enumerable."""
    assert l1_floor(["a", "b", "b"], 6, stratified=True).mean == 0
    reference = {"a": 1 / 3, "b": 2 / 3}
    pairs = list(itertools.combinations(["a", "b", "b"], 2))
    exact = np.mean([l1_distance(histogram(pair), reference) for pair in pairs])
    assert l1_floor(["a", "b", "b"], 2, stratified=True).mean == pytest.approx(exact, abs=0.01)


def test_the_floor_knows_which_demonstrations_are_drawn():
    """Drawing only "a" where "a" and "b" were demonstrated can not come nearer than L1 = 1."""
    for stratified in (False, True):
        floor = l1_floor(["a", "b"], 10, stratified=stratified, drawn_from=["a"])
        assert floor.mean == pytest.approx(1)


def test_wilsons_interval_matches_its_formula():
    """Against the closed form with z = 1.96 for 95 of 100."""
    p, n, z = 0.95, 100, 1.959964
    centre, spread = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    interval = success_interval([True] * 95 + [False] * 5)
    assert interval.low == pytest.approx((centre - spread) / (1 + z**2 / n), abs=1e-5)
    assert interval.high == pytest.approx((centre + spread) / (1 + z**2 / n), abs=1e-5)


def test_the_interval_of_a_mean_is_the_normal_one_for_many_values():
    """± 1.96 standard errors for 400 values."""
    values = np.random.default_rng(0).exponential(size=400)
    interval = mean_interval(values.tolist())
    error = 1.96 * values.std() / 20
    assert interval.low == pytest.approx(values.mean() - error, abs=0.2 * error)
    assert interval.high == pytest.approx(values.mean() + error, abs=0.2 * error)


def test_the_bootstrap_interval_narrows_with_rollouts_and_widens_with_differing_seeds():
    """More rollouts mean less noise; seeds that disagree mean more."""
    reference = {"a": 0.5, "b": 0.5}

    def width(labels_by_seed):
        interval = l1_interval(labels_by_seed, reference)
        return interval.high - interval.low

    assert width([["a", "a", "b"] * 200]) < width([["a", "a", "b"] * 5])
    assert width([["a"] * 50, ["a", "b"] * 25]) > width([["a", "b"] * 25, ["a", "b"] * 25])


def test_the_l1_interval_of_stratified_rollouts_is_that_of_their_seeds():
    """A perfect reproducer's is [0, 0]; seeds that differ count as whole seeds, as in a t interval."""
    reference = {"a": 0.5, "b": 0.5}
    perfect, failed = ["a", "b"] * 5, ["x"] * 10
    assert l1_interval([perfect] * 3, reference, stratified=True) == Interval(0, 0)
    shares = np.random.default_rng(0).integers(11, size=60)  # of failures, in tenths
    seeds = [["x"] * k + perfect[: 10 - k] for k in shares.tolist()]
    scores = [l1_distance(histogram(labels), reference) for labels in seeds]
    found = l1_interval(seeds, reference, stratified=True)
    error = 1.96 * np.std(scores, ddof=1) / len(scores) ** 0.5
    assert (found.low, found.high) == pytest.approx(
        (np.mean(scores) - error, np.mean(scores) + error), abs=0.02
    )
    mixed = l1_interval([perfect] * 4 + [failed], reference, stratified=True)
    assert mixed.low == 0
    assert mixed.high > 0.9
    assert l1_interval([perfect], reference, stratified=True).high > 0  # of a single seed: over rollouts


def test_the_l1_interval_is_as_wide_as_the_score_varies():
    """Around the observed value; its width beside that of L1 over repeated experiments."""
    rng = np.random.default_rng(0)
    names, shares = ["a", "b", "c", "d"], [0.4, 0.3, 0.2, 0.1]
    reference = dict(zip(names, [0.25] * 4, strict=True))
    scores, widths = [], []
    for i in range(200):
        labels = rng.choice(names, p=shares, size=100).tolist()
        scores.append(l1_distance(histogram(labels), reference))
        if i < 10:
            interval = l1_interval([labels], reference)
            assert interval.low < scores[-1] < interval.high
            widths.append(interval.high - interval.low)
    assert np.mean(widths) == pytest.approx(2 * 1.96 * np.std(scores), rel=0.25)


def test_entropy_follows_d3ils_convention():
    """Successes only, in units of the log of the number of demonstrated behaviours."""
    names = ["a", "b", "c", "c"]
    assert success_entropy(names, [True, True, False, False], 2) == pytest.approx(1)
    assert success_entropy(names, [True, True, False, False], 4) == pytest.approx(0.5)
    assert success_entropy(names, [False] * 4, 4) == 0


def test_coverage_and_fidelity_count_shares():
    """Worked examples."""
    assert coverage(["a", "x"], {"a": 0.5, "b": 0.5}) == 0.5
    assert style_fidelity(["a", "b", "b"], ["a", "a", "b"]) == pytest.approx(2 / 3)
