"""A LeRobot dataset whose frames lie in memory, for LeRobot's own training loop."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
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
        self._columns, self._texts = _columns(dataset)
        self._tasks = [] if meta.tasks is None else list(meta.tasks.index)
        self._starts = torch.tensor(meta.episodes["dataset_from_index"])
        self._ends = torch.tensor(meta.episodes["dataset_to_index"])
        # Row of every frame of the whole dataset, where this one holds some episodes only.
        self._rows = torch.arange(meta.total_frames)
        places = dataset.absolute_to_relative_idx
        if places is not None:
            self._rows[list(places)] = torch.tensor(list(places.values()))
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
        texts = ([column[row] for row in rows] for column in self._texts.values())
        values = zip(*(value.unbind() for value in batch.values()), *texts, tasks, strict=True)
        names = (*batch, *self._texts, "task")
        return [dict(zip(names, one, strict=True)) for one in values]


def _columns(dataset: LeRobotDataset) -> tuple[dict[str, Tensor], dict[str, list]]:
    """All frames in the types that LeRobot gives them: feature to (F, ...), and feature to F strings."""
    frames = dataset.hf_dataset
    parts = [frames[first : first + ROWS_AT_ONCE] for first in range(0, len(frames), ROWS_AT_ONCE)]
    columns, texts = {}, {}
    for key in frames.column_names:
        values = list(chain.from_iterable(part[key] for part in parts))
        if all(isinstance(value, Tensor) for value in values):
            columns[key] = torch.stack(values)
        else:
            texts[key] = values
    return columns, texts


@contextmanager
def frames_in_memory() -> Iterator[None]:
    """Let LeRobot's training loop hold its datasets in memory within the block; it has no option for that."""
    make = lerobot_train.make_train_eval_datasets

    def make_in_memory(config: TrainPipelineConfig) -> tuple[MemoryDataset | None, ...]:
        return tuple(None if dataset is None else MemoryDataset(dataset) for dataset in make(config))

    with patch.object(lerobot_train, "make_train_eval_datasets", make_in_memory):
        yield
