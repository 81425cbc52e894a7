"""Trains seeds one by one with LeRobot's own loop, on frames in memory: policies that cannot be stacked."""

import multiprocessing
import sys
from multiprocessing.process import BaseProcess
from pathlib import Path
from unittest.mock import patch

import torch
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.scripts import lerobot_train
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_swr.run_context import running
from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.exact_accelerator import exact_accelerator
from lerobot_swr.training.memory import keep_freed_memory
from lerobot_swr.training.memory_dataset import frames_in_memory
from lerobot_swr.training.processes import end_with_parent, explained_exit, run_processes
from lerobot_swr.training.seed_runs import drop_incomplete, last_step, point_to_last

OPTIONS_ON_RESUME = ("save_freq", "log_freq", "num_workers", "env_eval_freq", "eval_steps")


def train_separately(config: SeedsTrainConfig) -> list[Path]:
    """Train one policy per seed, ``jobs`` processes at once; what `train_seeds` says holds here as well.

    Args:
        config: A validated configuration whose options have been checked.

    Returns:
        The folder of each seed's trained policy.

    Raises:
        ChildProcessError: If a process failed; it has said why.
    """
    runs = {seed: config.of_seed(seed) for seed in config.seeds}
    context = multiprocessing.get_context("spawn")
    # No daemons: LeRobot's loop may have processes of its own, for environments and for loading.
    processes: list[tuple[list[int], BaseProcess]] = [
        ([seed], context.Process(target=_train_seed, args=(config, seed)))
        for seed, run in runs.items()
        if last_step(run) < run.steps
    ]
    run_processes(processes, config.jobs or 1)
    return [point_to_last(run) for run in runs.values()]


def _train_seed(config: SeedsTrainConfig, seed: int) -> None:
    """Train a seed in a process of its own."""
    end_with_parent()
    register_third_party_plugins()
    torch.set_num_threads(1)  # several processes share the cores
    keep_freed_memory()
    with explained_exit():
        train_run(config.of_seed(seed))


def train_run(run: TrainPipelineConfig) -> None:
    """Start a run, or go on with it from its last complete checkpoint, in this process.

    Args:
        run: Configuration of a seed's run, as `SeedsTrainConfig.of_seed` makes it.

    Raises:
        ValueError: If LeRobot's loop refuses the configuration, or the dataset has images.
    """
    assert run.policy is not None
    drop_incomplete(run)
    accelerator = exact_accelerator(run.policy)
    with frames_in_memory():
        if last_step(run):
            with patch.object(sys, "argv", _resume_command(run)):
                lerobot_train.train(accelerator=accelerator)
        else:
            with running(run.dataset):  # whatever the command said of the other seeds
                lerobot_train.train(run, accelerator=accelerator)


def _resume_command(run: TrainPipelineConfig) -> list[str]:
    """Words of the ``lerobot-train`` command that goes on with a run; it reads other options from the run."""
    options = {
        "config_path": point_to_last(run) / TRAIN_CONFIG_NAME,
        "resume": "true",
        "output_dir": run.output_dir,
        **{key: getattr(run, key) for key in OPTIONS_ON_RESUME},
    }
    if run.dataset.root is not None:
        options["dataset.root"] = run.dataset.root
    return ["lerobot-train", *(f"--{key}={value}" for key, value in options.items())]
