"""The D3IL environments as Gymnasium and LeRobot environments."""

import os
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from lerobot.envs.factory import make_env, make_env_config
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from scipy.spatial.transform import Rotation

import lerobot_swr  # noqa: F401  registers the environment type
from lerobot_swr.envs.d3il import rendering
from lerobot_swr.envs.d3il.aligning import AligningEnv
from lerobot_swr.envs.d3il.avoiding import AvoidingEnv
from lerobot_swr.envs.d3il.behavior import aligning_behavior, avoiding_behavior
from lerobot_swr.envs.d3il.layouts import FINISH_LINE_Y
from lerobot_swr.envs.d3il.recorded_starts import vertical_turn

TASKS = ("avoiding", "aligning")


def episode(env, actions, **reset):
    """Roll out; observations by LeRobot's names (T + 1, d) and the last step's answer."""
    observation, info = env.reset(**reset)
    rows, answer = [observation], (0.0, False, False, info)
    for action in actions:
        observation, *answer = env.step(action)
        rows.append(observation)
        if answer[1]:
            break
    return {
        "observation.state": np.stack([row["agent_pos"] for row in rows]),
        "observation.environment_state": np.stack([row["environment_state"] for row in rows]),
    }, answer


@pytest.mark.parametrize("task", TASKS)
def test_check_env_is_clean(task):
    """Gymnasium's own checker finds neither errors nor anything to warn about."""
    env = gym.make(make_env_config("d3il", task=task).gym_id)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("task", TASKS)
def test_episode_is_truncated_at_its_length(task):
    """An idle episode is cut off after `episode_length` steps, by default the benchmark's."""
    assert make_env_config("d3il", task=task).episode_length == {"avoiding": 250, "aligning": 400}[task]
    cfg = make_env_config("d3il", task=task, episode_length=3)
    env = gym.make(cfg.gym_id, **cfg.gym_kwargs)
    env.reset(seed=0)
    idle = np.zeros(env.action_space.shape, np.float32)
    assert [env.step(idle)[3] for _ in range(3)] == [False, False, True]


def test_unknown_task_is_named():
    """A wrong task name is refused with the known ones."""
    with pytest.raises(ValueError, match=r"task='stacking'.*avoiding, aligning"):
        make_env_config("d3il", task="stacking")


def test_avoiding_does_not_depend_on_the_seed():
    """Avoiding always starts the same, and equal actions have equal consequences."""
    actions = np.random.default_rng(0).uniform(-0.005, 0.008, size=(20, 2)).astype(np.float32)
    first, _ = episode(AvoidingEnv(), actions, seed=1)
    second, _ = episode(AvoidingEnv(), actions, seed=2)
    np.testing.assert_array_equal(first["observation.state"], second["observation.state"])


def test_aligning_draws_contexts_from_the_seed():
    """Equal seeds give equal contexts, others do not, all of them in the documented ranges."""
    env = AligningEnv()
    scenes = [env.reset(seed=seed)[0]["environment_state"] for seed in (*range(40), 0)]
    np.testing.assert_array_equal(scenes[0], scenes[-1])
    assert len(np.unique(scenes[:40], axis=0)) == 40
    for x, y, low_y, high_y in ((0, 1, -0.25, -0.1), (7, 8, 0.2, 0.35)):
        values = np.array(scenes)
        assert (values[:, x] >= 0.4).all()
        assert (values[:, x] <= 0.6).all()
        assert (values[:, y] >= low_y).all()
        assert (values[:, y] <= high_y).all()


def test_aligning_takes_contexts_from_options():
    """`reset(options=...)` places box and target; what is not given is drawn."""
    observation, _ = AligningEnv().reset(
        seed=0, options={"box": [0.45, -0.2, 0.5], "target": [0.55, 0.3, -1.0]}
    )
    expected = [
        0.45,
        -0.2,
        0,
        np.cos(0.25),
        0,
        0,
        np.sin(0.25),
        0.55,
        0.3,
        0,
        np.cos(0.5),
        0,
        0,
        -np.sin(0.5),
    ]
    # One millisecond passes at reset: the box has fallen by ten micrometres.
    np.testing.assert_allclose(observation["environment_state"], expected, atol=2e-5)
    drawn, _ = AligningEnv().reset(seed=0, options={"box": [0.45, -0.2, 0.5]})
    assert 0.2 <= drawn["environment_state"][8] <= 0.35


@pytest.mark.parametrize("value", [[0.5, 0.1], "middle", [0.5, np.nan, 0.0], {"x": 1}])
def test_wrong_context_is_explained(value):
    """A malformed context names its key and the expected form."""
    with pytest.raises(ValueError, match=r"options\['target'\].*\[x, y, angle_rad\]"):
        AligningEnv().reset(options={"target": value})


@pytest.mark.parametrize("env_class", [AvoidingEnv, AligningEnv])
def test_an_episode_begins_where_a_recording_does(env_class):
    """At rest in the usual start, one step after it, or at rest elsewhere, as the tool's position says."""
    n = env_class().action_space.shape[0]
    usual = env_class().reset(seed=0)[0]["agent_pos"]
    moving = env_class()
    moving.reset(seed=0)
    moved = moving.step(np.full(n, 0.004))[0]["agent_pos"]
    elsewhere = env_class(start_radius=0.05).reset(seed=0)[0]["agent_pos"]
    for recorded in (usual, moved, elsewhere):
        begun = env_class().reset(seed=0, options={"agent_pos": recorded})[0]["agent_pos"]
        np.testing.assert_allclose(begun, recorded, atol=1e-6)


def test_a_wrong_start_of_the_arm_is_explained():
    """The message names the option and what it holds."""
    with pytest.raises(ValueError, match=r"options\['agent_pos'\].*\[desired_x, desired_y, x, y\]"):
        AvoidingEnv().reset(options={"agent_pos": [0.5, 0.1]})


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 1.2, 3.1])
def test_the_turn_of_a_box_is_read_from_its_quaternion(angle):
    """Also of one that is tilted a little; the sign of the quaternion does not matter."""
    upright = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
    assert vertical_turn(upright) == pytest.approx(angle)
    assert vertical_turn(-upright) == pytest.approx(angle)
    tilted = Rotation.from_euler("ZYX", [angle, 0.05, -0.1])
    assert vertical_turn(tilted.as_quat(scalar_first=True)) == pytest.approx(angle)


@pytest.mark.parametrize("env_class", [AvoidingEnv, AligningEnv])
def test_actions_move_the_desired_position(env_class):
    """The desired position is the start plus the sum of the clipped actions."""
    env = env_class()
    axes = env.action_space.shape[0]
    start = env.reset(seed=0)[0]["agent_pos"][:axes]
    env.step(np.full(axes, 0.004))
    observation, *_ = env.step(np.full(axes, -3.0))
    np.testing.assert_allclose(observation["agent_pos"][:axes], start + 0.004 - 0.05, atol=1e-6)


@pytest.mark.parametrize("action", [np.array([0.0, np.nan]), np.zeros(3)])
def test_impossible_action_is_refused(action):
    """NaN and wrong shapes are errors, not silent physics."""
    env = AvoidingEnv()
    env.reset(seed=0)
    with pytest.raises(ValueError, match="avoiding task takes 2 finite numbers"):
        env.step(action)


def go_to(waypoints, speed=0.008):
    """Actions that lead the desired position of avoiding through waypoints."""
    position, actions = np.array([0.52492847, -0.27973673]), []
    for waypoint in np.array(waypoints):
        n = int(np.ceil(np.linalg.norm(waypoint - position) / speed))
        actions += [(waypoint - position) / n] * n
        position = waypoint
    return actions


def test_avoiding_success_and_mode():
    """Below the first obstacle, through the middle of level 2, above level 3: bits 1, 3 and 5."""
    path = [(0.6, -0.1), (0.5, 0.04), (0.46, 0.12), (0.28, 0.24), (0.28, 0.42)]
    observations, (reward, terminated, _, info) = episode(AvoidingEnv(), go_to(path), seed=0)
    assert terminated
    assert reward == 1.0
    assert info["is_success"]
    assert not info["collision"]
    assert info["mode"].tolist() == [0, 1, 0, 1, 0, 1, 0, 0, 0]
    assert avoiding_behavior(observations) == "bottom-mid-top"
    assert observations["observation.state"][-1, 3] > FINISH_LINE_Y


def test_avoiding_collision_ends_without_success():
    """Running into the first obstacle ends the episode as a failure."""
    observations, (reward, terminated, _, info) = episode(AvoidingEnv(), go_to([(0.5, 0.3)]), seed=0)
    assert terminated
    assert reward == 0.0
    assert info["collision"]
    assert not info["is_success"]
    assert avoiding_behavior(observations) == "collision"


def test_every_env_in_a_process_sees_collisions():
    """Also the second environment detects collisions (in the benchmark only the first in a process does)."""
    AvoidingEnv().reset(seed=0)
    _, (_, _, _, info) = episode(AvoidingEnv(), go_to([(0.5, 0.3)]), seed=0)
    assert info["collision"]


def test_aligning_success_in_a_solved_context():
    """A box that lies on its target is a success at the first step, from outside."""
    options = {"box": [0.5, 0.3, 0.4], "target": [0.505, 0.3, 0.35]}
    observations, (reward, terminated, _, info) = episode(AligningEnv(), [np.zeros(3)] * 3, options=options)
    assert terminated
    assert info["is_success"]
    assert info["mode"] == 1
    assert -0.2 < reward < 0.0
    assert aligning_behavior(observations) == "outside"


@pytest.mark.parametrize(("task", "with_processes"), [("avoiding", False), ("aligning", True)])
def test_vector_environments_agree(task, with_processes):
    """Threaded, synchronous and asynchronous environments return the same numbers for the same seeds."""
    cfg = make_env_config("d3il", task=task, episode_length=12)
    n_envs, axes = 2, cfg.features["action"].shape[0]
    actions = np.random.default_rng(0).uniform(-0.02, 0.02, size=(14, n_envs, axes)).astype(np.float32)

    def record(env):
        observations, _ = env.reset(seed=[5, 6], options={NEW_ROLLOUT_OPTION: True})
        record = [observations]
        for action in actions:
            observations, reward, terminated, truncated, info = env.step(action)
            final = info.get("final_info", {}).get("is_success", np.zeros(n_envs, bool))
            record.append({**observations, "r": reward, "te": terminated, "tr": truncated, "s": final})
        limits = env.call("_max_episode_steps")
        env.close()
        return record, limits

    synchronous, limits = record(make_env(cfg, n_envs)["d3il"][0])
    assert limits == (12, 12)
    others = [cfg.create_rollout_env(n_envs)]
    if with_processes:
        others.append(make_env(cfg, n_envs, use_async_envs=True)["d3il"][0])
    for env in others:
        other, _ = record(env)
        for ours, theirs in zip(synchronous, other, strict=True):
            for key, value in ours.items():
                np.testing.assert_array_equal(value, theirs[key], err_msg=key)
    assert synchronous[12]["tr"].all()


def test_errors_in_a_step_reach_the_caller():
    """An exception in a stepping thread is raised by `step`."""
    env = make_env_config("d3il").create_rollout_env(2)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="finite numbers"):
        env.step(np.full((2, 2), np.nan, np.float32))
    env.close()


def test_registering_needs_no_simulator():
    """Without MuJoCo and numba the type is registered, and making an environment says what to install."""
    code = """
import sys
sys.modules["mujoco"] = None
sys.modules["numba"] = None
import lerobot_swr
from lerobot.envs.factory import make_env_config, make_env
cfg = make_env_config("d3il", task="aligning")
print(cfg.behavior_rule().__name__)
try:
    make_env(cfg)
except ModuleNotFoundError as error:
    print(error)
"""
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ, check=True
    )
    assert "aligning_behavior" in run.stdout
    assert "pip install 'lerobot_policy_swr[d3il]'" in run.stdout


@pytest.mark.parametrize("task", TASKS)
def test_pictures(task):
    """`render` gives a picture with many colours in which something moves."""
    cfg = make_env_config("d3il", task=task, render_height=120, render_width=160)
    env = gym.make(cfg.gym_id, **cfg.gym_kwargs)
    env.reset(seed=0)
    try:
        first = env.render()
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    for _ in range(10):
        env.step(np.full(env.action_space.shape, 0.02, np.float32))
    second = env.render()
    env.close()
    assert first.shape == (120, 160, 3)
    assert first.dtype == np.uint8
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 100
    assert (np.abs(first.astype(int) - second).sum(axis=-1) > 60).mean() > 0.01


def test_missing_opengl_is_explained(monkeypatch):
    """Without an OpenGL renderer everything but `render` works, and `render` names what to install."""

    def no_opengl(module):
        raise ImportError(f"cannot load {module}")

    monkeypatch.setattr(rendering.importlib, "import_module", no_opengl)
    env = AvoidingEnv(render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.zeros(2))
    with pytest.raises(RuntimeError, match=r"no OpenGL renderer .*apt-get install .*MUJOCO_GL=egl"):
        env.render()
