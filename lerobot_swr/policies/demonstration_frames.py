"""Frames of demonstrations as training's batches bring them, for a policy to look at outside of training."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.utils.collate import lerobot_collate_fn
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_swr.policies.configuration_swr import BCConfig
from lerobot_swr.styles.encoding import Frames
from lerobot_swr.trajectories import Trajectories


class DemonstrationFrames(Protocol):
    """Some frames of one demonstration after another."""

    def frames(self, episode: int, rows: np.ndarray) -> Frames:
        """Preprocessed frames `rows` of an episode."""
        ...


class ColumnFrames:
    """Of policies that see the present numbers alone: rows of the columns that are in memory."""

    def __init__(self, config: BCConfig, trajectories: Trajectories, preprocessor: Any):
        self._keys = [*config.observation_keys, ACTION]
        self._trajectories = trajectories
        self._preprocessor = preprocessor

    def frames(self, episode: int, rows: np.ndarray) -> Frames:
        """See `DemonstrationFrames`."""
        columns = self._trajectories.episode(episode)
        batch = self._preprocessor({key: torch.from_numpy(columns[key][rows]) for key in self._keys})
        return {key: batch[key] for key in self._keys}


class DatasetFrames:
    """Of any policy: items of LeRobot's dataset, with pictures, windows of steps, padding and tasks."""

    def __init__(self, config: BCConfig, meta: LeRobotDatasetMetadata, preprocessor: Any):
        self._dataset = LeRobotDataset(
            meta.repo_id,
            root=meta.root,
            delta_timestamps=resolve_delta_timestamps(config, meta),  # type: ignore[arg-type]
        )
        self._starts = list(meta.episodes["dataset_from_index"])
        self._preprocessor = preprocessor

    def frames(self, episode: int, rows: np.ndarray) -> Frames:
        """See `DemonstrationFrames`."""
        return self.batch([self._starts[episode] + int(row) for row in rows])

    def batch(self, numbers: Sequence[int]) -> dict[str, Any]:
        """Preprocessed frames by their numbers in the dataset."""
        items = [self._dataset[number] for number in numbers]
        batch = self._preprocessor(lerobot_collate_fn(items))
        return {key: value for key, value in batch.items() if _is_of_frames(value, len(items))}


def _is_of_frames(value: Any, count: int) -> bool:
    return isinstance(value, Tensor) and value.ndim > 0 and len(value) == count


def demonstration_frames(
    config: BCConfig, meta: LeRobotDatasetMetadata, trajectories: Trajectories, preprocessor: Any
) -> DemonstrationFrames:
    """The frames of a dataset, in the cheapest way that the policy allows.

    Args:
        config: The policy's configuration.
        meta: Metadata of the dataset.
        trajectories: Its episodes.
        preprocessor: The policy's inputs of raw batches.
    """
    if config.traits.is_momentary:
        return ColumnFrames(config, trajectories, preprocessor)
    return DatasetFrames(config, meta, preprocessor)


def dataset_frames(config: BCConfig, root: Path, preprocessor: Any) -> DatasetFrames:
    """Frames of the dataset in a folder."""
    return DatasetFrames(config, LeRobotDatasetMetadata(f"local/{root.name}", root=root), preprocessor)
