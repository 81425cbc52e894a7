"""Perturbations of the D3IL tasks: what they change, and that they change nothing when off."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs.factory import make_env_config

import lerobot_swr  # noqa: F401  registers the environment type
from lerobot_swr.envs.d3il.aligning import AligningEnv
from lerobot_swr.envs.d3il.avoiding import AvoidingEnv

STILL = {AvoidingEnv: np.zeros(2), AligningEnv: np.zeros(3)}


def states(env, seed: int, steps: int = 5) -> np.ndarray:
    """(steps + 1, d) agent positions of an episode without actions."""
    rows = [env.reset(seed=seed)[0]["agent_pos"]]
    rows += [env.step(STILL[type(env)])[0]["agent_pos"] for _ in range(steps)]
    return np.stack(rows)


@pytest.mark.parametrize("task", [AvoidingEnv, AligningEnv])
def test_a_shifted_start_lies_in_its_square_and_the_arm_has_come_to_rest(task):
    """Desired and actual start agree, differ from the usual one by at most the radius, and stay."""
    usual = states(task(), 0)[0]
    n = len(usual) // 2
    shifts = []
    for seed in range(12):
        found = states(task(start_radius=0.03), seed)
        np.testing.assert_allclose(found, found[:1].repeat(6, axis=0), atol=1e-3)
        np.testing.assert_allclose(found[0, :n], found[0, n:], atol=1e-3)
        shifts.append(found[0, :n] - usual[:n])
    shifts = np.stack(shifts)
    assert (np.abs(shifts[:, :2]) <= 0.03).all()
    assert np.abs(shifts[:, :2]).max() > 0.015
    assert (shifts[:, 2:] == 0).all()
    np.testing.assert_array_equal(states(task(start_radius=0.03), 3), states(task(start_radius=0.03), 3))


def test_action_noise_has_its_standard_deviation():
    """Without actions the desired position is a random walk with the given steps."""
    env = AvoidingEnv(action_noise=0.002)
    steps = np.concatenate([np.diff(states(env, seed, 40)[:, :2], axis=0) for seed in range(5)])
    assert steps.std() == pytest.approx(0.002, rel=0.1)
    assert np.abs(steps.mean(axis=0)).max() < 0.0004


@pytest.mark.parametrize("distance", [0.02, 0.05])
def test_a_free_box_is_pushed_as_far_as_asked(distance):
    """A box that nothing touches slides once, by the distance, in a direction that the seed draws."""
    directions = []
    for seed in (0, 1):
        env = AligningEnv(box_push=distance)
        boxes = [env.reset(seed=seed)[0]["environment_state"][:2]]
        boxes += [env.step(STILL[AligningEnv])[0]["environment_state"][:2] for _ in range(180)]
        moved = np.array(boxes[-1]) - boxes[0]
        assert np.linalg.norm(moved) == pytest.approx(distance, rel=0.15)
        moving = np.linalg.norm(np.diff(boxes, axis=0), axis=1) > 1e-4
        first, last = np.flatnonzero(moving)[[0, -1]]
        assert first >= 10
        assert moving[first : last + 1].all()  # a single push
        directions.append(np.arctan2(*moved))
    assert abs(directions[0] - directions[1]) > 0.1


def test_a_pushed_box_stands_in_the_same_context():
    """The same seed draws the same box and target with and without perturbations."""
    plain, pushed = AligningEnv(), AligningEnv(box_push=0.05, start_radius=0.02, action_noise=0.001)
    scenes = [env.reset(seed=7)[0]["environment_state"] for env in (plain, pushed)]
    flat = [0, 1, *range(3, 14)]  # a box that has come to rest stands 9 mm lower
    np.testing.assert_allclose(scenes[0][flat], scenes[1][flat], atol=1e-3)


def test_flags_reach_the_environment_and_bad_ones_are_named():
    """--env.action_noise and so on; avoiding has no box."""
    cfg = make_env_config("d3il", task="aligning", box_push=0.03, start_radius=0.01)
    env = gym.make(cfg.gym_id, **cfg.gym_kwargs).unwrapped
    assert (env._perturbations.box_push, env._perturbations.start_radius) == (0.03, 0.01)
    for options in cfg.perturbations().values():
        make_env_config("d3il", task="aligning", **options)
    with pytest.raises(ValueError, match=r"box_push=0.1.*avoiding task has no box"):
        make_env_config("d3il", task="avoiding", box_push=0.1)
    with pytest.raises(ValueError, match=r"action_noise=-1"):
        make_env_config("d3il", task="avoiding", action_noise=-1)
