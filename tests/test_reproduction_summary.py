"""Summaries of evaluation cells against numbers worked out by hand, and what eq. 3 and algorithm 1 imply."""

import numpy as np
import pytest

from lerobot_swr.evaluation.metrics import l1_floor
from lerobot_swr.reproduction.style_geometry import input_distribution, teaching_shares
from lerobot_swr.reproduction.summary import difference_interval, length_control, summarize
from lerobot_swr.similarity import Dissimilarity
from lerobot_swr.similarity.measure import DenseSimilarity

DEMONSTRATED = ["a", "a", "b", "b"]


def part(behavior: str, style: list[int | None], length: list[int] | None = None) -> dict:
    """Rollouts with one letter per behaviour; an x is a failure."""
    match = [None if i is None else int(DEMONSTRATED[i] == b) for i, b in zip(style, behavior, strict=True)]
    return {
        "behavior": list(behavior),
        "success": [int(b != "x") for b in behavior],
        "length": length or [10] * len(behavior),
        "style": style,
        "match": match,
    }


def result(*parts: dict, allowed=None) -> dict:
    """A cell with one training seed per part."""
    return {"rollouts": {str(i): {"uniform": p} for i, p in enumerate(parts)}, "allowed": allowed}


def test_a_summary_equals_the_hand_computed_one():
    """Two seeds of four rollouts: shares, L1, fidelity and coverage by hand."""
    first = part("aabb", [0, 1, 2, 3])  # L1 0, all match
    second = part("aaax", [0, 1, 2, 3])  # shares .75, 0 and .25 against .5, .5, 0: L1 1.0; two match
    summary = summarize(result(first, second), "uniform", DEMONSTRATED)
    assert summary.l1_by_seed == [0.0, 1.0]
    assert summary.l1 == 0.5
    assert summary.success.mean == 7 / 8
    assert summary.success.by_seed == [1.0, 0.75]
    assert summary.fidelity is not None
    assert summary.fidelity.by_seed == [1.0, 0.5]
    assert summary.coverage == 0.75
    assert summary.histogram == {"a": 5 / 8, "b": 2 / 8, "x": 1 / 8}
    assert (summary.n_seeds, summary.n_rollouts) == (2, 4)


def test_length_errors_are_those_of_successes_with_the_right_behaviour():
    """Styles 0 to 3 last 8, 9, 10 and 20 steps; of seed 0 all count, of seed 1 two do not."""
    first = part("aabb", [0, 1, 2, 3], [10, 10, 10, 10])  # 2, 1, 0, 10
    second = part("aaax", [0, 1, 2, 3], [11, 9, 99, 99])  # 3, 0
    summary = summarize(result(first, second), "uniform", DEMONSTRATED, [8, 9, 10, 20])
    assert summary.length_error == 1.5
    assert summary.length_error_interval is not None
    assert 0 <= summary.length_error_interval.low <= 1.5 <= summary.length_error_interval.high <= 10
    assert summarize(result(part("xx", [0, 1])), "uniform", DEMONSTRATED, [8, 9]).length_error is None


def test_wilson_interval_of_the_pooled_rollouts():
    """7 of 8, by the closed form."""
    summary = summarize(result(part("aabb", [0] * 4), part("aaax", [0] * 4)), "uniform", DEMONSTRATED)
    n, p, z = 8, 7 / 8, 1.959964
    centre, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    expected = ((centre - half) / (1 + z**2 / n), (centre + half) / (1 + z**2 / n))
    assert (summary.success.interval.low, summary.success.interval.high) == pytest.approx(expected, abs=1e-5)


def test_policies_without_styles_have_no_fidelity():
    """None, not 0."""
    assert summarize(result(part("ab", [None, None])), "uniform", DEMONSTRATED).fidelity is None


def test_the_floor_of_a_filtered_evaluation_is_that_of_the_allowed_styles():
    """Only behaviour a may be drawn: even a perfect reproducer is 1 away from half a, half b."""
    summary = summarize(result(part("aa", [0, 1]), allowed=[0, 1]), "uniform", DEMONSTRATED)
    assert summary.floor.mean == 1.0


def test_averaging_evaluations_keeps_the_floor_and_narrows_its_band():
    """As the mean of five independent scores does: by about the root of five."""
    one, five = (l1_floor(DEMONSTRATED, 100, n_averaged=n) for n in (1, 5))
    assert five.mean == pytest.approx(one.mean, rel=0.05)
    ratio = (one.band.high - one.band.low) / (five.band.high - five.band.low)
    assert ratio == pytest.approx(np.sqrt(5), rel=0.25)


def test_a_difference_within_the_noise_includes_zero_and_a_clear_one_does_not():
    """Against the normal approximation for one seed each; wide where seeds disagree."""
    rng = np.random.default_rng(0)
    low, high = (rng.random(400) < 0.5).astype(float), (rng.random(400) < 0.8).astype(float)
    mean, interval = difference_interval([high], [low])
    error = np.sqrt(high.var() / 400 + low.var() / 400)
    assert mean == pytest.approx(high.mean() - low.mean())
    assert interval.low == pytest.approx(mean - 1.96 * error, abs=0.02)
    assert interval.high == pytest.approx(mean + 1.96 * error, abs=0.02)
    _, none = difference_interval([low], [low])
    assert none.low < 0 < none.high
    _, lottery = difference_interval([np.ones(100), np.zeros(100)], [np.ones(100), np.zeros(100)])
    assert lottery.high - lottery.low > 1


def test_lengths_are_counted_as_the_demonstrations_are():
    """Three frames after the end: 68 steps are 71 frames, in the band; 60 steps are not."""
    demonstrations = {"length": [70, 75, 80, 99], "frames_after_end": 3}
    cell = result(part("aa", [0, 1], [68, 72]), part("aa", [0, 1], [60, 60]))
    found = length_control(cell, demonstrations, (70, 80))
    assert found.in_band.mean == 0.5
    assert found.in_band.by_seed == [1.0, 0.0]
    # bins from 70, 75 and 80 hold a third each of the demonstrations; a half, a half and none of seed 0
    assert found.l1_by_seed == pytest.approx([1 / 6 + 1 / 6 + 1 / 3, 2.0])
    assert found.l1 == pytest.approx((2 / 3 + 2) / 2)


def test_input_distribution_by_hand():
    """Eq. 3 for two demonstrations of different lengths on a grid of 2 × 2."""
    first = np.array([[0.1, 0.1], [0.1, 0.9]])  # lower left, upper left
    second = np.array([[0.9, 0.1]] * 3 + [[0.9, 0.9]])  # lower right three times, upper right
    rho = input_distribution([first, second], np.array([1.0, 0.5]), grid=2)
    expected = [[0.5 / 2, 0.5 * 0.75 / 2], [0.5 / 2, 0.5 * 0.25 / 2]]
    assert rho == pytest.approx(np.array(expected))
    assert rho.sum() == pytest.approx(0.75)  # the mean weight


def test_teaching_shares_by_hand():
    """Three demonstrations, two of the same behaviour, p = .5."""
    distances = np.array([[0.0, 0.2, 1.0], [0.2, 0.0, 1.0], [1.0, 1.0, 0.0]])  # ν, as the farthest is at 1
    dissimilarity = Dissimilarity(DenseSimilarity(distances), np.arange(3))
    near, far, beta = np.exp(-2 * 0.2) / 4, np.exp(-2.0) / 4, 2.0  # p W / (N - 1)
    shares = teaching_shares(dissimilarity, np.array(["a", "a", "b"]), beta, 0.5)
    totals = [0.5 + near + far] * 2 + [0.5 + 2 * far]
    assert shares["own"] == pytest.approx(np.mean([0.5 / total for total in totals]))
    assert shares["same"] == pytest.approx(np.mean([near / totals[0], near / totals[1], 0]))
    assert sum(shares.values()) == pytest.approx(1)


def test_without_relabelling_a_style_is_taught_by_its_own_demonstration_alone():
    """p = 0 is ZBC."""
    dissimilarity = Dissimilarity(DenseSimilarity(1 - np.eye(4)), np.arange(4))
    shares = teaching_shares(dissimilarity, np.array(["a", "a", "b", "c"]), 10.0, 0.0)
    assert shares == {"own": 1.0, "same": 0.0, "other": 0.0}
