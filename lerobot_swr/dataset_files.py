"""The low-dimensional features of a dataset's frames, read as LeRobot reads them.

LeRobot numbers frames by their place in the data files, sorted by name, and casts columns to the types that
``meta/info.json`` states. Here the same is done, for the files that the metadata list and without pictures.
"""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from datasets.table import cast_array_to_feature
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.feature_utils import get_hf_features_from_features

PRECISION = 0.05  # largest rounding error of float32 that is let pass, in units of a dimension's spread

logger = logging.getLogger(__name__)


class UnusableColumnError(ValueError):
    """A column that cannot be read as numbers; the message names dataset, feature, file and episode."""


@dataclass(frozen=True)
class Frames:
    """Frames of a dataset, grouped by episode, in LeRobot's order within each.

    Attributes:
        lengths: (N,) int64, frames of each episode.
        columns: Feature to (sum of lengths, d) float32.
        task_index: (N,) int64, task of each episode's first frame; None where the files do not say.
        index: (sum of lengths,) int64, the dataset's own number of each frame; None where it is the row.
    """

    lengths: np.ndarray
    columns: dict[str, np.ndarray]
    task_index: np.ndarray | None
    index: np.ndarray | None


def is_numeric(feature: dict) -> bool:
    """Whether a feature of the metadata holds numbers or truth values, rather than pictures or text."""
    try:
        return np.dtype(feature["dtype"]).kind in "biuf"
    except TypeError:
        return False


def dimension(feature: dict) -> int:
    """How many numbers a feature has; a grid counts as the vector of its cells."""
    return int(np.prod(feature["shape"]))


def all_files(meta: LeRobotDatasetMetadata) -> list[Path]:
    """The data files that LeRobot reads, in its order: whatever lies in the folder."""
    return sorted((Path(meta.root) / "data").glob("*/*.parquet"))


def listed_files(meta: LeRobotDatasetMetadata) -> dict[Path, np.ndarray]:
    """The data files that the metadata list, in LeRobot's order, and the episodes in each.

    Raises:
        FileNotFoundError: If one is not on this machine.
    """
    name, root = str(meta.root), Path(meta.root)
    present = all_files(meta)
    if not present:
        raise FileNotFoundError(
            f"dataset {name}: no data/chunk-*/file-*.parquet; download the dataset first "
            "(streamed datasets are not supported, they hide the episodes)"
        )
    numbers = episode_column(meta, "episode_index", np.arange(meta.total_episodes))
    chunk, file = (episode_column(meta, f"data/{part}_index") for part in ("chunk", "file"))
    if chunk is None or file is None:
        return dict.fromkeys(present, numbers)
    files = {}
    for at in np.unique(np.stack([chunk, file], axis=1), axis=0):
        path = root / meta.data_path.format(chunk_index=int(at[0]), file_index=int(at[1]))
        files[path] = numbers[(chunk == at[0]) & (file == at[1])]
    for path, episodes in files.items():
        if not path.is_file():
            raise FileNotFoundError(
                f"dataset {name}: {path.relative_to(root)}, which holds episodes {episodes.min()} to "
                f"{episodes.max()}, is missing; copy or download the dataset again"
            )
    return dict(sorted(files.items()))


def episode_column(meta: LeRobotDatasetMetadata, name: str, default: np.ndarray | None = None) -> np.ndarray:
    """(N,) a column of the table of episodes, or the default where there is none."""
    if meta.episodes is None or name not in meta.episodes.column_names:
        return default  # type: ignore[return-value]
    return np.asarray(meta.episodes[name])


def read_frames(meta: LeRobotDatasetMetadata, keys: Sequence[str], optional: Sequence[str] = ()) -> Frames:
    """Read numeric features of every episode.

    Args:
        meta: Metadata of a dataset whose data files are on this machine.
        keys: Features that must be there.
        optional: Further features; one that cannot be read is left out, with a warning.

    Raises:
        FileNotFoundError: If a data file is not on this machine.
        ValueError: If a feature is missing or no numbers, or the frames do not match the metadata.
    """
    name = str(meta.root)
    for key in keys:
        if key not in meta.features:
            raise ValueError(f"dataset {name}: no feature {key!r}; it has: {', '.join(meta.features)}")
        if not is_numeric(meta.features[key]):
            raise UnusableColumnError(
                f"dataset {name}: feature {key!r} is not numeric ({meta.features[key]['dtype']})"
            )
    files = listed_files(meta)
    wanted = [*keys, *(key for key in optional if key in meta.features and key not in keys)]
    parts: dict[str, list[np.ndarray]] = {key: [] for key in wanted}
    owners: list[np.ndarray] = []
    index: list[np.ndarray] = []
    tasks: list[np.ndarray] = []
    for path in files:
        table = _read(path, dict.fromkeys(["episode_index", "index", "task_index", *parts]), name)
        owners.append(_integers(table, "episode_index", path, name))
        index.append(_integers(table, "index", path, name))
        if "task_index" in table.column_names:
            tasks.append(_integers(table, "task_index", path, name))
        for key in list(parts):
            try:
                parts[key].append(_numbers(table, key, meta, path, owners[-1]))
            except UnusableColumnError as error:
                if key in keys:
                    raise
                logger.warning("left out: %s", error)
                del parts[key]
    owner = np.concatenate(owners)
    _check_frames(meta, owner, files)
    order = np.flatnonzero((owner >= 0) & (owner < meta.total_episodes))
    order = order[np.argsort(owner[order], kind="stable")]
    taken = slice(None) if np.array_equal(order, np.arange(len(owner))) else order
    lengths = np.bincount(owner[order], minlength=meta.total_episodes).astype(np.int64)
    columns = {}
    for key in list(parts):
        try:
            columns[key] = _as_float32(np.concatenate(parts.pop(key))[taken], key, name)
        except UnusableColumnError as error:
            if key in keys:
                raise
            logger.warning("left out: %s", error)
    starts = np.cumsum(lengths) - lengths
    task_index = np.concatenate(tasks)[order][starts] if len(tasks) == len(files) else None
    numbers = np.concatenate(index)[taken]
    in_turn = np.array_equal(numbers, np.arange(len(numbers)))
    return Frames(lengths, columns, task_index, None if in_turn else numbers)


def _read(path: Path, columns: Iterable[str], name: str) -> pa.Table:
    try:
        known = pq.read_schema(path).names
        return pq.read_table(path, columns=[key for key in columns if key in known], partitioning=None)
    except pa.ArrowInvalid as error:
        raise ValueError(f"dataset {name}: {path}: damaged ({error}); copy or download it again") from error


def _integers(table: pa.Table, key: str, path: Path, name: str) -> np.ndarray:
    if key not in table.column_names or table.column(key).null_count:
        raise ValueError(
            f"dataset {name}: {path}: no column {key!r}, or gaps in it; copy or download it again"
        )
    return table.column(key).to_numpy().astype(np.int64)


def _numbers(
    table: pa.Table, key: str, meta: LeRobotDatasetMetadata, path: Path, owner: np.ndarray
) -> np.ndarray:
    """(frames, d) values of a feature in one file, in the type that the metadata state."""
    where, feature = f"dataset {meta.root}: feature {key!r}", meta.features[key]
    if not is_numeric(feature):
        raise UnusableColumnError(f"{where} is not numeric ({feature['dtype']})")
    if key not in table.column_names:
        raise UnusableColumnError(
            f"{where} is missing in {path.relative_to(meta.root)} (episodes {owner.min()} to {owner.max()}); "
            "add it there, or remove it from the whole dataset"
        )
    column = table.column(key).combine_chunks()
    if _has_nulls(column):
        empty = np.flatnonzero(_is_empty(column))
        episode = int(owner[empty[0]])
        frame = int(empty[0] - np.flatnonzero(owner == episode)[0])
        raise UnusableColumnError(
            f"{where} is NaN or null in {len(empty)} frames of {path.relative_to(meta.root)}, first in "
            f"episode {episode}, frame {frame}; fill them in, or drop the episode "
            "(lerobot-edit-dataset --operation.type=delete_episodes)"
        )
    try:
        flat = cast_array_to_feature(column, get_hf_features_from_features({key: feature})[key])
        while _is_list(flat := flat.storage if isinstance(flat, pa.ExtensionArray) else flat):
            flat = flat.flatten()
        return flat.to_numpy(zero_copy_only=False).reshape(len(owner), dimension(feature))
    except (pa.ArrowException, TypeError, ValueError) as error:
        raise UnusableColumnError(
            f"{where}: {path.relative_to(meta.root)} holds {column.type}, which does not fit the shape "
            f"{tuple(feature['shape'])} and type {feature['dtype']} of meta/info.json ({error})"
        ) from error


def _is_list(array: pa.Array) -> bool:
    kinds = (pa.types.is_list, pa.types.is_large_list, pa.types.is_fixed_size_list)
    return any(is_kind(array.type) for is_kind in kinds)


def _has_nulls(array: pa.Array) -> bool:
    array = array.storage if isinstance(array, pa.ExtensionArray) else array
    return array.null_count > 0 or (_is_list(array) and _has_nulls(array.flatten()))


def _is_empty(array: pa.Array) -> np.ndarray:
    """(n,) bool, where a value, or a number within it, is null."""
    array = array.storage if isinstance(array, pa.ExtensionArray) else array
    empty = array.is_null().to_numpy(zero_copy_only=False).astype(bool)
    if _is_list(array):
        within = _is_empty(array.flatten())
        empty[pc.list_parent_indices(array).to_numpy()[within]] = True
    return empty


def _as_float32(values: np.ndarray, key: str, name: str) -> np.ndarray:
    """Numbers as policies compute with them.

    Raises:
        UnusableColumnError: If that is too coarse for how little whole numbers change.
    """
    result = values.astype(np.float32)
    if values.dtype.kind in "iu":
        spread = values.max(axis=0).astype(np.float64) - values.min(axis=0)
        error = np.abs(values - result.astype(np.float64)).max(axis=0)
        coarse = np.flatnonzero((error > PRECISION * spread) & (spread > 0))
        if len(coarse):
            k = coarse[0]
            raise UnusableColumnError(
                f"dataset {name}: dimension {k} of feature {key!r} changes by {spread[k]:g} at "
                f"{np.abs(result[:, k]).max():g}, which 32-bit floating point, in which policies compute, "
                "hardly tells apart; subtract a constant from it in the dataset"
            )
    return result


def _check_frames(meta: LeRobotDatasetMetadata, owner: np.ndarray, files: dict[Path, np.ndarray]) -> None:
    """Refuse data files that hold other frames than the metadata promise.

    Raises:
        ValueError: Naming the first episode that is concerned, and its file.
    """
    name, n = str(meta.root), meta.total_episodes
    found = np.bincount(owner[(owner >= 0) & (owner < n)], minlength=n)
    begin, end = (episode_column(meta, f"dataset_{end}_index") for end in ("from", "to"))
    promised = np.zeros(n, dtype=np.int64)
    numbers = episode_column(meta, "episode_index", np.arange(n))
    if len(numbers) != n or not np.array_equal(np.sort(numbers), np.arange(n)):
        raise ValueError(
            f"dataset {name}: meta/info.json promises {n} episodes, meta/episodes lists "
            f"{len(np.unique(numbers))}; is the dataset complete (was it finalized)?"
        )
    promised[numbers] = end - begin
    odd = np.flatnonzero((found != promised) | (found == 0))
    if len(odd):
        file = next(path for path, episodes in files.items() if odd[0] in episodes)
        raise ValueError(
            f"dataset {name}: meta/episodes promises {promised[odd[0]]} frames of episode {odd[0]}, the data "
            f"files hold {found[odd[0]]} (it belongs into {file.relative_to(meta.root)}); is the dataset "
            "complete (was it finalized)?"
        )
