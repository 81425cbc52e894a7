"""Datasets of arcs like those of public reports, in every type and shape that LeRobot reads."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata

LENGTHS = (6, 8, 10, 12)
STATE, ACTION = "observation.state", "action"
Frame = Callable[[int, int, int], dict[str, np.ndarray]]


def feature(*shape: int, dtype: str = "float32") -> dict:
    """A feature as ``meta/info.json`` has it."""
    return {"dtype": dtype, "shape": shape, "names": None}


def arc(i: int, t: int, n: int) -> np.ndarray:
    """(2,) point t of n on the half circle that episode i follows, above or below."""
    angle = np.pi * t / n
    return np.array([np.cos(angle), (-1) ** i * np.sin(angle) * (1 + 0.05 * i)], np.float32)


def arcs(i: int, t: int, n: int) -> dict[str, np.ndarray]:
    """A frame: the state, and the next state as action."""
    return {STATE: arc(i, t, n), ACTION: arc(i, t + 1, n)}


PLAIN = {STATE: feature(2), ACTION: feature(2)}


def write(root: Path, features: dict | None = None, frame: Frame = arcs, lengths=LENGTHS) -> Path:
    """Write a dataset with LeRobot's own writer."""
    dataset = LeRobotDataset.create(
        "local/odd", fps=10, root=root, features=features or PLAIN, use_videos=False
    )
    for i, n in enumerate(lengths):
        for t in range(n):
            dataset.add_frame({**frame(i, t, n), "task": "reach"})
        dataset.save_episode()
    dataset.finalize()
    return root


def metadata(root: Path) -> LeRobotDatasetMetadata:
    """Metadata of a dataset on disk."""
    return LeRobotDatasetMetadata("local/odd", root=root)


def edit_json(file: Path, change: Callable[[dict], None]) -> None:
    """Change a JSON file in place."""
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def data_file(root: Path, file: int = 0) -> Path:
    """A data file of a dataset."""
    return root / f"data/chunk-000/file-{file:03d}.parquet"


def set_column(root: Path, key: str, values, type_: pa.DataType) -> None:
    """Replace a column of the only data file."""
    table = pq.read_table(data_file(root)).replace_schema_metadata(None)
    column = pa.array(values, type=type_)
    pq.write_table(table.set_column(table.schema.get_field_index(key), key, column), data_file(root))


def split_into_files(root: Path, first_in_file: list[int]) -> None:
    """Spread the episodes over data files: file k begins with episode `first_in_file[k]`."""
    table = pq.read_table(data_file(root))
    owner = table.column("episode_index").to_numpy()
    file_of = np.searchsorted(np.sort(first_in_file), np.arange(owner.max() + 1), side="right") - 1
    names = {start: k for k, start in enumerate(first_in_file)}
    file_of = np.array([names[np.sort(first_in_file)[place]] for place in file_of])
    for k in range(len(first_in_file)):
        pq.write_table(table.filter(pa.array(file_of[owner] == k)), data_file(root, k))
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    episodes = pq.read_table(path)
    place = episodes.schema.get_field_index("data/file_index")
    pq.write_table(episodes.set_column(place, "data/file_index", pa.array(file_of)), path)


@pytest.fixture(scope="session")
def plain_arcs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a dataset of four arcs; tests must not change it."""
    return write(tmp_path_factory.mktemp("odd") / "plain")


@pytest.fixture
def copied_arcs(plain_arcs: Path, tmp_path: Path) -> Path:
    """A copy of `plain_arcs` that a test may change."""
    return Path(shutil.copytree(plain_arcs, tmp_path / "arcs"))
