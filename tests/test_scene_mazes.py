"""Mazes whose start, goal and doors differ from episode to episode, and their datasets."""

from collections import Counter
from itertools import islice

import gymnasium as gym
import numpy as np
import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs import make_env

from lerobot_swr.cli import dataset as dataset_command
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.envs.maze2d import manner as ways
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, move
from lerobot_swr.envs.maze2d.layouts import LAYOUTS
from lerobot_swr.envs.maze2d.scenes import draw_scene, maze_of, scene_names

TASKS = ("scenes", "scenes_large")
STATE, SCENE = "observation.state", "observation.environment_state"


@pytest.mark.parametrize("task", TASKS)
def test_every_episode_draws_its_scene_from_its_seed(task):
    """Same seed, same start, goal and doors; other seeds, others, all within the ranges."""
    layout = LAYOUTS[task]
    env = gym.make(Maze2DEnvConfig(task=task).gym_id, task=task)
    seen = [env.reset(seed=seed)[0] for seed in (*range(200), 0)]
    for key in ("agent_pos", "environment_state"):
        np.testing.assert_array_equal(seen[0][key], seen[-1][key])
    scenes = np.stack([one["environment_state"] for one in seen[:-1]]).astype(float)
    starts = np.stack([one["agent_pos"] for one in seen[:-1]]).astype(float)
    ranges = [*layout.scenes.goal]
    for wall in layout.walls:
        ranges += [(d.x - layout.scenes.door_shift, d.x + layout.scenes.door_shift) for d in wall.doors]
    for column, (low, high) in zip(
        np.concatenate([scenes, starts], 1).T, [*ranges, *layout.scenes.start], strict=True
    ):
        assert low - 1e-6 <= column.min() < low + 0.1 * (high - low)
        assert high + 1e-6 >= column.max() > high - 0.1 * (high - low)
    assert len(scene_names(layout)) == scenes.shape[1]


def test_doors_lie_in_their_wall_and_apart_in_every_scene():
    """However they are drawn, gaps neither meet nor reach the border."""
    for task in TASKS:
        for wall in LAYOUTS[task].walls:
            edges = [0.0]
            for door in sorted(wall.doors, key=lambda door: door.x):
                reach = door.half_width + LAYOUTS[task].scenes.door_shift
                edges += [door.x - reach, door.x + reach]
            assert np.diff([*edges, 1.0])[::2].min() > 0


def test_a_batch_moves_every_agent_in_its_own_maze():
    """n agents at once, each as alone in the maze of its scene; walls are where that scene has them."""
    layout, rng = LAYOUTS["scenes_large"], np.random.default_rng(0)
    scenes = np.stack([draw_scene(layout, rng) for _ in range(200)])
    positions, steps = rng.uniform(0, 1, (200, 2)), rng.uniform(-0.3, 0.3, (200, 2))
    together = move(positions, steps, maze_of(layout, scenes))
    alone = [
        move(p[None], d[None], maze_of(layout, s))[0]
        for p, d, s in zip(positions, steps, scenes, strict=True)
    ]
    np.testing.assert_array_equal(together, alone)
    assert (np.abs(together - np.clip(positions + steps, 0, 1)) > 0.01).any()  # walls were met


@pytest.mark.parametrize("task", TASKS)
def test_an_episode_begins_in_the_scene_that_it_is_given(task):
    """By `reset(options=...)`, as the recorded observations have it, alone and in a batch."""
    cfg = Maze2DEnvConfig(task=task)
    batch = cfg.create_rollout_env(3)
    before, _ = batch.reset(seed=[4, 5, 6])
    recorded = {STATE: before["agent_pos"][2][None], SCENE: before["environment_state"][2][None]}
    mask = np.array([True, False, False])
    after, _ = batch.reset(seed=[1, 2, 3], options={**cfg.start_rule()(recorded), "reset_mask": mask})
    for key in before:
        np.testing.assert_array_equal(after[key][0], before[key][2])
        np.testing.assert_array_equal(after[key][1:], before[key][1:])
    with pytest.raises(ValueError, match=r"options\['environment_state'\].*goal_x and goal_y and door_"):
        batch.reset(options={"environment_state": [0.5, 0.9]})
    with pytest.raises(ValueError, match="this maze's goal does not move"):
        Maze2DEnvConfig().create_rollout_env(1).reset(options={"environment_state": [0.2, 0.9]})


@pytest.mark.parametrize("task", TASKS)
def test_the_batched_environment_agrees_with_lerobots(task):
    """Same seeds and actions, same observations and successes, and features of the right size."""
    cfg = Maze2DEnvConfig(task=task, episode_length=80)
    fast, usual = cfg.create_rollout_env(4), make_env(cfg, n_envs=4, use_async_envs=False)["maze2d"][0]
    rng = np.random.default_rng(1)
    observed = [env.reset(seed=[7, 8, 9, 10])[0] for env in (fast, usual)]
    for _ in range(80):
        for key in ("agent_pos", "environment_state"):
            np.testing.assert_array_equal(observed[0][key], observed[1][key])
            assert cfg.features[key].shape == observed[0][key].shape[1:]
        actions = np.clip(rng.normal([0, 0.5], 1, (4, 2)), -1, 1).astype(np.float32)
        observed = [env.step(actions)[0] for env in (fast, usual)]


@pytest.mark.parametrize(
    ("name", "n_behaviors"), [("scenes_maze-two_ways", 2), ("scenes_large_maze-six_ways", 6)]
)
def test_demonstrations_are_true_episodes_of_their_scenes(name, n_behaviors):
    """Actions lead from state to state in the recorded maze; the label is that of the doors' places."""
    recipe = get_recipe(name)
    layout = LAYOUTS[name.split("_maze-")[0]]
    shown, scenes = Counter(), []
    for demonstration in islice(recipe.demonstrations(0), 30):
        states = demonstration.observations[STATE].astype(np.float64)
        scene = demonstration.observations[SCENE]
        assert (scene == scene[0]).all()
        maze = maze_of(layout, scene[0])
        displacements = demonstration.actions[:-1].astype(np.float64) * MAX_STEP
        np.testing.assert_allclose(move(states[:-1], displacements, maze), states[1:], atol=2e-7)
        assert np.linalg.norm(states[-1] - scene[0, :2]) <= maze.goal_radius
        label = recipe.behavior_rule(demonstration.observations)
        for wall, checkpoint in zip(layout.walls, label[:-1], strict=True):
            t = int(np.argmax(states[:, 1] > wall.y))
            door = scene[0][scene_names(layout).index(f"door_{checkpoint}_x")]
            assert abs(states[t, 0] - door) < 0.1
        shown[label] += 1
        scenes.append(scene[0])
    assert len(shown) == n_behaviors
    assert np.ptp(np.stack(scenes), axis=0).min() > 0.05


def test_the_number_of_demonstrations_is_chosen_by_a_flag(run_command, tmp_path, capsys):
    """``--n_episodes``, as even as it can be; datasets of one size refuse it."""
    run_command(
        dataset_command.main, "--task=scenes_maze-two_ways", f"--root={tmp_path / 'a'}", "--n_episodes=7"
    )
    out = capsys.readouterr().out
    assert "10    4" in out
    assert "20    3" in out
    meta = LeRobotDatasetMetadata("local/a", root=tmp_path / "a")
    assert (meta.total_episodes, meta.robot_type) == (7, "maze2d_scenes")
    assert get_recipe("scenes_maze-two_ways").n_episodes == 100
    assert get_recipe("scenes_maze-two_ways_500").n_episodes == 500
    for flags in (
        ("--task=medium_maze-one_side", "--n_episodes=7"),
        ("--task=scenes_maze-two_ways", "--n_episodes=0"),
    ):
        with pytest.raises(SystemExit):
            run_command(dataset_command.main, f"--root={tmp_path / 'b'}", *flags)
    assert "n_episodes=7: medium_maze-one_side always has 100 episodes" in capsys.readouterr().err


def test_a_recordings_path_blocked_by_other_doors_is_told_apart():
    """The same walk is another behaviour where the scene numbers the gap it took otherwise."""
    rule = Maze2DEnvConfig(task="scenes").behavior_rule()
    walk = np.linspace([0.45, 0.1], [0.45, 0.9], 50)
    left, right = ([0.45, 0.9, 0.41, 0.85], [0.45, 0.9, 0.15, 0.59])
    shown = [rule({STATE: walk, SCENE: np.tile(scene, (50, 1))}) for scene in (left, right)]
    assert shown == ["10", "20"]


@pytest.mark.parametrize(
    ("name", "rule"),
    [("scenes_maze-two_ways", ways.scenes), ("scenes_large_maze-six_ways", ways.scenes_large)],
)
def test_ways_tell_which_door_wherever_it_is(name, rule):
    """In the frame of the doors: near 0 for the leftmost, 1 for the rightmost, and little of the scene."""
    recipe = get_recipe(name)
    layout, rule = LAYOUTS[name.split("_maze-")[0]], getattr(ways, name.split("_maze-")[0])
    for demonstration in islice(recipe.demonstrations(1), 40):
        label = recipe.behavior_rule(demonstration.observations)
        scene = demonstration.observations[SCENE][0]
        for wall, checkpoint, way in zip(
            maze_of(layout, scene).walls, label[:-1], rule(demonstration.observations), strict=True
        ):
            doors = [door.x for door in wall.doors]
            x = next(door.x for door in wall.doors if str(door.checkpoint) == checkpoint)
            width = max(doors) - min(doors)
            assert abs(way - (x - min(doors)) / width) <= wall.doors[0].half_width / width
    still = {STATE: np.full((3, 2), 0.1), SCENE: demonstration.observations[SCENE][:3]}
    np.testing.assert_array_equal(rule(still), [0.5] * len(layout.walls))
