"""``lerobot-swr-train`` in this process, killed in the middle of a training, and what it leaves."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
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


def train_in_two_processes(flags: list[str], log: Path) -> str:
    """Run ``lerobot-train`` in two processes (DDP) to its end; gives what it logged.

    Started with torchrun: ``accelerate launch --cpu --num_processes=2`` starts a single one on one machine.
    """
    command = [
        *(sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"),
        *(str(Path(sys.executable).with_name("lerobot-train")), *flags),
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    with log.open("w") as file:
        run = subprocess.Popen(command, env=environment, stdout=file, stderr=file, start_new_session=True)
        while run.poll() is None and "End of training" not in log.read_text():
            time.sleep(0.2)
        with contextlib.suppress(ProcessLookupError):  # torch's gloo can deadlock in processes that end
            os.killpg(run.pid, signal.SIGKILL)
        run.wait()
    logged = log.read_text()
    assert "End of training" in logged, logged[-3000:]
    return logged
