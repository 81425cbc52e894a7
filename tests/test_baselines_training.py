"""The baselines under LeRobot's own commands and this package's evaluation."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from conftest import train_flags
from lerobot.scripts import lerobot_eval
from safetensors.torch import load_file

from lerobot_swr.cli import eval as eval_command

BASELINES = ("ddpm_gpt", "ddpm_act", "beso")
SMALL = ("--policy.dim_model=16", "--policy.n_heads=2")
SMALL_MAZE = ("--env.type=maze2d", "--env.task=small")


def weights(output_dir: Path, step: int) -> dict[str, torch.Tensor]:
    """The saved tensors of a run's checkpoint."""
    return load_file(output_dir / "checkpoints" / f"{step:06d}" / "pretrained_model" / "model.safetensors")


@pytest.mark.parametrize("policy_type", BASELINES)
def test_a_run_resumes_bit_for_bit_and_is_scored(
    lerobot_train_command, run_command, small_maze, tmp_path, policy_type
):
    """Killed and resumed, weights and average equal the uninterrupted run's; both evaluations take them."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    flags = [*SMALL, "--save_freq=4", "--log_freq=4"]
    lerobot_train_command(*train_flags(policy_type, small_maze, whole, 8, *flags))
    shutil.copytree(whole, killed, symlinks=True)
    shutil.rmtree(killed / "checkpoints" / "000008")
    config = killed / "checkpoints" / "000004" / "pretrained_model" / "train_config.json"
    config.write_text(config.read_text().replace(str(whole), str(killed)))
    lerobot_train_command(f"--config_path={config}", "--resume=true")
    expected, resumed = weights(whole, 8), weights(killed, 8)
    assert expected.keys() == resumed.keys()
    for name, value in expected.items():
        assert torch.equal(value, resumed[name]), name
    assert expected["average.n_averaged"] == 8

    path = f"--policy.path={whole / 'checkpoints' / 'last' / 'pretrained_model'}"
    short = ("--env.episode_length=12", f"--dataset.root={small_maze}")
    sizes = ("--n_episodes=5", "--batch_size=3")
    run_command(eval_command.main, path, *SMALL_MAZE, *short, *sizes, f"--output_dir={tmp_path / 'swr'}")
    assert json.loads((tmp_path / "swr" / "behaviors.json").read_text())["n_episodes"] == 5
    run_command(
        lerobot_eval.main,
        *(path, *SMALL_MAZE, "--env.episode_length=12", "--eval.n_episodes=2", "--eval.batch_size=2"),
        *("--eval.use_async_envs=false", f"--output_dir={tmp_path / 'lerobot'}"),
    )
    assert json.loads((tmp_path / "lerobot" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_held_out_episodes_give_a_loss(lerobot_train_command, small_maze, tmp_path, capfd):
    """--dataset.eval_split: the average's loss is logged, training goes on."""
    flags = [*SMALL, "--dataset.eval_split=0.3", "--eval_steps=2", "--log_freq=2"]
    lerobot_train_command(*train_flags("ddpm_gpt", small_maze, tmp_path / "run", 4, *flags))
    assert "".join(capfd.readouterr()).count("eval_loss=") == 2
