"""Corrective labels on arrays: inverse model, matching, partners, limiter, each beside a slow oracle."""

import numpy as np
import pytest
import torch

from lerobot_swr.corrective.feedback import Feedback
from lerobot_swr.corrective.inverse_model import InverseModel, fit_inverse_model
from lerobot_swr.corrective.labels import CorrectiveLabels
from lerobot_swr.corrective.paths import CANDIDATES, PHASE_WINDOW, DemonstratedPaths
from lerobot_swr.corrective.relative_actions import RelativeActions, Units, target_dimensions
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP
from lerobot_swr.trajectories import Trajectories

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"


def make_trajectories(episodes: list[tuple[np.ndarray, np.ndarray]], **columns: np.ndarray) -> Trajectories:
    """A dataset of (states (T, d), actions (T, A)) per episode."""
    states, actions = (np.concatenate(part).astype(np.float32) for part in zip(*episodes, strict=True))
    lengths = np.array([len(states) for states, _ in episodes])
    return Trajectories(lengths, {STATE: states, ACTION: actions, **columns}, 10, "test")


@pytest.fixture(scope="module")
def maze() -> Trajectories:
    """The first 30 demonstrations of only_forward."""
    demonstrations = get_recipe("medium_maze-only_forward").demonstrations(0)
    chosen = [next(iter_) for iter_ in [iter(demonstrations)] * 30]
    return make_trajectories([(d.observations[STATE], d.actions) for d in chosen])


def servo(lag: float, n_episodes: int = 8, length: int = 150, dim: int = 3) -> Trajectories:
    """Absolute targets that joints follow with a first-order lag; joint k has the target in dimension -k."""
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(n_episodes):
        steps = rng.standard_normal((length, dim))
        speed = np.stack([np.convolve(s, np.ones(25) / 25, "same") for s in steps.T], axis=1)
        targets = speed.cumsum(axis=0) * 0.1
        states = np.zeros((length, dim))
        for t in range(1, length):
            states[t] = states[t - 1] + (targets[t - 1] - states[t - 1]) / lag
        episodes.append((states[:, ::-1].copy(), targets))
    return make_trajectories(episodes)


# --- Inverse model ---


def test_the_gain_of_the_maze_is_found_from_its_demonstrations(maze):
    """An action of 1 moves 0.02 of the side: leading back in h steps takes -1 / (0.02 h), within 10 %."""
    model = fit_inverse_model(maze)
    known = -np.eye(2) / (MAX_STEP * model.horizon)
    assert np.abs(model.gain - known).max() < 0.1 * abs(known[0, 0])
    assert model.corrected.all()
    assert (model.targets == -1).all()
    for horizon in (1, 2):
        found = fit_inverse_model(maze, horizon).gain
        assert np.abs(found + np.eye(2) / (MAX_STEP * horizon)).max() < 0.1 / (MAX_STEP * horizon)


@pytest.mark.parametrize("lag", [4, 8])
def test_targets_and_their_lag_are_found(lag):
    """Actions are targets of joints in another order; h is the lag, where the demonstrated target holds."""
    model = fit_inverse_model(servo(lag))
    assert model.targets.tolist() == [2, 1, 0]
    assert abs(model.horizon - lag) <= 1
    assert np.abs(model.gain).max() < 0.25  # repeating the target is nearly all of the correction
    assert model.corrected.all()


def test_whether_actions_are_targets_can_be_overridden(maze):
    """The user's word holds against the data's."""
    assert (target_dimensions(maze.columns[STATE], maze.columns[ACTION], absolute=True) >= 0).all()
    trajectories = servo(4)
    assert (fit_inverse_model(trajectories, absolute=False).targets == -1).all()


def test_a_dimension_that_states_do_not_explain_is_not_corrected(maze):
    """A third action dimension of noise: R² near 0 and a gain of 0; the others are as they were."""
    noise = np.random.default_rng(0).standard_normal((len(maze.columns[ACTION]), 1)).astype(np.float32)
    columns = {**maze.columns, ACTION: np.concatenate([maze.columns[ACTION], noise], axis=1)}
    model = fit_inverse_model(Trajectories(maze.lengths, columns, 10, "test"))
    assert model.corrected.tolist() == [True, True, False]
    assert model.r2[2] < 0.1
    assert (model.gain[2] == 0).all()
    np.testing.assert_allclose(model.gain[:2], fit_inverse_model(maze).gain)


def test_r2_is_that_of_episodes_that_were_not_fitted():
    """With as many regressors as frames the fit is perfect, the held-out R² is not: nothing is corrected."""
    rng = np.random.default_rng(0)
    episodes = [(rng.standard_normal((6, 10)), rng.standard_normal((6, 2))) for _ in range(4)]
    with pytest.raises(ValueError, match=r"no dimension of the action follows.*R² at most"):
        fit_inverse_model(make_trajectories(episodes), absolute=False)


def test_what_cannot_work_is_refused(maze):
    """One episode; a horizon beyond the episodes."""
    with pytest.raises(ValueError, match=r"single episode.*at least 2"):
        fit_inverse_model(maze.subset([0]))
    with pytest.raises(ValueError, match=r"corrective_horizon=500: expected 1 to"):
        fit_inverse_model(maze, horizon=500)


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_few_episodes_are_enough(maze, count):
    """Every episode is held out once; the gain is that of the maze."""
    model = fit_inverse_model(maze.subset(range(count)), 1)
    np.testing.assert_allclose(np.diag(model.gain), -1 / MAX_STEP, rtol=0.15)
    assert (model.r2 > 0.9).all()


def test_episodes_shorter_than_the_horizon_hold_nothing_out(maze):
    """A single long episode leaves no frames to fit when it is held out: shorter horizons, or the reason."""
    one_step = [(maze.episode(i)[STATE][:2], maze.episode(i)[ACTION][:2]) for i in range(1, 4)]
    few = make_trajectories([(maze.episode(0)[STATE], maze.episode(0)[ACTION]), *one_step])
    assert fit_inverse_model(few).horizon == 1
    with pytest.raises(ValueError, match=r"fewer than 2 of its 4 episodes.*horizon of 2.*a smaller"):
        fit_inverse_model(few, horizon=2)
    single_frames = make_trajectories([(states[:1], actions[:1]) for states, actions in one_step])
    with pytest.raises(ValueError, match=r"fewer than 2 of its 3 episodes.*corrective=none"):
        fit_inverse_model(single_frames)


def test_a_large_dataset_is_fitted_on_evenly_chosen_episodes(maze, monkeypatch):
    """The cost of the fit stays bounded; the gain stays what it is."""
    monkeypatch.setattr("lerobot_swr.corrective.inverse_model.MAX_FRAMES", 800)
    np.testing.assert_allclose(np.diag(fit_inverse_model(maze, 1).gain), -1 / MAX_STEP, rtol=0.1)


# --- Relative actions ---


def test_relative_actions_are_standardised_and_translate_back():
    """In normalised units, whichever they are: mean 0, deviation 1, and exact both ways."""
    rng = np.random.default_rng(0)
    states = rng.normal(5, 2, (500, 3)).astype(np.float32)
    actions = np.stack([states[:, 1] + rng.normal(0.3, 0.01, 500), rng.normal(size=500)], axis=1)
    actions = actions.astype(np.float32)
    state = Units(np.array([0.5, 2.0, 1.0]), np.array([-2.0, 1.0, 0.0]))
    action = Units(np.array([4.0, 3.0]), np.array([-7.0, 0.5]))
    relative = RelativeActions(2, 3)
    relative.fit(states, actions, np.array([1, -1]), state, action)
    normalized_states = torch.from_numpy(state.normalize(states))
    normalized = torch.from_numpy(action.normalize(actions))
    encoded = relative.encode(normalized, normalized_states)
    assert abs(float(encoded[:, 0].mean())) < 1e-2
    assert float(encoded[:, 0].std()) == pytest.approx(1, rel=1e-2)
    torch.testing.assert_close(encoded[:, 1], normalized[:, 1])
    torch.testing.assert_close(relative.decode(encoded, normalized_states), normalized, atol=1e-4, rtol=1e-5)


# --- Paths ---


def test_the_nearest_frame_in_the_window_is_found(maze):
    """Beside a loop over the window in NumPy, with every dimension in units of its range."""
    paths = DemonstratedPaths(maze.columns[STATE], maze.lengths)
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(maze.columns[STATE]), 60)
    states = maze.columns[STATE][rows] + rng.normal(0, 0.1, (60, 2)).astype(np.float32)
    scale = np.ptp(maze.columns[STATE], axis=0)
    for state, row, found in zip(states, rows, paths.nearest(states, rows), strict=True):
        episode = int(np.searchsorted(maze.starts, row, side="right") - 1)
        first = max(maze.starts[episode], row - paths.window)
        last = min(maze.starts[episode] + maze.lengths[episode] - 1, row + paths.window)
        distances = np.linalg.norm((maze.columns[STATE][first : last + 1] - state) / scale, axis=1)
        assert found == first + distances.argmin()


def test_constant_dimensions_do_not_count(maze):
    """A dimension that never changes alters neither distances nor, by its zero range, anything else."""
    constant = np.full((len(maze.columns[STATE]), 1), 3.0, np.float32)
    wider = np.concatenate([maze.columns[STATE], constant], axis=1)
    rows = np.arange(0, 2000, 50)
    plain, wide = (DemonstratedPaths(s, maze.lengths) for s in (maze.columns[STATE], wider))
    shifted = plain.states[rows] + 0.05
    found = wide.nearest(np.concatenate([shifted, np.zeros((len(rows), 1))], axis=1), rows)
    np.testing.assert_array_equal(found, plain.nearest(shifted, rows))


def slow_cost(paths: DemonstratedPaths, trajectories: Trajectories, row: int, episode: int) -> float:
    """Mean distance of a frame's next frames to a whole demonstration, in loops."""
    scale = np.ptp(trajectories.columns[STATE], axis=0)
    own = int(np.searchsorted(trajectories.starts, row, side="right") - 1)
    last = trajectories.starts[own] + trajectories.lengths[own] - 1
    other = trajectories.episode(episode)[STATE]
    nearest = []
    for offset in paths.future:
        state = trajectories.columns[STATE][min(row + offset, last)]
        nearest.append(np.sqrt(np.square((other - state) / scale).mean(axis=1)).min())
    return float(np.mean(nearest))


def test_partners_are_drawn_by_their_cost(maze):
    """Frequencies beside a simulation that draws candidates, and none with the weight of a cost of 0."""
    short = [(maze.episode(i)[STATE][:4], maze.episode(i)[ACTION][:4]) for i in (0, 1, 2)]
    short = [(states + 0.3 * i, actions) for i, (states, actions) in enumerate(short)]
    small = make_trajectories(short)
    paths = DemonstratedPaths(small.columns[STATE], small.lengths)
    draws, bandwidth = 20_000, 0.2
    uniforms = np.random.default_rng(0).random((draws, 2 * CANDIDATES + 1))
    second = np.ones(draws, dtype=int)  # of four frames: a third of its episode is over
    rows, matched, is_near = paths.draw_partners(second, np.arange(3), bandwidth, uniforms)
    others = np.arange(4, 12)
    costs = np.array([slow_cost(paths, small, row, 0) for row in others])
    rng = np.random.default_rng(1)
    progress = rng.uniform(1 / 3 - PHASE_WINDOW, 1 / 3 + PHASE_WINDOW, size=(draws, CANDIDATES))
    candidates = 4 * rng.integers(2, size=(draws, CANDIDATES)) + (4 * progress).astype(int)
    candidates = np.concatenate([candidates, np.full((draws, 1), -1)], axis=1)  # -1: none
    weights = np.exp(-np.append(costs, 0.0)[candidates] / bandwidth)
    place = (weights.cumsum(axis=1) < rng.random((draws, 1)) * weights.sum(axis=1, keepdims=True)).sum(axis=1)
    chosen = candidates[np.arange(draws), place]
    expected = np.bincount(others[chosen[chosen >= 0]], minlength=12) / draws
    found = np.bincount(rows[is_near], minlength=12) / draws
    assert found[:4].sum() == 0
    np.testing.assert_allclose(found, expected, atol=5 * np.sqrt(0.25 * 2 / draws))
    assert is_near.mean() == pytest.approx((chosen >= 0).mean(), abs=0.02)
    assert 0.05 < is_near.mean() < 0.95
    assert ((matched >= 0) & (matched < 4)).all()


def test_only_candidates_become_partners(maze):
    """Episodes outside of training lend no frame."""
    paths = DemonstratedPaths(maze.columns[STATE], maze.lengths)
    candidates = np.array([1, 4, 9, 20])
    own = candidates[np.arange(400) % 4]
    uniforms = np.random.default_rng(0).random((400, 2 * CANDIDATES + 1))
    rows, matched, _ = paths.draw_partners(paths.starts[own] + 30, candidates, 0.1, uniforms)
    assert set(paths.episode[rows].tolist()) == set(candidates.tolist())
    assert (paths.episode[rows] != own).all()
    np.testing.assert_array_equal(paths.episode[matched], own)


def test_a_place_that_is_passed_twice_is_matched_on_the_same_way():
    """Demonstrations go out and come back the same way: frames on the way back are matched there."""
    way = np.concatenate([np.linspace(0, 1, 50), np.linspace(1, 0, 50)])[:, None]
    rng = np.random.default_rng(0)
    episodes = [(way + 0.001 * rng.standard_normal(way.shape), np.gradient(way[:, 0])[:, None])] * 6
    trajectories = make_trajectories(episodes)
    paths = DemonstratedPaths(trajectories.columns[STATE], trajectories.lengths)
    uniforms = np.random.default_rng(0).random((500, 2 * CANDIDATES + 1))
    rows, matched, _ = paths.draw_partners(np.arange(500) % 100, np.arange(6), 0.1, uniforms)
    away_from_the_turn = np.abs(paths.phase[rows] - 0.5) > 0.3
    assert away_from_the_turn.sum() > 100
    same_way = (paths.phase[rows] > 0.5) == (paths.phase[matched] > 0.5)
    assert same_way[away_from_the_turn].all()


def test_partners_lend_where_demonstrations_meet_and_none_where_they_part():
    """Ten demonstrations go together for a half and then ways of their own: each half gets what it can."""
    together, apart = np.linspace(0, 1, 50), np.linspace(0, 1, 50)
    episodes = []
    for angle in np.linspace(-1.5, 1.5, 10):
        first = np.stack([together, 0 * together], axis=1)
        second = first[-1] + 5 * apart[:, None] * np.array([np.cos(angle), np.sin(angle)])
        states = np.concatenate([first, second])
        episodes.append((states, np.gradient(states, axis=0)))
    trajectories = make_trajectories(episodes)
    paths = DemonstratedPaths(trajectories.columns[STATE], trajectories.lengths)
    rows = np.arange(len(paths.states))
    uniforms = np.random.default_rng(0).random((len(rows), 2 * CANDIDATES + 1))
    partners, _, borrowed = paths.draw_partners(rows, np.arange(10), 0.01, uniforms)
    assert borrowed[paths.phase < 0.25].mean() > 0.8
    assert borrowed[paths.phase > 0.85].mean() < 0.2
    assert (np.abs(paths.phase[partners] - paths.phase[rows]) <= PHASE_WINDOW + 0.02).all()


# --- Feedback and labels ---


def test_dimensions_without_a_model_keep_the_demonstrated_action(maze):
    """A gripper that no state predicts stays fully open or closed, however far off the path the arm is."""
    gripper = np.random.default_rng(0).choice([-1.0, 1.0], size=(len(maze.columns[ACTION]), 1))
    actions = np.concatenate([maze.columns[ACTION], gripper.astype(np.float32)], axis=1)
    with_gripper = Trajectories(maze.lengths, {**maze.columns, ACTION: actions}, maze.fps, maze.name)
    feedback = Feedback(with_gripper, fit_inverse_model(with_gripper))
    assert feedback.corrected.tolist() == [True, True, False]
    rows = np.arange(0, len(actions), 10)
    acted = feedback.act(feedback.paths.states[rows] + 0.3, rows)
    np.testing.assert_array_equal(acted[:, 2], actions[rows, 2])
    assert (np.abs(acted[:, :2]) <= feedback.limits[:2] * (1 + 1e-6)).all()


def test_the_limiter_scales_and_never_turns_an_action(maze):
    """Actions keep their direction, end within ± the largest demonstrated magnitude, and small ones stay."""
    feedback = Feedback(maze, fit_inverse_model(maze))
    limits = np.abs(maze.columns[ACTION]).max(axis=0)
    actions = np.random.default_rng(0).normal(0, 2, (300, 2))
    limited = feedback.limit(actions)
    assert (np.abs(limited) <= limits * (1 + 1e-6)).all()
    directions = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (limited, actions))
    np.testing.assert_allclose(*directions, rtol=1e-5)
    small = (np.abs(actions) <= limits).all(axis=1)
    np.testing.assert_array_equal(limited[small], actions[small])
    assert (np.abs(limited[~small]) >= limits * (1 - 1e-6)).any(axis=1).all()
    assert (limited < 0).any()  # backwards, although no demonstration moves backwards
    assert feedback.limit(np.zeros((1, 2))).tolist() == [[0, 0]]


def test_a_target_is_limited_relative_to_the_state():
    """Far from the path an absolute target leads towards it by at most the largest demonstrated lead."""
    trajectories = servo(4)
    feedback = Feedback(trajectories, fit_inverse_model(trajectories))
    lead = np.abs(trajectories.columns[ACTION] - trajectories.columns[STATE][:, ::-1]).max(axis=0)
    rows = np.array([40, 200, 700])
    states = feedback.paths.states[rows] + np.array([5.0, 0, 0])
    moved = feedback.act(states, rows) - states[:, ::-1]
    assert (np.abs(moved) <= lead * (1 + 1e-4)).all()
    assert (moved[:, 2] < 0).all()  # joint 0 is the target of dimension 2


def test_labels_beside_the_path_lead_back_to_it(maze):
    """In the known dynamics, following the labels shrinks the distance to the path threefold in 8 steps."""
    feedback = Feedback(maze, fit_inverse_model(maze))
    rows = maze.starts + 20
    offsets = np.random.default_rng(0).normal(0, 0.05, (len(rows), 2))

    def distance(states: np.ndarray, matched: np.ndarray) -> float:
        nearest = feedback.paths.states[feedback.paths.nearest(states, matched)]
        return float(np.linalg.norm(states - nearest, axis=1).mean())

    states, matched = feedback.paths.states[rows] + offsets, rows
    before = distance(states, matched)
    for _ in range(8):
        matched = feedback.paths.nearest(states, matched)
        states = states + MAX_STEP * np.clip(feedback.act(states, matched), -1, 1)
    assert distance(states, matched) < before / 3
    assert (feedback.paths.phase[matched] > feedback.paths.phase[rows]).mean() > 0.9


@pytest.mark.parametrize("kind", ["noise", "demos"])
def test_labels_are_the_formula_at_the_matched_frame(maze, kind):
    """a' = limit(a_u + J (x - s_u)), recomputed in float64; what actions do not move comes from frame u."""
    clock = np.arange(len(maze.columns[STATE]), dtype=np.float32)[:, None]
    trajectories = Trajectories(maze.lengths, {**maze.columns, ENV: clock}, 10, "t")
    model = fit_inverse_model(trajectories)
    labels = CorrectiveLabels(trajectories, model, kind, 0.1, [STATE, ENV])
    uniforms = np.random.default_rng(0).random((400, labels.draws_per_frame))
    found = labels.draw(uniforms, np.arange(len(trajectories)))

    u = found.observations[ENV][:, 0].astype(int)
    states = found.observations[STATE]
    np.testing.assert_array_equal(np.searchsorted(maze.starts, u, side="right") - 1, found.episodes)
    expected = maze.columns[ACTION][u] + (states - maze.columns[STATE][u]).astype(float) @ model.gain.T
    limits = np.abs(maze.columns[ACTION]).max(axis=0)
    expected /= np.maximum(np.abs(expected / limits).max(axis=1), 1)[:, None]
    np.testing.assert_allclose(found.actions, expected, atol=2e-5)
    owner_of: dict[tuple, set[int]] = {}  # several of a shared start
    for state, episode in zip(maze.columns[STATE], labels.feedback.paths.episode, strict=True):
        owner_of.setdefault(tuple(state), set()).add(int(episode))
    owners = [owner_of.get(tuple(s), set()) for s in states]
    if kind == "demos":
        borrowed = np.array([bool(some) for some in owners])
        np.testing.assert_array_equal(found.borrowed, borrowed)
        assert 0.8 < borrowed.mean() < 1  # the others are noise
        assert all(some != {j} for some, j in zip(owners, found.episodes.tolist(), strict=True) if some)
    else:
        assert not any(owners)


def test_every_frame_of_the_candidates_is_drawn_alike(maze):
    """Counts of demonstrated frames, recognised where the noise is almost none: uniform over all rows."""
    labels = CorrectiveLabels(maze, fit_inverse_model(maze), "noise", 1e-7, [STATE])
    candidates = np.array([2, 3, 11])
    found = labels.draw(np.random.default_rng(0).random((60_000, 4)), candidates)
    lengths = maze.lengths[candidates]
    shares = np.bincount(found.episodes, minlength=len(maze))[candidates] / 60_000
    np.testing.assert_allclose(shares, lengths / lengths.sum(), atol=0.01)
    progress = labels.feedback.paths.phase[
        labels.feedback.paths.nearest_of_episode(found.observations[STATE][:2000], found.episodes[:2000])
    ]
    assert abs(progress.mean() - 0.5) < 0.03
    assert abs(progress.std() - 12**-0.5) < 0.03


def test_noise_is_log_uniform_up_to_the_scale(maze):
    """Standard deviations between a tenth of the scale and the scale, in units of each dimension's range."""
    labels = CorrectiveLabels(maze, fit_inverse_model(maze), "noise", 0.2, [STATE])
    uniforms = np.random.default_rng(0).random((40_000, labels.draws_per_frame))
    uniforms[:, 0] = 0.0  # the first frame
    found = labels.draw(uniforms, np.arange(30)).observations[STATE]
    offsets = (found - maze.columns[STATE][0]) / np.ptp(maze.columns[STATE], axis=0)
    # E[σ²] of a log-uniform σ in [0.02, 0.2] is (0.2² - 0.02²) / (2 ln 10)
    assert np.square(offsets).mean(axis=0) == pytest.approx((0.2**2 - 0.02**2) / (2 * np.log(10)), rel=0.05)
    assert np.abs(offsets.mean(axis=0)).max() < 0.003


def test_noise_leads_as_far_whatever_the_number_of_dimensions(maze):
    """A state of eight dimensions, each coordinate four times: the norm's mean square is that of two."""
    means = []
    for copies in (1, 4):
        columns = {STATE: np.tile(maze.columns[STATE], (1, copies)), ACTION: maze.columns[ACTION]}
        wide = Trajectories(maze.lengths, columns, maze.fps, maze.name)
        labels = CorrectiveLabels(wide, fit_inverse_model(wide), "noise", 0.1, [STATE])
        uniforms = np.random.default_rng(0).random((40_000, labels.draws_per_frame))
        uniforms[:, 0] = 0.0  # the first frame
        offsets = labels.draw(uniforms, np.arange(30)).observations[STATE] - columns[STATE][0]
        means.append(np.square(offsets / np.ptp(columns[STATE], axis=0)).sum(axis=1).mean())
    assert means[1] == pytest.approx(means[0], rel=0.05)


@pytest.mark.parametrize("apart", [0.0, 100.0])
def test_where_no_other_demonstration_is_near_demos_draws_noise(maze, apart):
    """A single candidate, or others far away: the very frames that `noise` draws from the same numbers."""
    episodes = [(maze.episode(i)[STATE] + i * apart, maze.episode(i)[ACTION]) for i in range(6)]
    trajectories = make_trajectories(episodes)
    candidates = np.arange(6) if apart else np.array([3])
    model = fit_inverse_model(maze)
    noise, demos = (CorrectiveLabels(trajectories, model, k, 0.01, [STATE]) for k in ("noise", "demos"))
    uniforms = np.random.default_rng(0).random((200, demos.draws_per_frame))
    found = demos.draw(uniforms, candidates)
    expected = noise.draw(uniforms[:, : noise.draws_per_frame], candidates)
    np.testing.assert_array_equal(found.observations[STATE], expected.observations[STATE])
    np.testing.assert_array_equal(found.actions, expected.actions)


def test_a_gain_of_zero_repeats_the_demonstrated_action(maze):
    """Without a gain the label is the matched frame's action."""
    model = InverseModel(3, np.zeros((2, 2)), np.zeros(2), np.full(2, -1))
    feedback = Feedback(maze, model)
    rows = np.array([5, 100])
    acted = feedback.act(feedback.paths.states[rows] + 0.1, rows)
    np.testing.assert_array_equal(acted, maze.columns[ACTION][rows])
