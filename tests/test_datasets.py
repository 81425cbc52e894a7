"""Demonstrators, recipes and the dataset writer."""

from collections import Counter
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

from lerobot_swr.cli import dataset as dataset_command
from lerobot_swr.demos.catalog import RECIPES
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import ONLY_FORWARD, _recipe, steady
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, move
from lerobot_swr.envs.maze2d.layouts import LAYOUTS
from lerobot_swr.trajectories import load_trajectories

KEYS = ["observation.state", "observation.environment_state", "action"]
MAZES = [name for name in RECIPES if name.startswith("medium_maze")]


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture
def tiny_recipe():
    return _recipe("tiny", "small", {"10": 2, "20": 1}, steady)


@pytest.mark.parametrize("name", MAZES)
def test_recorded_actions_lead_from_state_to_state(name):
    """Every demonstration is a true episode of the maze and ends in the goal with its behaviour."""
    layout = LAYOUTS["medium"]
    recipe = RECIPES[name]
    for demonstration in islice(recipe.demonstrations(0), 10):
        states = demonstration.observations["observation.state"].astype(np.float64)
        displacements = demonstration.actions[:-1].astype(np.float64) * MAX_STEP
        np.testing.assert_allclose(move(states[:-1], displacements, layout), states[1:], atol=2e-7)
        assert recipe.behavior_rule(demonstration.observations).endswith("0")
        assert np.linalg.norm(states[-1] - layout.goal) <= layout.goal_radius


def test_the_behaviour_histograms_are_those_of_the_recipes():
    """one_side is balanced, only_forward has all 12 behaviours unbalanced, 100 episodes each."""
    shown = {
        name: Counter(
            map(RECIPES[name].behavior_rule, (d.observations for d in RECIPES[name].demonstrations(3)))
        )
        for name in MAZES
    }
    assert shown["medium_maze-one_side"] == {"6410": 50, "7420": 50}
    assert shown["medium_maze-only_forward"] == ONLY_FORWARD
    assert all(sum(counts.values()) == 100 for counts in shown.values())


def test_only_fast_has_a_fifth_of_its_lengths_in_the_control_band():
    """Episodes of 70 to 80 steps are about a fifth of those of three seeds."""
    recipe = RECIPES["medium_maze-only_fast"]
    lengths = np.array([len(d.actions) for seed in range(3) for d in recipe.demonstrations(seed)])
    assert 0.15 <= np.mean((lengths >= 70) & (lengths <= 80)) <= 0.28


def test_the_same_seed_writes_the_same_bytes_and_another_one_does_not(tiny_recipe, tmp_path):
    """All files, byte for byte."""
    for folder, seed in (("a", 0), ("b", 0), ("c", 1)):
        write_dataset(tiny_recipe, tmp_path / folder, seed)
    assert files(tmp_path / "a") == files(tmp_path / "b")
    assert files(tmp_path / "a") != files(tmp_path / "c")


def test_a_dataset_reads_back_as_it_was_demonstrated(tiny_recipe, tmp_path):
    """LeRobot's own reader and ours give the demonstrated values, names, rate and task."""
    write_dataset(tiny_recipe, tmp_path / "tiny", seed=5)
    dataset = LeRobotDataset("local/tiny", root=tmp_path / "tiny")
    trajectories = load_trajectories(LeRobotDatasetMetadata("local/tiny", root=tmp_path / "tiny"), KEYS)
    demonstrations = list(tiny_recipe.demonstrations(5))
    assert len(trajectories) == len(demonstrations) == dataset.num_episodes == 3
    for i, demonstration in enumerate(demonstrations):
        episode = trajectories.episode(i)
        for key, values in {**demonstration.observations, "action": demonstration.actions}.items():
            np.testing.assert_array_equal(episode[key], values)
        item = dataset[int(trajectories.starts[i])]
        np.testing.assert_array_equal(item["action"], demonstration.actions[0])
        assert item["task"] == tiny_recipe.instruction
    assert dataset.fps == tiny_recipe.fps
    assert dataset.features["action"]["names"] == ["dx", "dy"]


def test_an_existing_dataset_is_only_overwritten_when_asked(tiny_recipe, tmp_path):
    """Refused by default, replaced with overwrite; a folder that is no dataset is never touched."""
    root = tmp_path / "tiny"
    write_dataset(tiny_recipe, root, seed=0)
    before = files(root)
    with pytest.raises(FileExistsError, match="--overwrite=true"):
        write_dataset(tiny_recipe, root, seed=1)
    assert files(root) == before
    write_dataset(tiny_recipe, root, seed=1, overwrite=True)
    assert files(root) != before
    (tmp_path / "photos").mkdir()
    with pytest.raises(FileExistsError, match="not a LeRobot dataset"):
        write_dataset(tiny_recipe, tmp_path / "photos", overwrite=True)


def test_an_interrupted_run_leaves_nothing(tiny_recipe, tmp_path):
    """A demonstrator that fails half-way leaves neither a dataset nor temporary files."""

    def failing(seed):
        yield from list(tiny_recipe.demonstrations(seed))[:1]
        raise KeyboardInterrupt

    broken = type(tiny_recipe)(**{**vars(tiny_recipe), "demonstrations": failing})
    with pytest.raises(KeyboardInterrupt):
        write_dataset(broken, tmp_path / "tiny")
    assert list(tmp_path.iterdir()) == []


def test_the_command_prints_the_histogram_and_names_unknown_datasets(
    run_command, tiny_recipe, tmp_path, capsys, monkeypatch
):
    """``lerobot-swr-dataset`` end to end, and its error."""
    monkeypatch.setitem(RECIPES, "tiny", tiny_recipe)
    run_command(dataset_command.main, "--task=tiny", f"--root={tmp_path / 'one'}")
    assert "10    2" in capsys.readouterr().out
    with pytest.raises(SystemExit) as exit_info:
        run_command(dataset_command.main, "--task=maze", f"--root={tmp_path / 'two'}")
    assert exit_info.value.code == 2
    assert "task='maze'" in capsys.readouterr().err


def test_nan_in_the_data_is_named(tiny_recipe, tmp_path):
    """Feature, episode and frame of the first bad value, before any training."""

    def with_nan(seed):
        first, second, *_ = tiny_recipe.demonstrations(seed)
        second.observations["observation.state"][4, 1] = np.nan
        yield from (first, second)

    broken = type(tiny_recipe)(**{**vars(tiny_recipe), "demonstrations": with_nan})
    write_dataset(broken, tmp_path / "tiny")
    meta = LeRobotDatasetMetadata("local/tiny", root=tmp_path / "tiny")
    with pytest.raises(ValueError, match=r"'observation.state' is NaN.*episode 1, frame 4"):
        load_trajectories(meta, KEYS)
