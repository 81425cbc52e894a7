"""How far recordings and observations are apart, and by which shift in time: arrays with a known answer."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_swr.evaluation.time_offsets import best_offset, column_groups, describe, deviations

KEY, SCENE = "observation.state", "observation.environment_state"
NAMES = {KEY: ["x", "y"]}


def wander(seed, n_steps=60, n_columns=2):
    """(T, d) positions that move on at a varying speed and in a varying direction."""
    rng = np.random.default_rng(seed)
    speed = 1 + 0.5 * np.sin(np.arange(n_steps)[:, None] / 7 + rng.uniform(0, 6, n_columns))
    return np.cumsum(speed + 0.2 * rng.standard_normal((n_steps, n_columns)), axis=0)


def late(states, steps):
    """The same states, recorded so many steps late (or early, below 0), in as many frames."""
    shown = np.arange(len(states)) - steps
    return states[np.clip(shown, 0, len(states) - 1)]


def groups_of(recorded, observed, names=NAMES):
    """`column_groups` of one feature."""
    return column_groups([{KEY: r} for r in recorded], [{KEY: o} for o in observed], names)


@pytest.mark.parametrize("steps", range(-3, 4))
def test_a_shift_is_found_with_its_sign(steps):
    """A recording that shows at t what the environment showed at t - k is k steps behind."""
    observed = [wander(seed) for seed in range(5)]
    (group,) = groups_of([late(states, steps) for states in observed], observed)
    assert group.best_offset == steps
    assert group.agreement == 1
    assert group.deviation_by_offset[str(steps)] == pytest.approx(0, abs=1e-12)
    assert min(group.deviation_by_offset, key=group.deviation_by_offset.get) == str(steps)


@pytest.mark.parametrize("steps", [-2, -1, 1, 2])
@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0])
def test_noise_as_large_as_a_step_hides_no_shift(steps, noise):
    """All frames of a column are judged together."""
    rng = np.random.default_rng(0)
    observed = [wander(seed) for seed in range(20)]
    recorded = [late(states, steps) + noise * rng.standard_normal(states.shape) for states in observed]
    assert best_offset(groups_of(recorded, observed)) == steps


@given(st.integers(0, 100), st.floats(0, 3))
def test_noise_alone_is_no_shift(seed, noise):
    """However noisy, a recording in step is said to be in step."""
    rng = np.random.default_rng(seed)
    observed = [wander(10 * seed + k) for k in range(10)]
    recorded = [states + noise * rng.standard_normal(states.shape) for states in observed]
    groups = groups_of(recorded, observed)
    assert best_offset(groups) == 0
    assert describe(groups) == "the recording and the environment are in step"


@pytest.mark.parametrize("steps", [-2, -1, 1, 2])
def test_a_replay_that_started_from_the_late_state_is_displaced_but_found(steps):
    """Where the start is late as well the whole replay is displaced, and the shift is found all the same."""
    recorded, observed = [], []
    for seed in range(5):
        states = wander(seed, 70)
        recorded.append(states[5 - steps : 65 - steps])
        observed.append(states[5:65] - states[5] + recorded[-1][0])
    (group,) = groups_of(recorded, observed)
    assert group.best_offset == steps
    assert group.displaced
    assert group.deviation_by_offset[str(steps)] == pytest.approx(0, abs=1e-12)


def test_columns_that_are_late_are_told_from_those_in_step():
    """The sentence names the late columns; those that never move say nothing."""
    names = {KEY: ["desired", "actual", "unplugged"], SCENE: ["post"]}
    recorded, observed = [], []
    for seed in range(4):
        states = np.c_[wander(seed), np.full(60, 7.0)]
        observed.append({KEY: states, SCENE: np.full((60, 1), 0.3)})
        recorded.append(
            {KEY: np.c_[states[:, 0], late(states[:, 1], 1), states[:, 2]], SCENE: observed[-1][SCENE]}
        )
    groups = column_groups(recorded, observed, names)
    found = {name: group.best_offset for group in groups for name in group.columns}
    assert found == {"desired": 0, "actual": 1, "unplugged": None, "post": None}
    assert best_offset(groups) == 1
    assert describe(groups) == "the recording is 1 step behind the environment in observation.state (actual)"


def test_different_shifts_are_all_named():
    """The largest group first, each with its own shift; the best offset is that of most columns."""
    names = {KEY: ["a", "b", "c", "d"]}
    observed = [wander(seed, n_columns=4) for seed in range(3)]
    recorded = [np.c_[o[:, 0], late(o[:, 1], -2), late(o[:, 2:], 3)] for o in observed]
    groups = groups_of(recorded, observed, names)
    assert best_offset(groups) == 3
    assert describe(groups) == (
        "the recording is 3 or more steps behind the environment in observation.state (c, d) "
        "and 2 steps ahead of the environment in observation.state (b)"
    )


def test_all_columns_late_need_no_names():
    """A recording that is late as a whole is late, whatever stands still in it."""
    observed = [np.c_[wander(seed)[:, 0], np.ones(60)] for seed in range(3)]
    recorded = [late(states, 1) for states in observed]
    assert describe(groups_of(recorded, observed)) == "the recording is 1 step behind the environment"


def test_a_minority_that_went_otherwise_decides_nothing():
    """Replays that leave their recording for another reason do not outvote those that follow it."""
    observed = [wander(seed) for seed in range(10)]
    recorded = [late(states, 1) for states in observed]
    for k in range(4):
        recorded[k] = recorded[k] + np.linspace(0, 40, 60)[:, None] * [1, -1]
    (group,) = groups_of(recorded, observed)
    assert group.best_offset == 1
    assert group.agreement == pytest.approx(0.6)


def test_ties_are_for_the_smaller_shift():
    """At a constant speed and a free displacement any shift fits; standing still after one step, too."""
    steady = np.linspace(0, 59, 60)[:, None] * [1.0, 2.0]
    for recorded in (steady, steady + 5.0):
        assert best_offset(groups_of([recorded], [recorded])) == 0
    early_step = np.r_[np.zeros((1, 2)), np.ones((59, 2))]
    assert best_offset(groups_of([early_step], [early_step])) == 0


def test_a_steady_motion_is_late_if_its_start_is_not():
    """Where the start is as recorded, a shift at constant speed is seen by the distance that it makes."""
    steady = np.linspace(0, 59, 60)[:, None] * [1.0, 2.0]
    assert best_offset(groups_of([late(steady, 1)], [steady])) == 1


def test_nothing_is_said_of_what_stands_still_or_is_too_short():
    """Neither a column that never moves nor an episode shorter than the shifts can tell."""
    for recorded in (np.ones((60, 2)), wander(0, 6)):
        groups = groups_of([recorded], [recorded + 1])
        assert best_offset(groups) is None
        assert groups[0].deviation_by_offset is None
        assert describe(groups).startswith("nothing moves long enough")


def test_replays_may_be_shorter_or_longer_than_their_recording():
    """An environment that ends early, or has a last state more, is compared where both have frames."""
    observed = [wander(seed, 61) for seed in range(4)]
    recorded = [late(states[:60], 1) for states in observed]
    cut = [observed[0][:20], *observed[1:]]
    assert best_offset(groups_of(recorded, cut)) == 1
    found = deviations([{KEY: recorded[0]}], [{KEY: cut[0]}], NAMES)[KEY]
    assert found.mean == pytest.approx(np.linalg.norm(recorded[0][:20] - cut[0], axis=1).mean())


def test_deviations_are_distances_and_absolute_differences():
    """By hand: two frames, one of them 3 and 4 apart."""
    recorded, observed = np.array([[0.0, 0.0], [1.0, 1.0]]), np.array([[3.0, -4.0], [1.0, 1.0], [9.0, 9.0]])
    found = deviations([{KEY: recorded}], [{KEY: observed}], NAMES)[KEY]
    assert (found.mean, found.largest) == (2.5, 5.0)
    assert found.dimensions == {"x": {"mean": 1.5, "largest": 3.0}, "y": {"mean": 2.0, "largest": 4.0}}
