"""``lerobot-swr-train`` in this process, killed in the middle of a training, and what it leaves."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from held_command import held_command
from safetensors.torch import load_file

from lerobot_swr.cli import train as train_command


@pytest.fixture
def swr_train(run_command: Callable[..., None]) -> Callable[..., None]:
    """Runs ``lerobot-swr-train`` in this process."""

    def run(*flags: str) -> None:
        run_command(train_command.main, *flags)

    return run


def swr_train_killed_at(step: int, flags: list[str], processes: int = 1) -> None:
    """Run the command, kill -9 it alone in a checkpoint, and wait until its processes have ended, too."""
    training_state = rf"/\.?{step:06d}(\.unfinished)?/training_state$"  # the policy is in its folder by then
    with held_command("lerobot_swr.cli.train", flags, training_state, processes) as (command, wait_for_end):
        command.kill()
        wait_for_end()


def assert_same_checkpoint(one: Path, other: Path) -> None:
    """Weights and the whole training state of two checkpoints are equal, bit for bit."""
    for file in ("pretrained_model/model", "training_state/optimizer_state", "training_state/rng_state"):
        expected, found = (load_file(folder / f"{file}.safetensors") for folder in (one, other))
        assert expected.keys() == found.keys()
        for key, value in expected.items():
            assert torch.equal(value, found[key]), (file, key)
    texts = [{p.name: p.read_text() for p in folder.glob("training_state/*.json")} for folder in (one, other)]
    assert texts[0] == texts[1]


def forget_after(step: int, run: Path) -> None:
    """Let a run be as a kill after the checkpoint of a step leaves it."""
    for folder in (run / "checkpoints").iterdir():
        if folder.name.isdigit() and int(folder.name) > step:
            shutil.rmtree(folder)
