"""Trains all seeds of one configuration at once, spread over processes."""

import logging
import math
import multiprocessing
from collections.abc import Callable, Iterator
from itertools import groupby
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.common.train_utils import should_save_checkpoint
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.utils.constants import ACTION
from lerobot.utils.utils import init_logging
from torch import Tensor

from lerobot_swr.progress import Progress
from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.frame_order import FrameOrder
from lerobot_swr.training.memory import keep_freed_memory, large_pages
from lerobot_swr.training.processes import end_with_parent, explained_exit, run_processes
from lerobot_swr.training.seed_runs import SeedRuns, check_options, last_step, point_to_last
from lerobot_swr.training.separate_training import train_separately

STEPS_AT_ONCE = 64  # whose frames and pairs are drawn together

logger = logging.getLogger(__name__)


def train_seeds(config: SeedsTrainConfig) -> list[Path]:
    """Train one policy per seed; finished runs are left alone, begun ones go on from their last checkpoint.

    A seed's run is what ``lerobot-train --seed=…`` trains, up to rounding: the same initial weights, frames
    and pairs. It does not depend on the seeds that it is trained with.

    Args:
        config: A validated configuration.

    Returns:
        The folder of each seed's trained policy.

    Raises:
        ValueError: If the output folder was begun with other options or another dataset, or a loss is not
            finite.
        ChildProcessError: If one of several processes failed; it has said why.
    """
    check_options(config)
    if not config.is_stacked:
        return train_separately(config)
    runs = {seed: config.of_seed(seed) for seed in config.seeds}
    steps = {seed: last_step(run) for seed, run in runs.items()}
    waiting = [seed for seed in config.seeds if steps[seed] < config.steps]
    groups = list(_spread(waiting, steps, config.jobs or 1))
    if len(groups) == 1:
        _train_group(config, groups[0])
    elif groups:
        _train_in_processes(config, groups, steps)
    return [point_to_last(run) for run in runs.values()]


def _spread(seeds: list[int], steps: dict[int, int], jobs: int) -> Iterator[list[int]]:
    """Groups of seeds that have done the same number of steps, as many as there are processes or more."""
    ordered = sorted(seeds, key=lambda seed: (steps[seed], seeds.index(seed)))
    for _, same in groupby(ordered, key=steps.__getitem__):
        members = list(same)
        count = min(jobs, len(members))
        yield from (members[i::count] for i in range(count))


def _train_in_processes(config: SeedsTrainConfig, groups: list[list[int]], steps: dict[int, int]) -> None:
    context = multiprocessing.get_context("spawn")
    done = context.Array("q", len(groups), lock=False)
    processes: list[tuple[list[int], BaseProcess]] = [
        (seeds, context.Process(target=_process, args=(config, seeds, done, i), daemon=True))
        for i, seeds in enumerate(groups)
    ]
    total = sum(config.steps - steps[seed] for seeds in groups for seed in seeds)
    with Progress(total=total, desc="Training", unit="seed-step") as bar, large_pages():
        run_processes(processes, config.jobs or 1, lambda: bar.update(sum(done) - bar.n))


def _process(config: SeedsTrainConfig, seeds: list[int], done: Any, group: int) -> None:
    """What a process does: train a group of seeds, counting into ``done[group]``; end with its parent."""

    def count() -> None:
        done[group] += len(seeds)

    end_with_parent()
    init_logging()
    with explained_exit():
        _train_group(config, seeds, count)


def _train_group(config: SeedsTrainConfig, seeds: list[int], count: Callable[[], None] | None = None) -> None:
    """Train seeds that stand at the same step to the end, in this process.

    Args:
        config: The command's configuration.
        seeds: K seeds.
        count: Called after each step; None shows a progress bar instead.
    """
    # Threads would gain nothing on networks of this size, and their number would change the rounding.
    torch.set_num_threads(1)
    keep_freed_memory()
    dataset, _ = make_train_eval_datasets(config.of_seed(seeds[0]))
    runs = SeedRuns(config, seeds, dataset.meta)
    episodes = dataset.meta.episodes
    starts, ends = episodes["dataset_from_index"], episodes["dataset_to_index"]
    places = dataset.absolute_to_relative_idx
    orders = [FrameOrder(starts, ends, dataset.episodes, seed, config.batch_size, places) for seed in seeds]
    frames = _prepared_frames(runs, dataset)
    window: list[Tensor] = []
    with Progress(
        total=config.steps * len(seeds),
        initial=runs.step * len(seeds),
        desc="Training",
        unit="seed-step",
        disable=count is not None,
    ) as bar:
        while runs.step < config.steps:
            ahead = min(STEPS_AT_ONCE, _steps_to_save(config, runs.step))
            for lesson in _lessons(runs, orders, frames, ahead):
                window.append(runs.stack.step(lesson))
                runs.step += 1
                bar.update(len(seeds))
                if count is not None:
                    count()
                if runs.step % (config.log_freq or STEPS_AT_ONCE) == 0:
                    window = _report(seeds, runs.step, window, config.log_freq > 0)
            if should_save_checkpoint(runs.step, config.save_freq, config.steps):
                window = _report(seeds, runs.step, window, False)
                runs.save()


def _report(seeds: list[int], step: int, losses: list[Tensor], log: bool) -> list[Tensor]:
    """Log the mean loss of each seed over some steps; returns an empty list for the next ones.

    Raises:
        ValueError: If a loss is not finite.
    """
    if not losses:
        return []
    means = torch.stack(losses).mean(dim=0).tolist()
    broken = [seed for seed, mean in zip(seeds, means, strict=True) if not math.isfinite(mean)]
    if broken:
        raise ValueError(
            f"seeds {broken}: the loss is not finite by step {step}; lower policy.optimizer_lr and train anew"
        )
    if log:
        listed = ", ".join(f"{seed}: {loss:.4f}" for seed, loss in zip(seeds, means, strict=True))
        logger.info("step %d, mean loss of %d steps by seed: %s", step, len(losses), listed)
    return []


def _steps_to_save(config: SeedsTrainConfig, step: int) -> int:
    """Steps up to the next checkpoint, which must hold no draws of steps after it."""
    to_end = config.steps - step
    return min(to_end, config.save_freq - step % config.save_freq) if config.save_freq > 0 else to_end


def _prepared_frames(runs: SeedRuns, dataset: LeRobotDataset) -> dict[str, Tensor]:
    """The dataset's frames as batches bring them, in its order: feature to (F, d), episode to (F,)."""
    policy = runs.policies[0]
    keys = [*policy.config.observation_keys, ACTION]
    episodes, index = (dataset.hf_dataset.data.column(f"{key}index").to_numpy() for key in ("episode_", ""))
    rows = policy.trajectories.rows_of(episodes)
    columns = {key: policy.trajectories.columns[key] for key in keys}
    if not np.array_equal(rows, np.arange(len(columns[ACTION]))):
        columns = {key: column[rows] for key, column in columns.items()}
    prepared = runs.preprocessor({key: torch.from_numpy(column) for key, column in columns.items()})
    frames = {key: prepared[key] for key in keys}
    device = frames[ACTION].device
    numbers = {"episode_index": episodes, "index": index}
    return {**frames, **{key: torch.from_numpy(value.copy()).to(device) for key, value in numbers.items()}}


def _lessons(
    runs: SeedRuns, orders: list[FrameOrder], frames: dict[str, Tensor], count: int
) -> Iterator[dict[str, Tensor]]:
    """What the policies learn from in the next steps, at most `count`: each step's lessons (K, B, ...)."""
    parts: list[dict[str, Tensor]] = []
    n_steps = 0
    for policy, order in zip(runs.policies, orders, strict=True):
        rows = order.steps(runs.step, count).to(frames["index"].device)  # (S, B)
        n_steps = len(rows)
        batch = {key: value[rows.flatten()] for key, value in frames.items()}
        parts.append(policy.draw(batch, n_steps).tensors([*policy.config.observation_keys, ACTION]))
    stacked = {
        key: torch.stack([part[key].unflatten(0, (n_steps, -1)) for part in parts], dim=1)  # (S, K, B, ...)
        for key in parts[0]
    }
    for s in range(n_steps):
        yield {key: value[s] for key, value in stacked.items()}
