"""Replays: recorded actions, open loop from the recorded start, where they were recorded."""

import json
import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from conftest import SMALL_MAZE
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.d3il_converter import recorded_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.demos.recipe import Demonstration
from lerobot_swr.demos.restricted_pickle import load_recording
from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.evaluation.checks.replay import evaluate_replays
from lerobot_swr.evaluation.open_loop import play
from lerobot_swr.trajectories import dimension_names

STATE, SCENE, ACTION = "observation.state", "observation.environment_state", "action"
MAZE = ("--baseline=replay", "--env.type=maze2d", "--env.task=small")
REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", Path(__file__).parents[2] / "shared"))
HUMAN = REFERENCE / "human_demos" / "d3il_avoiding"


@EnvConfig.register_subclass("without_start_rule")
@dataclass
class StartlessEnvConfig(EnvConfig):
    """An environment that cannot be put into a recorded start."""

    features: dict = field(default_factory=dict)

    @property
    def gym_kwargs(self) -> dict:
        """None are needed."""
        return {}


def late(column, steps):
    """A column, recorded so many steps late (or early, below 0), in as many frames."""
    return column[np.clip(np.arange(len(column)) - steps, 0, len(column) - 1)]


def as_episode(demonstration):
    """Observations and actions of a demonstration."""
    return {**demonstration.observations, ACTION: demonstration.actions}


@pytest.fixture(scope="module")
def maze_recipe():
    """The recipe of `small_maze`."""
    return _recipe("small_maze", "small", SMALL_MAZE, steady)


def replayed(recorded, env_cfg, features, env=None):
    """The result of replaying episodes."""
    env = env or env_cfg.create_rollout_env(len(recorded))
    replays = play(env, recorded, list(map(env_cfg.start_rule(), recorded)), seed=0)
    env.close()
    rule, names = env_cfg.behavior_rule(), {key: features[key] for key in (STATE, SCENE)}
    return evaluate_replays(range(len(recorded)), recorded, replays, names, rule, env.single_action_space)


def test_the_command_says_that_a_dataset_is_in_step(run_command, small_maze, tmp_path, capsys):
    """What was recorded in the environment comes back to rounding: success, behaviour, positions, time."""
    run_command(eval_command.main, *MAZE, f"--dataset.root={small_maze}", f"--output_dir={tmp_path}")
    result = json.loads((tmp_path / "replay.json").read_text())
    assert result["n_episodes"] == 6
    assert result["success_rate"] == result["behavior_match"] == 1
    assert result["success_interval"]["low"] == pytest.approx(0.61, abs=0.01)
    assert result["best_offset"] == 0
    assert result["finding"] == "the recording and the environment are in step"
    assert result["clipped_actions"] == result["cut_short"] == 0
    assert result["deviation"][STATE]["largest"] < 1e-6
    assert set(result["deviation"][STATE]["dimensions"]) == {"x", "y"}
    by_offset = {group["feature"]: group["deviation_by_offset"] for group in result["offsets"]}
    assert by_offset[SCENE] is None
    assert [by_offset[STATE][str(k)] > 0.01 for k in range(-3, 4)] == [True] * 3 + [False] + [True] * 3
    assert [row["episode"] for row in result["episodes"]] == list(range(6))
    assert sorted(row["shown"] for row in result["episodes"]) == ["10"] * 4 + ["20"] * 2
    assert result["provenance"]["policy"] == "replay"
    assert (tmp_path / "replay.png").stat().st_size > 10_000
    assert result["finding"] in capsys.readouterr().out


def test_the_command_says_that_a_dataset_is_late(run_command, maze_recipe, tmp_path, capsys):
    """States one frame late, and only some episodes replayed."""

    def stale(seed):
        for one in maze_recipe.demonstrations(seed):
            yield Demonstration({**one.observations, STATE: late(one.observations[STATE], 1)}, one.actions)

    write_dataset(replace(maze_recipe, demonstrations=stale), tmp_path / "data")
    flags = ("--dataset.episodes=[1,3,4]", "--batch_size=2", f"--output_dir={tmp_path / 'out'}")
    run_command(eval_command.main, *MAZE, f"--dataset.root={tmp_path / 'data'}", *flags)
    result = json.loads((tmp_path / "out" / "replay.json").read_text())
    assert [row["episode"] for row in result["episodes"]] == [1, 3, 4]
    assert result["best_offset"] == 1
    assert "the recording is 1 step behind the environment" in capsys.readouterr().out


@pytest.mark.parametrize("noise", [0.0, 0.004])
@pytest.mark.parametrize("steps", [-2, -1, 1, 2])
def test_a_late_state_is_found_with_its_sign(maze_recipe, steps, noise):
    """The state column alone is shifted, so that an early one starts the replay elsewhere, too."""
    rng = np.random.default_rng(0)
    recorded = [as_episode(one) for one in maze_recipe.demonstrations(0)]
    for episode in recorded:
        shifted = late(episode[STATE], steps)
        shifted[1:] += (noise * rng.standard_normal(shifted[1:].shape)).astype(np.float32)
        episode[STATE] = shifted
    result = replayed(recorded, Maze2DEnvConfig(task="small"), maze_recipe.features)
    assert result.best_offset == steps
    if noise:
        return
    times = "step" if abs(steps) == 1 else "steps"
    way = "behind" if steps > 0 else "ahead of"
    assert result.finding == f"the recording is {abs(steps)} {times} {way} the environment"


def test_other_vector_environments_give_the_same(maze_recipe):
    """Also one that resets a finished episode at once, as LeRobot's default for other packages does."""
    cfg = Maze2DEnvConfig(task="small")
    recorded = [as_episode(one) for one in maze_recipe.demonstrations(0)]
    others = SyncVectorEnv(
        [lambda: gym.make(cfg.gym_id, **cfg.gym_kwargs)] * len(recorded),
        autoreset_mode=AutoresetMode.SAME_STEP,
    )
    ours = replayed(recorded, cfg, maze_recipe.features)
    assert replayed(recorded, cfg, maze_recipe.features, others) == ours
    assert ours.success_rate == 1


def test_clipped_and_cut_short_replays_are_counted(maze_recipe):
    """Actions beyond the action space, and an environment whose step limit comes before the end."""
    recorded = [as_episode(one) for one in maze_recipe.demonstrations(0)]
    recorded[0][ACTION] = 3 * recorded[0][ACTION]
    beyond = (np.abs(recorded[0][ACTION]) > 1).any(axis=1).sum() / sum(len(one[ACTION]) for one in recorded)
    result = replayed(recorded, Maze2DEnvConfig(task="small", episode_length=20), maze_recipe.features)
    assert result.clipped_actions == pytest.approx(beyond)
    assert beyond > 0.1
    assert result.cut_short == 1 - result.success_rate > 0
    assert {row["length"] for row in result.episodes if not row["success"]} == {20}


def test_without_a_rule_behaviors_are_left_out(maze_recipe):
    """Success and deviation need no behaviour rule."""
    cfg, recorded = Maze2DEnvConfig(task="small"), [as_episode(next(maze_recipe.demonstrations(0)))]
    env = cfg.create_rollout_env(1)
    replays = play(env, recorded, list(map(cfg.start_rule(), recorded)), seed=0)
    result = evaluate_replays([0], recorded, replays, {STATE: ["x", "y"]}, None, env.single_action_space)
    assert result.behavior_match is None
    assert result.episodes[0]["recorded"] is None
    assert result.success_rate == 1


@pytest.mark.parametrize(
    ("flags", "messages"),
    [
        (
            ("--env.type=without_start_rule",),
            ("env.type='without_start_rule' cannot be put into a recorded",),
        ),
        (("--env.type=maze2d", "--n_episodes=7"), ("check.type='replay'", "--n_episodes")),
        (("--env.type=maze2d", "--check.type=robustness"), ("baseline='replay'", "'robustness'")),
        (("--env.type=maze2d", "--style_sampling=fixed"), ("check.type='replay'", "--style_sampling")),
        (("--env.type=d3il", "--env.task=aligning"), ("env.task='aligning'", "'observation.state'")),
        ((), ("check.type='replay'", "--env.type")),
    ],
)
def test_what_cannot_be_replayed_is_told_in_one_line(
    run_command, small_maze, tmp_path, capsys, flags, messages
):
    """Environments without a start rule, flags without effect, datasets of another environment."""
    with pytest.raises(SystemExit):
        run_command(
            eval_command.main,
            "--baseline=replay",
            *flags,
            f"--dataset.root={small_maze}",
            f"--output_dir={tmp_path / 'out'}",
        )
    error = capsys.readouterr().err
    assert all(message in error for message in messages)
    assert not (tmp_path / "out").exists()


def arm_episode(env_cfg, actions, seed):
    """An episode of the arm, recorded by hand; the last state is left out."""
    env = env_cfg.create_rollout_env(1)
    observations = [env.reset(seed=seed)[0]]
    observations += [env.step(action[None])[0] for action in actions]
    env.close()
    states, scenes = (
        np.concatenate([o[key] for o in observations[:-1]]) for key in ("agent_pos", "environment_state")
    )
    return {STATE: states, SCENE: scenes, ACTION: actions.astype(np.float32)}


def arm_actions(env_cfg, seed, n_steps=50):
    """Smooth motions of the tool, in aligning down to and through the box."""
    n_axes = env_cfg.features[ACTION].shape[0]
    rng, t = np.random.default_rng(seed), np.arange(n_steps)[:, None]
    waves = 0.004 * np.sin(t / 6 + rng.uniform(0, 6, n_axes))
    towards = np.array([0.0, 0.006, -0.0035])[:n_axes]
    return (towards + waves).astype(np.float32)


@pytest.mark.parametrize("task", ["avoiding", "aligning"])
@pytest.mark.parametrize("start_radius", [0.0, 0.03])
def test_the_arm_repeats_what_it_did(task, start_radius):
    """From the usual start and from shifted ones, where the arm is at rest: the same states again."""
    pytest.importorskip("mujoco")
    cfg = D3ILEnvConfig(task=task, start_radius=start_radius)
    recorded = [arm_episode(cfg, arm_actions(cfg, seed), seed) for seed in range(3)]
    result = replayed(recorded, cfg, get_recipe(f"d3il_{task}").features)
    assert result.best_offset == 0
    assert result.behavior_match == 1
    # At the box contacts make much of a rounding of the recorded start.
    assert result.deviation[STATE].mean < (1e-6 if task == "avoiding" else 5e-4)
    assert result.deviation[SCENE].mean < 2e-3


@pytest.mark.parametrize("task", ["avoiding", "aligning"])
def test_a_recording_that_begins_on_the_way_is_met_there(task):
    """Without its first frames a recording begins with the arm in motion."""
    pytest.importorskip("mujoco")
    cfg = D3ILEnvConfig(task=task)
    whole = arm_episode(cfg, arm_actions(cfg, 0), seed=0)
    recorded = [{key: column[1:] for key, column in whole.items()}]
    result = replayed(recorded, cfg, get_recipe(f"d3il_{task}").features)
    assert result.deviation[STATE].largest < 1e-5


def test_measurements_of_aligning_that_are_late_are_named():
    """Tool and box one frame late, as the benchmark records them; the desired position is not."""
    pytest.importorskip("mujoco")
    cfg = D3ILEnvConfig(task="aligning")
    recorded = [arm_episode(cfg, arm_actions(cfg, seed), seed) for seed in range(3)]
    for episode in recorded:
        episode[STATE] = np.concatenate([episode[STATE][:, :3], late(episode[STATE][:, 3:], 1)], axis=1)
        episode[SCENE] = late(episode[SCENE], 1)
    result = replayed(recorded, cfg, get_recipe("d3il_aligning").features)
    found = {name: group.best_offset for group in result.offsets for name in group.columns}
    assert result.best_offset == 1
    assert [found[f"desired_{axis}"] for axis in "xyz"] == [0, 0, 0]
    assert [found[name] for name in ("x", "y", "z", "box.x", "box.y")] == [1] * 5
    assert found["target.x"] is None
    assert "1 step behind the environment in observation.state (x, y, z)" in result.finding


def test_names_of_dimensions(small_maze_meta: LeRobotDatasetMetadata):
    """Those of the dataset, also under a heading; numbers where it names none."""
    keys = [STATE, ACTION]
    assert dimension_names(small_maze_meta, keys) == {STATE: ["x", "y"], ACTION: ["dx", "dy"]}

    features = {
        "a": {"shape": (2,), "names": {"motors": ["left", "right"]}},
        "b": {"shape": (3,), "names": None},
    }
    assert dimension_names(SimpleNamespace(features=features), ["a", "b"]) == {
        "a": ["left", "right"],
        "b": ["0", "1", "2"],
    }


@pytest.mark.skipif(
    not HUMAN.is_dir(), reason=f"{HUMAN} is absent: LEROBOT_SWR_REFERENCE names the folder of human_demos"
)
def test_human_recordings_of_avoiding_are_in_step_as_converted_and_late_as_recorded():
    """All 96 succeed; measurements are within 1 mm, or one step behind where they are kept as recorded."""
    pytest.importorskip("mujoco")
    recipe, cfg = recorded_recipe(HUMAN, "avoiding"), D3ILEnvConfig(task="avoiding")
    converted = [as_episode(one) for one in recipe.demonstrations(0)]
    result = replayed(converted, cfg, recipe.features)
    assert result.n_episodes == 96
    assert result.success_rate == result.behavior_match == 1
    assert result.best_offset == 0
    assert result.deviation[STATE].mean < 1e-3

    kept = []
    for path, episode in zip(sorted(HUMAN.glob("*.pkl")), converted, strict=True):
        robot = load_recording(path)["robot"]
        state = np.concatenate([robot["des_c_pos"][:-1, :2], robot["c_pos"][:-1, :2]], axis=1)
        kept.append({**episode, STATE: state.astype(np.float32)})
    result = replayed(kept, cfg, recipe.features)
    assert result.success_rate == 1
    assert result.best_offset == 1
    assert result.finding == "the recording is 1 step behind the environment in observation.state (x, y)"
