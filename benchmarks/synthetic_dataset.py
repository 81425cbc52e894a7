"""Large LeRobot datasets in a moment: parquet files written at once, in the layout of LeRobot v3."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import LeRobotDatasetMetadata

STEPS, DIM, FPS = 100, 14, 50
EPISODES_PER_FILE = 5000
BEHAVIORS, WAVES = 24, 8  # paths are sums of waves, about one of the behaviours' paths
KINDS = ("paths", "noise")


def write_synthetic_dataset(root: Path, n_episodes: int, kind: str = "paths") -> None:
    """Write a dataset of episodes of `STEPS` frames.

    Args:
        root: Folder of the new dataset.
        n_episodes: N.
        kind: ``paths`` of an arm of `DIM` joints, smooth but for the sensors' noise, in a few behaviours; or
            ``noise``, of which nothing can be said in fewer numbers.
    """
    feature = {"dtype": "float32", "shape": (DIM,), "names": [f"joint_{k}" for k in range(DIM)]}
    features = {"observation.state": feature, "action": feature}
    LeRobotDatasetMetadata.create("local/synthetic", FPS, features, root=root, use_videos=False)
    pd.DataFrame({"task_index": [0]}, index=pd.Index(["move"], name="task")).to_parquet(
        root / "meta/tasks.parquet"
    )
    moments = {key: Moments() for key in features}
    files = []
    for file, (first, states, actions) in enumerate(_blocks(n_episodes, kind)):
        files += [file] * len(states)
        path = root / f"data/chunk-000/file-{file:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        columns = {"observation.state": states.reshape(-1, DIM), "action": actions.reshape(-1, DIM)}
        for key, column in columns.items():
            moments[key].add(column)
        _write_frames(path, first, columns)
    _write_meta(root, n_episodes, files, moments)


def _blocks(n_episodes: int, kind: str) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """First episode, states and actions, (B, STEPS, DIM) float32 each, of some episodes at a time."""
    rng = np.random.default_rng(0)
    progress = np.linspace(0, 1, STEPS + 1)
    waves = np.stack([np.sin(np.pi * (k + 1) * progress / 2) / (k + 1) for k in range(WAVES)])
    ways = rng.normal(size=(BEHAVIORS, WAVES, DIM))
    for first in range(0, n_episodes, EPISODES_PER_FILE):
        count = min(EPISODES_PER_FILE, n_episodes - first)
        if kind == "noise":
            path = rng.standard_normal((count, STEPS + 1, DIM), dtype=np.float32)
        else:
            own = ways[rng.integers(BEHAVIORS, size=count)] + 0.3 * rng.normal(size=(count, WAVES, DIM))
            path = np.einsum("bwd,wt->btd", own, waves).astype(np.float32)
        states = path[:, :-1] + 0.005 * rng.standard_normal((count, STEPS, DIM), dtype=np.float32)
        yield first, states, path[:, 1:]


class Moments:
    """Statistics of a feature, file by file."""

    def __init__(self) -> None:
        self.count, self.sum, self.squares = 0, np.zeros(DIM), np.zeros(DIM)
        self.low, self.high = np.full(DIM, np.inf), np.full(DIM, -np.inf)

    def add(self, column: np.ndarray) -> None:
        """Count some frames, (F, DIM)."""
        self.count += len(column)
        self.sum += column.sum(axis=0, dtype=np.float64)
        self.squares += np.square(column, dtype=np.float64).sum(axis=0)
        self.low, self.high = (
            np.minimum(self.low, column.min(axis=0)),
            np.maximum(self.high, column.max(axis=0)),
        )

    def as_stats(self) -> dict:
        """As LeRobot writes them."""
        mean = self.sum / self.count
        std = np.sqrt(self.squares / self.count - mean**2)
        values = {"min": self.low, "max": self.high, "mean": mean, "std": std}
        return {**{name: value.tolist() for name, value in values.items()}, "count": [self.count]}


def _write_frames(path: Path, first: int, columns: dict[str, np.ndarray]) -> None:
    count = len(columns["action"])
    frame = np.arange(count) % STEPS
    table = {
        key: pa.FixedSizeListArray.from_arrays(pa.array(column.reshape(-1)), DIM)
        for key, column in columns.items()
    }
    table["timestamp"] = pa.array((frame / FPS).astype(np.float32))
    table["frame_index"] = pa.array(frame)
    table["episode_index"] = pa.array(first + np.arange(count) // STEPS)
    table["index"] = pa.array(first * STEPS + np.arange(count))
    table["task_index"] = pa.array(np.zeros(count, dtype=np.int64))
    pq.write_table(pa.table(table), path, compression="none", use_dictionary=False)


def _write_meta(root: Path, n_episodes: int, files: list[int], moments: dict[str, Moments]) -> None:
    everyone, zeros = np.arange(n_episodes), np.zeros(n_episodes, dtype=np.int64)
    episodes = {
        "episode_index": pa.array(everyone),
        "tasks": pa.array([["move"]] * n_episodes),
        "length": pa.array(np.full(n_episodes, STEPS)),
        "data/chunk_index": pa.array(zeros),
        "data/file_index": pa.array(files),
        "dataset_from_index": pa.array(everyone * STEPS),
        "dataset_to_index": pa.array((everyone + 1) * STEPS),
        "meta/episodes/chunk_index": pa.array(zeros),
        "meta/episodes/file_index": pa.array(zeros),
    }
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(episodes), path)
    (root / "meta/stats.json").write_text(json.dumps({key: one.as_stats() for key, one in moments.items()}))
    file = root / "meta/info.json"
    totals = {"total_episodes": n_episodes, "total_frames": n_episodes * STEPS, "total_tasks": 1}
    splits = {"splits": {"train": f"0:{n_episodes}"}}
    file.write_text(json.dumps({**json.loads(file.read_text()), **totals, **splits}, indent=4))
