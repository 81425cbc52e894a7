"""Maze2D: dynamics, environments, behaviour rule."""

from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.envs import make_env

from lerobot_swr.envs.maze2d.behavior import MazeBehaviorRule, checkpoints_passed
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, WALL_GAP, move
from lerobot_swr.envs.maze2d.env import Maze2DEnv
from lerobot_swr.envs.maze2d.layouts import LAYOUTS

MEDIUM = LAYOUTS["medium"]
unit = st.floats(0, 1)
coordinate = st.floats(-0.06, 0.06)


@pytest.mark.parametrize("task", LAYOUTS)
@pytest.mark.parametrize("start", ["fixed", "pseudo_random", "random"])
def test_the_environment_follows_gymnasiums_contract(task, start):
    """Spaces, seeding and return types, as Gymnasium's checker wants them."""
    check_env(Maze2DEnv(task=task, start=start, transition_noise=0.5, render_mode="rgb_array"))


@settings(max_examples=300)
@given(st.tuples(unit, unit), st.tuples(coordinate, coordinate), st.booleans())
def test_no_step_passes_a_wall_outside_its_doors(position, displacement, sticky):
    """Wherever an agent steps, it stays in the maze and changes sides of a wall only through a door."""
    before = np.array([position])
    after = move(before, np.array([displacement]), MEDIUM, sticky)
    assert ((after >= 0) & (after <= 1)).all()
    for wall in MEDIUM.walls:
        (x0, y0), (x1, y1) = before[0], after[0]
        if (y0 > wall.y) != (y1 > wall.y):
            x = x0 + (wall.y - y0) / (y1 - y0) * (x1 - x0)
            assert any(abs(x - door.x) <= door.half_width + 1e-9 for door in wall.doors)


def test_a_blocked_agent_slides_or_sticks():
    """Below a closed wall: sliding keeps the motion along the wall, sticky walls keep the agent."""
    position, displacement = np.array([[0.5, 0.245]]), np.array([[0.01, 0.02]])
    np.testing.assert_allclose(move(position, displacement, MEDIUM), [[0.51, 0.25 - WALL_GAP]])
    np.testing.assert_array_equal(move(position, displacement, MEDIUM, sticky_walls=True), position)


def test_actions_beyond_the_range_are_clipped():
    """A step is at most 0.02 of the side per axis."""
    env = Maze2DEnv()
    start, _ = env.reset(seed=0)
    after, *_ = env.step(np.array([5.0, -0.5]))
    np.testing.assert_allclose(after["agent_pos"] - start["agent_pos"], [MAX_STEP, -MAX_STEP / 2], atol=1e-6)


def test_noise_has_the_stated_scale():
    """transition_noise counts in units of the largest step."""
    env = Maze2DEnv(transition_noise=0.5)
    steps = []
    for seed in range(2000):
        before, _ = env.reset(seed=seed)
        after, *_ = env.step(np.zeros(2))
        steps.append(after["agent_pos"] - before["agent_pos"])
    assert np.std(steps) == pytest.approx(0.5 * MAX_STEP, rel=0.05)


def test_starts_lie_where_they_should():
    """Fixed at the layout's start, pseudo-random in its square, random anywhere."""

    def starts(**options):
        env = Maze2DEnv(**options)
        return np.array([env.reset(seed=seed)[0]["agent_pos"] for seed in range(300)])

    assert np.ptp(starts(start="fixed"), axis=0).max() == 0
    near = starts(start="pseudo_random", start_radius=0.05)
    assert (np.abs(near - np.array(MEDIUM.start)) <= 0.05 + 1e-6).all()
    assert np.ptp(near, axis=0).min() > 0.08
    assert np.ptp(starts(start="random"), axis=0).min() > 0.9


@pytest.mark.parametrize("sticky", [False, True])
def test_the_batched_environment_agrees_step_for_step_with_single_ones(sticky):
    """One implementation, two faces: same seeds and actions, same everything, up to each episode's end."""
    options = {"start": "random", "transition_noise": 1.0, "sticky_walls": sticky}
    cfg = Maze2DEnvConfig(task="medium", episode_length=60, **options)
    batch = cfg.create_rollout_env(8)
    singles = [gym.make(cfg.gym_id, **cfg.gym_kwargs) for _ in range(8)]
    rng = np.random.default_rng(0)
    observations, _ = batch.reset(seed=[10 + i for i in range(8)])
    for i, env in enumerate(singles):
        np.testing.assert_array_equal(env.reset(seed=10 + i)[0]["agent_pos"], observations["agent_pos"][i])
    done = np.zeros(8, dtype=bool)
    for _ in range(60):
        actions = rng.uniform(-1, 1, (8, 2))
        observations, reward, terminated, truncated, info = batch.step(actions)
        for i, env in enumerate(singles):
            if done[i]:
                continue
            observation, r, term, trunc, single_info = env.step(actions[i])
            for key in observation:
                np.testing.assert_array_equal(observation[key], observations[key][i])
            assert (r, term, trunc) == (reward[i], terminated[i], truncated[i])
            assert single_info["is_success"] == info["is_success"][i]
        done |= terminated | truncated
    assert done.all()


@pytest.mark.parametrize("use_async", [False, True])
def test_lerobots_vector_environments_work_and_keep_the_last_state(use_async):
    """Sync and async: a finished episode is frozen in its last state, with its success."""
    cfg = Maze2DEnvConfig(task="small", episode_length=5)
    env = make_env(cfg, n_envs=2, use_async_envs=use_async)["maze2d"][0]
    try:
        env.reset(seed=[0, 1])
        for _ in range(8):
            observations, _, terminated, truncated, _ = env.step(np.array([[0, 1], [1, 0]], dtype=np.float32))
        assert (terminated | truncated).all()
        np.testing.assert_allclose(observations["agent_pos"][0], [0.5, 0.08 + 5 * MAX_STEP], atol=1e-6)
        assert env.call("_max_episode_steps") == (5, 5)
    finally:
        env.close()


def test_rendering_shows_maze_and_path():
    """A uint8 picture of the asked size that changes as the agent moves."""
    env = gym.make(Maze2DEnvConfig().gym_id, render_mode="rgb_array", render_size=200)
    env.reset(seed=0)
    before = env.render()
    env.step(np.array([1.0, 1.0], dtype=np.float32))
    assert before.shape == (200, 200, 3)
    assert before.dtype == np.uint8
    assert (env.render() != before).any()


def test_the_rule_names_doors_in_the_order_in_which_they_are_first_passed():
    """Hand-made walks: there and back counts once, the goal ends the label, failures have no 0."""
    door = {6: (0.27, 0.25), 7: (0.73, 0.25), 4: (0.5, 0.5), 1: (0.27, 0.75), 2: (0.73, 0.75)}

    def walk(*points):
        corners = np.array([(0.5, 0.08), *points])
        return np.concatenate(
            [np.linspace(a, b, 20, endpoint=False) for a, b in pairwise(corners)] + [corners[-1:]]
        )

    def through(number):
        x, y = door[number]
        return (x, y - 0.02), (x, y + 0.02)

    goal = MEDIUM.goal
    forward = walk(*through(6), *through(4), *through(1), goal)
    assert checkpoints_passed(forward, MEDIUM) == "6410"
    assert checkpoints_passed(forward[:-5], MEDIUM) == "641"
    detour = walk(*through(6), *reversed(through(7)), *through(6), *through(4), *through(2), goal, (0.1, 0.9))
    assert checkpoints_passed(detour, MEDIUM) == "67420"
    assert checkpoints_passed(forward[:1], MEDIUM) == ""
    assert checkpoints_passed(np.array([goal]), MEDIUM) == "0"
    assert MazeBehaviorRule(MEDIUM)({"observation.state": forward}) == "6410"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "huge"}, "task='huge'.*small, medium, large"),
        ({"start": "anywhere"}, "start='anywhere'"),
        ({"start_radius": -1}, "start_radius=-1"),
        ({"transition_noise": -0.1}, "transition_noise=-0.1"),
        ({"episode_length": 0}, "episode_length=0"),
    ],
)
def test_bad_options_are_named_before_anything_starts(options, message):
    """The configuration refuses them, so no environment or worker is started."""
    with pytest.raises(ValueError, match=message):
        Maze2DEnvConfig(**options)


def test_an_episode_starts_where_it_is_told_to():
    """One agent by `reset(options=...)`, single agents of a batch by Gymnasium's mask; the others stay."""
    env = gym.make(Maze2DEnvConfig().gym_id).unwrapped
    np.testing.assert_allclose(env.reset(options={"agent_pos": [0.2, 0.6]})[0]["agent_pos"], [0.2, 0.6])
    batch = Maze2DEnvConfig(start="random", episode_length=3).create_rollout_env(3)
    before = batch.reset(seed=0)[0]["agent_pos"]
    batch.step(np.zeros((3, 2)))
    mask = np.array([False, True, False])
    after = batch.reset(seed=5, options={"agent_pos": [0.2, 0.6], "reset_mask": mask})[0]["agent_pos"]
    np.testing.assert_array_equal(after[~mask], before[~mask])
    np.testing.assert_allclose(after[1], [0.2, 0.6])
    batch.step(np.zeros((3, 2)))
    np.testing.assert_array_equal(batch.step(np.zeros((3, 2)))[3], ~mask)


@pytest.mark.parametrize("start", [[0.5], [0.5, 1.2], [0.5, np.nan]])
def test_a_start_outside_of_the_maze_is_refused(start):
    """The message names the option."""
    with pytest.raises(ValueError, match=r"options\['agent_pos'\].*x and y in the maze"):
        Maze2DEnvConfig().create_rollout_env(2).reset(options={"agent_pos": start})
