"""A LeRobot dataset whose frames lie in memory, for LeRobot's own training loop."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train
from torch import Tensor
from torch.utils.data import Dataset

ROWS_AT_ONCE = 10_000  # converted to tensors together


class MemoryDataset(Dataset):
    """The items of a `LeRobotDataset` without images, windows and padding included, many times faster.

    LeRobot looks every window up in files; here a batch is one indexing of tensors. Other attributes are
    the dataset's own.

    Args:
        dataset: The dataset, of F frames.

    Raises:
        ValueError: If it has images or text columns.
    """

    def __init__(self, dataset: LeRobotDataset):
        meta = dataset.meta
        if meta.camera_keys or meta.has_language_columns:
            kept = ", ".join(meta.camera_keys) or "text columns"
            raise ValueError(
                f"dataset {dataset.repo_id!r} has {kept}, which do not fit into memory; use lerobot-train"
            )
        self.dataset = dataset
        self._columns = _columns(dataset)
        self._tasks = [str(name) for name in meta.tasks.index]
        self._starts = torch.tensor(meta.episodes["dataset_from_index"])
        self._ends = torch.tensor(meta.episodes["dataset_to_index"])
        # Row of every frame of the whole dataset, of which this one may hold some episodes only.
        self._rows = torch.full((meta.total_frames,), -1)
        self._rows[self._columns["index"]] = torch.arange(len(self._columns["index"]))
        deltas = dataset.reader.delta_indices or {}
        self._deltas = {key: torch.tensor(steps) for key, steps in deltas.items()}

    def __getattr__(self, name: str) -> Any:
        """Whatever else the training loop asks a dataset for."""
        if name == "dataset":  # not there yet while a copy is being made
            raise AttributeError(name)
        return getattr(self.dataset, name)

    def __len__(self) -> int:
        """F."""
        return len(self.dataset)

    def __getitem__(self, row: int) -> dict[str, Any]:
        """The item of a frame."""
        return self.__getitems__([row])[0]

    def __getitems__(self, rows: list[int]) -> list[dict[str, Any]]:
        """The items of several frames; PyTorch's loader asks for a batch at once."""
        at = torch.tensor(rows)
        batch = {key: column[at] for key, column in self._columns.items()}
        episodes, frames = batch["episode_index"], batch["index"]
        starts, ends = self._starts[episodes, None], self._ends[episodes, None]
        for key, steps in self._deltas.items():
            window = frames[:, None] + steps  # (B, T)
            batch[f"{key}_is_pad"] = (window < starts) | (window >= ends)
            batch[key] = self._columns[key][self._rows[window.clamp(starts, ends - 1)]]
        tasks = [self._tasks[index] for index in batch["task_index"].tolist()]
        values = zip(*(value.unbind() for value in batch.values()), tasks, strict=True)
        names = (*batch, "task")
        return [dict(zip(names, one, strict=True)) for one in values]


def _columns(dataset: LeRobotDataset) -> dict[str, Tensor]:
    """All frames: feature to (F, ...), in the types that LeRobot gives them."""
    frames = dataset.hf_dataset
    parts = [frames[first : first + ROWS_AT_ONCE] for first in range(0, len(frames), ROWS_AT_ONCE)]
    return {key: torch.cat([torch.stack(part[key]) for part in parts]) for key in frames.column_names}


@contextmanager
def frames_in_memory() -> Iterator[None]:
    """Let LeRobot's training loop hold its datasets in memory within the block; it has no option for that."""
    make = lerobot_train.make_train_eval_datasets

    def make_in_memory(config: TrainPipelineConfig) -> tuple[MemoryDataset | None, ...]:
        return tuple(None if dataset is None else MemoryDataset(dataset) for dataset in make(config))

    with patch.object(lerobot_train, "make_train_eval_datasets", make_in_memory):
        yield
