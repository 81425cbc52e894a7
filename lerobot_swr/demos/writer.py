"""Keeps demonstrations one by one, safe from a kill, and writes them into a LeRobotDataset, new or begun."""

import json
import os
import shutil
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from datasets import disable_progress_bars
from filelock import FileLock, Timeout
from lerobot.datasets import LeRobotDataset

from lerobot_swr.demos.columns import number_columns
from lerobot_swr.demos.dataset_writer import add_episode
from lerobot_swr.demos.recipe import Demonstration
from lerobot_swr.whole_files import replacing, write_whole

ACTION = "action/"  # prefix of no observation
COMMIT = "commit.json"
KIND = "kind.json"


@dataclass(frozen=True)
class DatasetKind:
    """What all demonstrations of a dataset share.

    Attributes:
        fps: Frames per second.
        robot_type: Stored in the dataset's metadata.
        instruction: Task string stored with every frame.
        features: LeRobot feature name (observations and ``action``) to the names of its dimensions.
    """

    fps: int
    robot_type: str
    instruction: str
    features: Mapping[str, Sequence[str]]


class DemonstrationWriter:
    """Appends demonstrations to the dataset in `root`, which it makes if there is none.

    What is kept lies in a hidden folder beside `root` until `save` has written it, so that a killed program
    loses nothing of it: the next writer for the same `root` finds it there. The dataset is complete at any
    time: a new one is built beside it and takes its place by renaming.

    Args:
        root: Folder of the dataset.
        kind: What the demonstrations share.
        repo_id: Name of the dataset, by default ``local/<folder>``.

    Raises:
        FileExistsError: If there is something else in `root`.
        ValueError: If the dataset in `root` is of another kind, or another writer is at work on it.
    """

    def __init__(self, root: Path, kind: DatasetKind, repo_id: str | None = None):
        self.root, self.kind = Path(root), kind
        self.repo_id = repo_id or f"local/{self.root.name}"
        self._journal = self.root.parent / f".{self.root.name}-kept"
        self._replaced = self.root.parent / f".{self.root.name}-replaced"
        self.root.parent.mkdir(parents=True, exist_ok=True)
        self._lock = FileLock(self.root.parent / f".{self.root.name}.lock")
        try:
            self._lock.acquire(timeout=0)
        except Timeout as error:
            raise ValueError(
                f"dataset.root={str(root)!r}: another program is recording into this folder; end it first"
            ) from error
        self._recover()
        check_appendable(self.root, kind)
        self._check_kept()

    @property
    def n_saved(self) -> int:
        """Episodes of the dataset."""
        info = self.root / "meta" / "info.json"
        return json.loads(info.read_text())["total_episodes"] if info.is_file() else 0

    def kept(self) -> list[Demonstration]:
        """Demonstrations that are kept and not yet part of the dataset, in order."""
        return [_read(path) for path in self._files()]

    def keep(self, demonstration: Demonstration) -> None:
        """Put a demonstration on the disk, to be saved later; when this returns, a kill does not lose it."""
        files = self._files()
        number = int(files[-1].stem) + 1 if files else 0
        path = self._journal / f"{number:06d}.npz"
        columns = {**demonstration.observations, ACTION: demonstration.actions}
        write_whole(self._journal / KIND, json.dumps(_told(self.kind)))
        with replacing(path) as unfinished, unfinished.open("wb") as file:
            np.savez(file, **columns)  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        _sync_folder(self._journal)

    def undo(self) -> bool:
        """Throw away what was kept last, if it is not saved yet; whether there was any."""
        files = self._files()
        if files:
            files[-1].unlink()
        return bool(files)

    def save(self) -> int:
        """Write what is kept into the dataset; the number of its episodes then."""
        if not self._files():
            return self.n_saved
        building = self._journal / f"building-{uuid.uuid4().hex}"
        self._build(building)
        after = self.n_saved + len(self._files())
        write_whole(self._journal / COMMIT, json.dumps({"building": building.name, "total_episodes": after}))
        self._put_in_place()
        return after

    def close(self) -> None:
        """Let other writers record into the folder; what is kept stays kept."""
        self._lock.release()
        Path(self._lock.lock_file).unlink(missing_ok=True)

    def _build(self, building: Path) -> None:
        """A dataset of the episodes in `root` and those that are kept."""
        if self.root.exists():
            shutil.copytree(self.root, building)
            dataset = LeRobotDataset.resume(self.repo_id, root=building)
        else:
            dataset = LeRobotDataset.create(
                repo_id=self.repo_id,
                fps=self.kind.fps,
                features=number_columns(self.kind.features),
                root=building,
                robot_type=self.kind.robot_type,
                use_videos=False,
            )
        disable_progress_bars()
        try:
            for demonstration in self.kept():
                columns = {**demonstration.observations, "action": demonstration.actions}
                add_episode(dataset, columns, self.kind.instruction)
        finally:
            dataset.finalize()

    def _put_in_place(self) -> None:
        """The rest of `save`, which a later writer may have to do: from here on it goes forward only."""
        commit = json.loads((self._journal / COMMIT).read_text())
        building = self._journal / commit["building"]
        if building.exists():
            if self.root.exists():
                shutil.rmtree(self._replaced, ignore_errors=True)
                _rename(self.root, self._replaced)
            _rename(building, self.root)
            _sync_folder(self.root.parent)
        shutil.rmtree(self._journal)
        shutil.rmtree(self._replaced, ignore_errors=True)

    def _recover(self) -> None:
        """Finish or undo what a killed writer left."""
        if (self._journal / COMMIT).is_file():
            self._put_in_place()
        for unfinished in (*self._journal.glob("building-*"), *self._journal.glob(".*")):
            shutil.rmtree(unfinished) if unfinished.is_dir() else unfinished.unlink()
        if self._replaced.exists() and self.root.exists():
            shutil.rmtree(self._replaced)

    def _check_kept(self) -> None:
        """Refuse demonstrations of another kind that were kept and not saved."""
        file, here = self._journal / KIND, _told(self.kind)
        if not self._files() or not file.is_file():
            return
        there = json.loads(file.read_text())
        for key, value in there.items():
            if value != here[key]:
                raise ValueError(
                    f"dataset.root={str(self.root)!r}: {len(self._files())} demonstrations kept for it and "
                    f"not saved have {key}={value!r}, what is recorded here {key}={here[key]!r}: save "
                    f"them where they were recorded, delete {str(self._journal)!r}, or choose another folder"
                )

    def _files(self) -> list[Path]:
        return sorted(self._journal.glob("[0-9]*.npz"))


def check_folder(root: Path) -> None:
    """Refuse a folder that is neither new nor a dataset's.

    Raises:
        FileExistsError: If there is something else than a dataset.
    """
    if root.exists() and not (root / "meta" / "info.json").is_file():
        raise FileExistsError(
            f"dataset.root={str(root)!r} exists and is not a LeRobot dataset (no meta/info.json); choose "
            "another folder"
        )


def check_appendable(root: Path, kind: DatasetKind) -> None:
    """Refuse a folder to which demonstrations of a kind cannot be added.

    Raises:
        FileExistsError: If there is something else than a dataset.
        ValueError: If the dataset is of another kind.
    """
    check_folder(root)
    if not root.exists():
        return
    info = json.loads((root / "meta" / "info.json").read_text())
    shapes = {key: [len(names)] for key, names in kind.features.items()}
    found = {key: list(ft["shape"]) for key, ft in info["features"].items() if key in shapes or "obs" in key}
    for key, here, there in (
        ("fps", kind.fps, info["fps"]),
        ("robot_type", kind.robot_type, info["robot_type"]),
        ("features", shapes, found),
    ):
        if here != there:
            raise ValueError(
                f"dataset.root={str(root)!r} has {key}={there!r}, what is recorded here {key}={here!r}: they "
                "cannot be one dataset, choose another folder"
            )


def _told(kind: DatasetKind) -> dict[str, Any]:
    """What demonstrations share, as JSON has it."""
    return {**asdict(kind), "features": {key: list(names) for key, names in kind.features.items()}}


def _rename(old: Path, new: Path) -> None:
    old.rename(new)


def _read(path: Path) -> Demonstration:
    with np.load(path) as columns:
        observations = {key: columns[key] for key in columns.files if key != ACTION}
        return Demonstration(observations, columns[ACTION])


def _sync_folder(folder: Path) -> None:
    """Let a folder's new names survive a power cut, where the system can."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
