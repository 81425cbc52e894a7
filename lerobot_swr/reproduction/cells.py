"""A cell: one independent piece of the experiments, and where its result is kept.

A finished cell is one JSON file. Its name carries a hash of all that defines the cell, so a cell with other
settings is another cell, and a file that is there is never computed again.
"""

import fcntl
import hashlib
import json
import os
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot_swr.installation import installed_versions
from lerobot_swr.whole_files import write_whole

FORMAT = 2  # of results; another one makes every cell a new one


@dataclass(frozen=True)
class Labels:
    """How tables and pictures call a cell; no part of its identity, but of its files' names.

    So a dataset by another name is computed anew: its results and checkpoints are looked for under that name.

    Attributes:
        dataset: Name of the dataset.
        policy: Name of the policy, with what differs from its defaults; empty where no policy takes part.
        condition: What was measured; ``training`` for a training.
    """

    dataset: str
    policy: str
    condition: str

    def __str__(self) -> str:
        """All of them in one line."""
        return " / ".join(part for part in (self.dataset, self.policy, self.condition) if part)


@dataclass(frozen=True, eq=False)
class Cell:
    """One piece of the experiments; cells with the same key are the same.

    Attributes:
        kind: ``dataset``, ``train``, ``evaluate``, ``styles`` or ``similarity``: who computes it.
        labels: How it is called.
        definition: All that its result depends on, except for `needs`; plain JSON values.
        needs: The training that must be finished first.
    """

    kind: str
    labels: Labels
    definition: Mapping[str, Any]
    needs: "Cell | None" = None

    @cached_property
    def key(self) -> str:
        """Hash of everything that defines the cell."""
        needs = None if self.needs is None else self.needs.key
        content = {"format": FORMAT, "kind": self.kind, "needs": needs, "definition": self.definition}
        text = json.dumps(_plain(content), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def __eq__(self, other: object) -> bool:
        """Whether both have the same key."""
        return isinstance(other, Cell) and self.key == other.key

    def __hash__(self) -> int:
        """Of the key."""
        return hash(self.key)

    @property
    def slug(self) -> str:
        """Name of the cell's file and folder."""
        words = (self.kind, self.labels.dataset, self.labels.policy, self.labels.condition)
        readable = "".join(c if c.isalnum() or c in "-_." else "_" for c in "-".join(filter(None, words)))
        return f"{readable}-{self.key}"


class Store:
    """Where cells keep their results and their work.

    Args:
        root: The experiments' folder. ``results/`` in it holds one small JSON file per finished cell,
            ``work/`` a folder per cell with checkpoints and log.
    """

    def __init__(self, root: Path):
        self.root = Path(root)

    def result_path(self, cell: Cell) -> Path:
        """The file that exists when the cell is finished."""
        return self.root / "results" / f"{cell.slug}.json"

    def work_folder(self, cell: Cell) -> Path:
        """The cell's own folder."""
        return self.root / "work" / cell.slug

    def log_path(self, cell: Cell) -> Path:
        """What the cell's computation printed."""
        return self.work_folder(cell) / "log.txt"

    def is_done(self, cell: Cell) -> bool:
        """Whether the cell's result is there."""
        return self.result_path(cell).is_file()

    def state(self, cell: Cell) -> str:
        """``done``, ``failed`` (in its last attempt) or ``waiting``."""
        if self.is_done(cell):
            return "done"
        return "failed" if self.failure_path(cell).is_file() else "waiting"

    def failure_path(self, cell: Cell) -> Path:
        """The file that a failed attempt leaves and the next attempt removes."""
        return self.work_folder(cell) / "failed.txt"

    def running_path(self, cell: Cell) -> Path:
        """The file that is there while the cell is computed, and stays if that is killed."""
        return self.work_folder(cell) / "running"

    def begin(self, cell: Cell, command: str) -> None:
        """Note that a command computes the cell; see `this_command`."""
        write_whole(self.running_path(cell), command)

    def is_running(self, cell: Cell, command: str) -> bool:
        """Whether an attempt of this command, and not of another one on the same store, has not ended."""
        try:
            return self.running_path(cell).read_text() == command
        except FileNotFoundError:
            return False

    def end(self, cell: Cell, command: str) -> None:
        """Take the command's own note back."""
        if self.is_running(cell, command):
            self.running_path(cell).unlink(missing_ok=True)

    def read(self, cell: Cell) -> dict[str, Any]:
        """The result of a finished cell."""
        return json.loads(self.result_path(cell).read_text())["result"]

    def write(self, cell: Cell, result: Mapping[str, Any], seconds: float) -> None:
        """Finish a cell: its file appears complete or not at all."""
        content = {
            "kind": cell.kind,
            "key": cell.key,
            "labels": cell.labels.__dict__,
            "definition": cell.definition,
            "needs": None if cell.needs is None else cell.needs.key,
            "result": result,
            "provenance": {
                "seconds": round(seconds, 1),
                "versions": installed_versions(),
            },
        }
        write_whole(self.result_path(cell), json.dumps(content, separators=(",", ":")) + "\n")

    @contextmanager
    def lock(self, cell: Cell) -> Iterator[int]:
        """Keep other processes out of the cell's folder.

        Yields:
            A file descriptor that holds the lock as long as any process has it open: given to a training
            process, it makes a new command wait for a training that outlived the command that started it.
        """
        folder = self.work_folder(cell)
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield descriptor
        finally:
            os.close(descriptor)


def this_command() -> str:
    """Host and number of this process, which tell commands apart that work on one store."""
    return f"{socket.gethostname()} {os.getpid()}"


def _plain(value: Any) -> Any:
    """JSON values in which 1 and 1.0, a tuple and a list are the same."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value
