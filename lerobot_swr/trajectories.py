"""Episodes of a LeRobotDataset as arrays, read straight from its parquet files."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata


@dataclass(frozen=True)
class Trajectories:
    """All episodes of a dataset.

    Attributes:
        lengths: (N,) int64, frames per episode; episode i of the dataset is row i.
        columns: Feature name to (sum of lengths, d) float32, episodes one after the other.
        fps: Control rate of the recording, in Hz.
        name: How messages call the dataset.
        tasks: N task strings, or empty.
    """

    lengths: np.ndarray
    columns: dict[str, np.ndarray]
    fps: int
    name: str
    tasks: tuple[str, ...] = ()

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.lengths)

    @property
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

    def states(self, keys: Sequence[str]) -> list[np.ndarray]:
        """The features `keys` of every episode side by side: N arrays (T_i, d)."""
        joined = np.concatenate([self.columns[key] for key in keys], axis=1)
        return np.split(joined, self.starts[1:])

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
        return replace(self, lengths=lengths, columns=columns)

    def fingerprint(self, keys: Sequence[str]) -> str:
        """Hash of the content of the features `keys` and of the episodes' lengths, in hexadecimal."""
        digest = hashlib.sha256(np.ascontiguousarray(self.lengths).tobytes())
        for key in keys:
            digest.update(f"{key}{self.columns[key].shape}".encode())
            digest.update(np.ascontiguousarray(self.columns[key]).tobytes())
        return digest.hexdigest()[:32]


def load_trajectories(meta: LeRobotDatasetMetadata, keys: Sequence[str]) -> Trajectories:
    """Read low-dimensional features of every episode of a dataset.

    Args:
        meta: Metadata of a dataset whose data files are on this machine.
        keys: Names of numeric or boolean features, e.g. ``["observation.state", "action"]``.

    Raises:
        FileNotFoundError: If the dataset's data files are not on this machine.
        ValueError: If a feature is missing, a value is not finite or the frames do not match the metadata.
    """
    name = str(meta.root)
    for key in keys:
        if key not in meta.features:
            raise ValueError(f"dataset {name}: no feature {key!r}; it has: {', '.join(meta.features)}")
    files = sorted((Path(meta.root) / "data").glob("chunk-*/file-*.parquet"))
    if not files:
        raise FileNotFoundError(
            f"dataset {name}: no data/chunk-*/file-*.parquet; download the dataset first "
            "(streamed datasets are not supported, they hide the episodes)"
        )
    table = pa.concat_tables(
        [pq.read_table(file, columns=["index", "episode_index", *keys]) for file in files]
    )
    table = table.sort_by("index")
    columns = {key: _as_array(table.column(key), key, name) for key in keys}
    episode_index = table.column("episode_index").to_numpy()
    lengths = np.bincount(episode_index, minlength=meta.total_episodes).astype(np.int64)
    if len(lengths) != meta.total_episodes or (lengths == 0).any() or (np.diff(episode_index) < 0).any():
        raise ValueError(
            f"dataset {name}: meta/info.json promises {meta.total_episodes} episodes in order, the data "
            f"files hold {len(np.unique(episode_index))}; is the dataset complete (was it finalized)?"
        )
    tasks = tuple("; ".join(names) for names in meta.episodes["tasks"])
    trajectories = Trajectories(lengths, columns, meta.fps, name, tasks)
    _check_finite(trajectories, episode_index)
    return trajectories


def _as_array(column: pa.ChunkedArray, key: str, name: str) -> np.ndarray:
    """A column of numbers, of truth values or of lists of equal length of them as (frames, d) float32."""
    array = column.combine_chunks()
    n_frames = len(array)
    while pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
        array = array.flatten()
    numeric = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean)
    if not any(is_kind(array.type) for is_kind in numeric):
        raise ValueError(f"dataset {name}: feature {key!r} is not numeric ({array.type})")
    return array.to_numpy(zero_copy_only=False).reshape(n_frames, -1).astype(np.float32)


def _check_finite(trajectories: Trajectories, episode_index: np.ndarray) -> None:
    for key, column in trajectories.columns.items():
        bad_rows = np.flatnonzero(~np.isfinite(column).all(axis=1))
        if len(bad_rows):
            episode = int(episode_index[bad_rows[0]])
            frame = int(bad_rows[0] - trajectories.starts[episode])
            raise ValueError(
                f"dataset {trajectories.name}: feature {key!r} is NaN or infinite in {len(bad_rows)} frames, "
                f"first in episode {episode}, frame {frame}; repair or drop these episodes "
                "(lerobot-edit-dataset --operation.type=delete_episodes)"
            )
