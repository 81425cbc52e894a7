"""``lerobot-swr-train`` in this process, and in a process of its own that is killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_swr.cli import train as train_command


@pytest.fixture
def swr_train(run_command: Callable[..., None]) -> Callable[..., None]:
    """Runs ``lerobot-swr-train`` in this process."""

    def run(*flags: str) -> None:
        run_command(train_command.main, *flags)

    return run


def swr_train_killed_at(checkpoint: Path, flags: list[str]) -> None:
    """Run the command until the folder `checkpoint` is there, then kill -9; wait for its processes' end."""
    process = subprocess.Popen(
        [sys.executable, "-c", "from lerobot_swr.cli.train import main; main()", *flags],
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not checkpoint.is_dir():
        assert process.poll() is None
        time.sleep(0.01)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.send_signal(signal.SIGKILL)
    process.wait()
    for child in children:
        while Path(f"/proc/{child}").is_dir():  # ends by itself, or the test's time limit tells
            time.sleep(0.05)
