"""``lerobot-swr-train`` for policies that LeRobot's own loop trains, on frames in memory."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import train_flags
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy_config
from safetensors.torch import load_file
from torch.utils.data import DataLoader
from training_command import assert_same_checkpoint

from lerobot_swr.training import SeedsTrainConfig
from lerobot_swr.training.memory_dataset import MemoryDataset
from lerobot_swr.training.seed_runs import drop_incomplete, last_step

SMALL = {
    "beso": ("--policy.dim_model=16", "--policy.n_heads=2"),
    "diffusion": ("--policy.down_dims=[16,32]", "--policy.n_groups=4", "--policy.horizon=8"),
}


@pytest.fixture
def make_dataset(small_maze, small_maze_meta):
    """LeRobot's dataset with the windows of a policy."""

    def make(policy_type: str, episodes: list[int] | None) -> LeRobotDataset:
        config = make_policy_config(policy_type, device="cpu")
        windows = resolve_delta_timestamps(config, small_maze_meta)
        return LeRobotDataset(
            "local/small_maze", root=small_maze, episodes=episodes, delta_timestamps=windows
        )

    return make


@pytest.mark.parametrize("episodes", [None, [1, 4, 5]])
@pytest.mark.parametrize("policy_type", ["ddpm_act", "beso", "diffusion", "wzbc"])
def test_items_are_lerobots(make_dataset, policy_type, episodes):
    """Every item, key by key: values, types, windows at both ends of an episode, padding, task."""
    expected = make_dataset(policy_type, episodes)
    found = MemoryDataset(expected)
    assert len(found) == len(expected) == found.num_frames
    for row, item in enumerate(found.__getitems__(list(range(len(found))))):
        assert item.keys() == expected[row].keys()
        for key, value in expected[row].items():
            if isinstance(value, torch.Tensor):
                torch.testing.assert_close(item[key], value, rtol=0, atol=0)  # and of the same type
            else:
                assert value == item[key], (row, key)


def test_batches_are_lerobots(make_dataset):
    """PyTorch's loader makes the same batches of both."""
    dataset = make_dataset("beso", None)
    batches = zip(DataLoader(dataset, 16), DataLoader(MemoryDataset(dataset), 16), strict=True)
    for expected, found in batches:
        assert expected.keys() == found.keys()
        for key, value in expected.items():
            same = torch.equal(value, found[key]) if isinstance(value, torch.Tensor) else value == found[key]
            assert same, key


def test_images_are_refused(tmp_path):
    """They do not fit into memory; the message says what to use."""
    features = {"observation.images.top": {"dtype": "image", "shape": (8, 8, 3), "names": ["h", "w", "c"]}}
    dataset = LeRobotDataset.create("local/seen", 10, features, root=tmp_path / "seen", use_videos=False)
    for _ in range(2):
        dataset.add_frame({"observation.images.top": np.zeros((8, 8, 3), np.uint8), "task": "look"})
    dataset.save_episode()
    dataset.finalize()
    with pytest.raises(ValueError, match=r"observation.images.top, which do not fit .* use lerobot-train"):
        MemoryDataset(LeRobotDataset("local/seen", root=tmp_path / "seen"))


@pytest.mark.parametrize("policy_type", SMALL)
def test_a_seed_is_trained_as_lerobot_train_does(
    lerobot_train_command, swr_train, small_maze, tmp_path, policy_type
):
    """Bit for bit, over more than an epoch."""
    flags = [*SMALL[policy_type], "--dataset.episodes=[0,4]", "--log_freq=5"]
    common = (policy_type, small_maze)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # another number would round otherwise
    lerobot_train_command(*train_flags(*common, tmp_path / "one", 20, *flags, "--seed=3"))
    torch.set_num_threads(threads)
    swr_train(*train_flags(*common, tmp_path / "all", 20, *flags, "--seeds=3", "--jobs=1"))
    last = Path("checkpoints") / "last"
    assert_same_checkpoint(tmp_path / "one" / last, tmp_path / "all" / "seed_3" / last)


def test_resuming_keeps_what_is_complete(swr_train, small_maze, tmp_path):
    """Half-written checkpoints are trained again, from the last complete one; a missing link is mended."""
    flags = train_flags("beso", small_maze, tmp_path / "run", 4, *SMALL["beso"], "--jobs=1")
    swr_train(*flags, "--seeds=0,1", "--save_freq=2")
    runs = [tmp_path / f"run/seed_{seed}/checkpoints" for seed in (0, 1)]
    model = Path("pretrained_model/model.safetensors")
    kept = [runs[0] / "000002" / model, runs[0] / "000004" / model, runs[1] / "000002" / model]
    before = [file.stat().st_mtime_ns for file in kept]
    # Copies: what was loaded is a view of the file.
    expected = {key: value.clone() for key, value in load_file(runs[1] / "000004" / model).items()}
    for run in runs:  # LeRobot takes the link away before it sets it anew
        (run / "last").unlink()
    (runs[1] / "000004" / model).write_bytes(b"half")
    shutil.rmtree(runs[1] / "000004/training_state")
    swr_train(*flags, "--seeds=0,1", "--save_freq=1", "--resume=true")
    assert [file.stat().st_mtime_ns for file in kept] == before
    found = load_file(runs[1] / "000004" / model)
    assert all(torch.equal(value, expected[key]) for key, value in found.items())
    assert [(run / "last").resolve().name for run in runs] == ["000004", "000004"]
    assert (runs[1] / "000003").is_dir()  # the command's --save_freq, not the run's


def test_without_a_complete_checkpoint_a_run_starts_anew(tmp_path):
    """A kill within the first checkpoint; within a later one only that is dropped."""
    run = SeedsTrainConfig(DatasetConfig("local/small_maze"), output_dir=tmp_path, steps=4).of_seed(0)
    for step, groups in ((2, "[{}]"), (3, "[{}]"), (4, '[{"lr"')):
        state = tmp_path / f"seed_0/checkpoints/{step:06d}/training_state"
        state.mkdir(parents=True)
        (state / "optimizer_param_groups.json").write_text(groups)
    drop_incomplete(run)
    assert last_step(run) == 3
    assert sorted(path.name for path in (tmp_path / "seed_0/checkpoints").iterdir()) == ["000002", "000003"]
    for file in tmp_path.rglob("*.json"):
        file.write_text("")
    drop_incomplete(run)
    assert last_step(run) == 0
    assert not (tmp_path / "seed_0").exists()


def test_an_error_in_training_is_explained(swr_train, small_maze, tmp_path, capfd):
    """What LeRobot's loop refuses in its own process, the command prints."""
    flags = train_flags("beso", small_maze, tmp_path / "run", 4, *SMALL["beso"], "--seeds=0")
    with pytest.raises(SystemExit):
        swr_train(*flags, "--dataset.eval_split=0.99")
    assert "leaves 0 training episodes" in capfd.readouterr().err
