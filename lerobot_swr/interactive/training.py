"""Trains on what was recorded, in a process of its own whose progress the page shows."""

import asyncio
import re
import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PROGRESS = re.compile(r"Training:.*?\| *(\d+)/(\d+)")  # of tqdm
# The command, wherever its script is installed; its progress every second, as a page wants it.
TRAIN = """
from lerobot_swr import progress
progress.LOG_INTERVAL = 1.0
from lerobot_swr.cli.train import main
main()
"""
LAST_WORDS = 12  # lines of the command that are told if it fails


def train_command(
    root: Path, repo_id: str | None, steps: int, output_dir: Path, behavior_rule: str | None
) -> list[str]:
    """The command line that trains `zbc` on a dataset, as a person would type it."""
    rule = [] if behavior_rule is None else [f"--policy.behavior_rule={behavior_rule}"]
    return [
        "lerobot-swr-train",
        "--seeds=0",
        "--policy.type=zbc",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        *rule,
        f"--dataset.repo_id={repo_id or f'local/{root.name}'}",
        f"--dataset.root={root}",
        "--batch_size=16",
        f"--steps={steps}",
        f"--output_dir={output_dir}",
    ]


def new_folder(root: Path) -> Path:
    """Where the next policy goes: beside the dataset, under a name that is free."""
    number = 1
    while (folder := root.parent / f"{root.name}-zbc-{number}").exists():
        number += 1
    return folder


class Training:
    """One run of the training command.

    Args:
        command: Its command line.
        tell: Takes the state of the training, again and again.

    Attributes:
        folder: Of the trained policy; None until it is there.
    """

    def __init__(self, command: list[str], tell: Callable[[dict[str, Any]], None]):
        self._command, self._tell = command, tell
        self._process: asyncio.subprocess.Process | None = None
        self._lines: list[str] = []
        self._was_stopped = False
        self._started = time.monotonic()
        self.folder: str | None = None

    async def run(self) -> None:
        """Train to the end; failures are told, not raised."""
        self._say("running", done=0, total=0)
        self._process = await asyncio.create_subprocess_exec(
            *[sys.executable, "-c", TRAIN, *self._command[1:]],
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        rest = ""
        while chunk := await self._process.stdout.read(4096):
            *lines, rest = re.split(r"[\r\n]", rest + chunk.decode(errors="replace"))
            for line in filter(str.strip, lines):
                self._read(line)
        status = await self._process.wait()
        if status == 0:
            self.folder = self._lines[-1].strip()
            self._say("done", folder=self.folder)
        elif self._was_stopped:
            self._say("stopped")
        else:
            said = [line for line in self._lines if "error" in line.lower()] or self._lines
            self._say("failed", message=(said[-1:] or [f"status {status}"])[0][:500])

    def stop(self) -> None:
        """End the process; what it has saved stays."""
        self._was_stopped = True
        if self._process is not None and self._process.returncode is None:
            self._process.terminate()

    def _read(self, line: str) -> None:
        if found := PROGRESS.search(line):
            done, total = map(int, found.groups())
            self._say("running", done=done, total=total)
        else:
            self._lines = [*self._lines, line][-LAST_WORDS:]

    def _say(self, state: str, **more: Any) -> None:
        seconds = round(time.monotonic() - self._started, 1)
        command = shlex.join(self._command)
        self._tell({"type": "training", "state": state, "seconds": seconds, "command": command, **more})
