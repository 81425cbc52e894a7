"""Trains seeds one by one with LeRobot's own loop, on frames in memory: policies that cannot be stacked."""

import multiprocessing
import os
import shutil
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from unittest.mock import patch

import torch
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.scripts import lerobot_train
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_swr.configuration import resuming
from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.memory import keep_freed_memory
from lerobot_swr.training.memory_dataset import frames_in_memory


def train_separately(config: SeedsTrainConfig) -> list[Path]:
    """Train one policy per seed, ``jobs`` processes at once; what `train_seeds` says holds here as well.

    Args:
        config: A validated configuration whose options have been checked.

    Returns:
        The folder of each seed's trained policy.

    Raises:
        BrokenProcessPool: If a process was killed.
    """
    runs = {seed: config.of_seed(seed) for seed in config.seeds}
    waiting = [seed for seed, run in runs.items() if not _is_finished(run)]
    if waiting:
        with ProcessPoolExecutor(
            min(config.jobs or 1, len(waiting)),
            multiprocessing.get_context("spawn"),
            max_tasks_per_child=1,
        ) as pool:
            futures = [pool.submit(_train_seed, config, seed) for seed in waiting]
            try:
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    return [_last(run) / PRETRAINED_MODEL_DIR for run in runs.values()]


def _last(run: TrainPipelineConfig) -> Path:
    """Link to a run's last checkpoint; LeRobot sets it when the checkpoint is complete."""
    assert run.output_dir is not None
    return run.output_dir / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK


def _is_finished(run: TrainPipelineConfig) -> bool:
    last = _last(run)
    return last.is_dir() and int(last.resolve().name) == run.steps


def _train_seed(config: SeedsTrainConfig, seed: int) -> None:
    """Start a run, or go on with it; in a process of its own."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    register_third_party_plugins()
    torch.set_num_threads(1)  # several processes share the cores
    keep_freed_memory()
    run = config.of_seed(seed)
    assert run.output_dir is not None
    with frames_in_memory():
        if not _last(run).is_dir():
            shutil.rmtree(
                run.output_dir, ignore_errors=True
            )  # killed before the first checkpoint was complete
            with resuming(False):  # whatever the command said of the other seeds
                lerobot_train.train(run)
            return
        command = [
            "lerobot-train",
            f"--config_path={_last(run) / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME}",
            "--resume=true",
            f"--output_dir={run.output_dir}",
        ]
        if run.dataset.root is not None:
            command.append(f"--dataset.root={run.dataset.root}")
        with patch.object(sys, "argv", command):
            lerobot_train.train()


def _end_with_parent() -> None:
    """A run whose command was killed must not go on beside the one that resumes it."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
