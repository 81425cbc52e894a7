"""Episodes of a LeRobotDataset as arrays."""

import hashlib
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_swr.dataset_checks import edit_command
from lerobot_swr.dataset_files import read_frames

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trajectories:
    """All episodes of a dataset.

    Attributes:
        lengths: (N,) int64, frames per episode; episode i of the dataset is row i.
        columns: Feature name to (sum of lengths, d) float32, episodes one after the other.
        fps: Control rate of the recording, in Hz.
        name: How messages call the dataset.
        tasks: N task strings, or empty.
        index: (sum of lengths,) int64, the dataset's own number of each frame; None where it is the row.
    """

    lengths: np.ndarray
    columns: dict[str, np.ndarray]
    fps: int
    name: str
    tasks: tuple[str, ...] = ()
    index: np.ndarray | None = None

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    @cached_property
    def starts(self) -> np.ndarray:
        """(N,) int64, row at which each episode starts."""
        return np.cumsum(self.lengths) - self.lengths

    def episode(self, index: int) -> dict[str, np.ndarray]:
        """Feature name to (T_i, d) of episode `index`."""
        start = self.starts[index]
        return {key: column[start : start + self.lengths[index]] for key, column in self.columns.items()}

    def episodes(self) -> Iterator[dict[str, np.ndarray]]:
        """All episodes in order, as `episode` gives them."""
        return (self.episode(i) for i in range(len(self)))

    def joined(self, keys: Sequence[str]) -> np.ndarray:
        """The features `keys` of every frame side by side: (sum of lengths, d) float32; of one, no copy."""
        columns = [self.columns[key] for key in keys]
        return columns[0] if len(columns) == 1 else np.concatenate(columns, axis=1)

    def states(self, keys: Sequence[str]) -> list[np.ndarray]:
        """The features `keys` of every episode side by side: N arrays (T_i, d)."""
        return np.split(self.joined(keys), self.starts[1:])

    def subset(self, episodes: Sequence[int]) -> "Trajectories":
        """Some of the episodes, in the given order."""
        parts = [self.episode(i) for i in episodes]
        columns = {key: np.concatenate([part[key] for part in parts]) for key in self.columns}
        tasks = tuple(self.tasks[i] for i in episodes) if self.tasks else ()
        return Trajectories(self.lengths[list(episodes)], columns, self.fps, self.name, tasks)

    def without(self, left_out: np.ndarray) -> "Trajectories":
        """The same episodes without the frames marked in `left_out`, (sum of lengths,) bool.

        Raises:
            ValueError: If no frame of an episode would be left.
        """
        lengths = np.add.reduceat(~left_out, self.starts, dtype=np.int64)
        if (lengths == 0).any():
            raise ValueError(f"dataset {self.name}: nothing is left of episode {int(lengths.argmin())}")
        columns = {key: column[~left_out] for key, column in self.columns.items()}
        return replace(self, lengths=lengths, columns=columns, index=None)

    def ends(self, count: int) -> np.ndarray:
        """(F,) bool, which frames are among the last `count` of their episode."""
        place = np.arange(self.lengths.sum()) - np.repeat(self.starts, self.lengths)
        return place >= np.repeat(self.lengths - count, self.lengths)

    def followed_by(self, other: "Trajectories", keys: Sequence[str]) -> "Trajectories":
        """The features `keys` of these episodes and of others after them."""
        columns = {key: np.concatenate([self.columns[key], other.columns[key]]) for key in keys}
        return Trajectories(np.concatenate([self.lengths, other.lengths]), columns, self.fps, self.name)

    def rows_of(self, episodes: np.ndarray) -> np.ndarray:
        """(F,) rows of frames of which only the (F,) `episodes` are known, each episode's in order.

        Frames beyond an episode's length, or of none that is here, get any row.
        """
        order = np.argsort(episodes, kind="stable")
        ordered = episodes[order]
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order)) - np.searchsorted(ordered, ordered)
        known = np.clip(episodes, 0, len(self) - 1)
        return self.starts[known] + np.minimum(rank, self.lengths[known] - 1)

    def fingerprint(self, keys: Sequence[str]) -> str:
        """Hash of the content of the features `keys` and of the episodes' lengths, in hexadecimal."""
        digest = hashlib.sha256(np.ascontiguousarray(self.lengths))
        for key in keys:
            digest.update(f"{key}{self.columns[key].shape}".encode())
            digest.update(np.ascontiguousarray(self.columns[key]))
        return digest.hexdigest()[:32]


def load_trajectories(
    meta: LeRobotDatasetMetadata, keys: Sequence[str], optional: Sequence[str] = ()
) -> Trajectories:
    """Read low-dimensional features of every episode of a dataset, as LeRobot reads them.

    Args:
        meta: Metadata of a dataset whose data files are on this machine.
        keys: Names of numeric or boolean features, e.g. ``["observation.state", "action"]``.
        optional: Further features; one that is no numbers or not finite is left out, with a warning.

    Raises:
        FileNotFoundError: If the dataset's data files are not on this machine.
        ValueError: If a feature is missing, a value is not finite or the frames do not match the metadata.
    """
    frames = read_frames(meta, keys, optional)
    columns = {}
    for key, column in frames.columns.items():
        reason = _not_finite(meta, key, column, frames.lengths)
        if reason is None:
            columns[key] = column
        elif key in keys:
            raise ValueError(
                f"{reason}; repair these episodes or drop them ({edit_command(meta, 'delete_episodes')} "
                "--operation.episode_indices=[...])"
            )
        else:
            logger.warning("left out: %s", reason)
    tasks = _episode_tasks(meta, frames.task_index)
    return Trajectories(frames.lengths, columns, meta.fps, str(meta.root), tasks, frames.index)


def _not_finite(
    meta: LeRobotDatasetMetadata, key: str, column: np.ndarray, lengths: np.ndarray
) -> str | None:
    """What is wrong with a column that is not finite; None for a good one."""
    bad_rows = np.flatnonzero(~np.isfinite(column).all(axis=1))
    if not len(bad_rows):
        return None
    ends = np.cumsum(lengths)
    episodes = np.searchsorted(ends, bad_rows, side="right")
    first = int(episodes[0])
    frame = int(bad_rows[0] - (ends[first] - lengths[first]))
    more = len(np.unique(episodes)) - 1
    return (
        f"dataset {meta.root}: feature {key!r} is NaN or infinite in {len(bad_rows)} frames, first in "
        f"episode {first}, frame {frame}" + (f", and in {more} more episodes" if more else "")
    )


def _episode_tasks(meta: LeRobotDatasetMetadata, task_index: np.ndarray | None) -> tuple[str, ...]:
    """N task strings: of the table of episodes, else of each first frame; empty if none is known."""
    has_list = meta.episodes is not None and "tasks" in meta.episodes.column_names
    tasks = [_joined(names) for names in meta.episodes["tasks"]] if has_list else [""] * meta.total_episodes
    if meta.tasks is not None and task_index is not None:
        column = meta.tasks["task"] if "task" in meta.tasks.columns else meta.tasks.index
        known = [str(name) for name in column]  # LeRobot counts rows
        tasks = [
            task or (known[i] if 0 <= i < len(known) else "")
            for task, i in zip(tasks, task_index.tolist(), strict=True)
        ]
    return tuple(tasks) if any(tasks) else ()


def _joined(names: str | Sequence[str | None] | None) -> str:
    if names is None or isinstance(names, str):
        return names or ""
    return "; ".join(name for name in names if name)


def dimension_names(meta: LeRobotDatasetMetadata, keys: Sequence[str]) -> dict[str, list[str]]:
    """Feature name to the names of its dimensions, or their numbers where the dataset names none.

    Args:
        meta: Metadata of the dataset.
        keys: The features.
    """
    return {key: _names(meta.features[key]) for key in keys}


def _names(feature: Mapping[str, Any]) -> list[str]:
    def leaves(names: Any) -> Iterator[str]:
        """LeRobot's names are a list, or such lists under the name of a group."""
        for name in names.values() if isinstance(names, dict) else names or ():
            yield from leaves(name) if isinstance(name, list | dict) else [str(name)]

    width = int(np.prod(feature["shape"]))
    names = list(leaves(feature.get("names")))
    return names if len(names) == width else [str(i) for i in range(width)]
