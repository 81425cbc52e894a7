"""Trains all seeds of one configuration at once, spread over processes."""

import ctypes
import logging
import multiprocessing
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from lerobot.common.train_utils import should_save_checkpoint
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.utils.constants import ACTION, CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot.utils.utils import init_logging
from torch import Tensor
from tqdm import tqdm

from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.frame_order import FrameOrder
from lerobot_swr.training.seed_runs import SeedRuns, check_options, last_step

STEPS_AT_ONCE = 64  # whose frames and pairs are drawn together

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h

logger = logging.getLogger(__name__)
_progress: Any = None  # per group of seeds the steps done, shared between processes


def train_seeds(config: SeedsTrainConfig) -> list[Path]:
    """Train one policy per seed; finished runs are left alone, begun ones go on from their last checkpoint.

    A seed's run is what ``lerobot-train --seed=…`` trains, up to rounding: the same initial weights, frames
    and pairs. It does not depend on the seeds that it is trained with.

    Args:
        config: A validated configuration.

    Returns:
        The folder of each seed's trained policy.

    Raises:
        ValueError: If the output folder was begun with other options.
    """
    check_options(config)
    steps = {seed: last_step(config.of_seed(seed)) for seed in config.seeds}
    waiting = [seed for seed in config.seeds if steps[seed] < config.steps]
    groups = list(_spread(waiting, steps, config.jobs or 1))
    if len(groups) == 1:
        _train_group(config, groups[0], 0, None)
    elif groups:
        _train_in_processes(config, groups, steps)
    assert config.output_dir is not None
    last = Path(CHECKPOINTS_DIR) / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR
    return [config.output_dir / f"seed_{seed}" / last for seed in config.seeds]


def _spread(seeds: list[int], steps: dict[int, int], jobs: int) -> Iterator[list[int]]:
    """Groups of seeds that have done the same number of steps, as many as there are processes or more."""
    ordered = sorted(seeds, key=lambda seed: (steps[seed], seeds.index(seed)))
    for _, same in groupby(ordered, key=steps.__getitem__):
        members = list(same)
        count = min(jobs, len(members))
        yield from (members[i::count] for i in range(count))


def _train_in_processes(config: SeedsTrainConfig, groups: list[list[int]], steps: dict[int, int]) -> None:
    context = multiprocessing.get_context("spawn")
    progress = context.Array("q", len(groups), lock=False)
    jobs = config.jobs or 1
    total = sum(config.steps - steps[seed] for group in groups for seed in group)
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start, initargs=(progress,))
    with pool, tqdm(total=total, desc="Training", unit="seed-step") as bar:
        futures = [pool.submit(_train_group, config, g, i, os.getpid()) for i, g in enumerate(groups)]
        while not all(future.done() for future in futures):
            time.sleep(0.2)
            bar.update(sum(progress) - bar.n)
            failed = [f for f in futures if f.done() and f.exception() is not None]
            if failed:
                pool.shutdown(wait=False, cancel_futures=True)
                failed[0].result()
        bar.update(sum(progress) - bar.n)


def _start(progress: Any) -> None:
    """Prepare a process."""
    global _progress
    _progress = progress
    init_logging()


def _train_group(config: SeedsTrainConfig, seeds: list[int], group: int, parent: int | None) -> None:
    """Train seeds that stand at the same step to the end, in this process.

    Args:
        config: The command's configuration.
        seeds: K seeds.
        group: Place of the group in the shared progress.
        parent: The process to end with; None shows a progress bar of its own.
    """
    # Threads would gain nothing on networks of this size, and their number would change the rounding.
    torch.set_num_threads(1)
    _keep_freed_memory()
    first = config.of_seed(seeds[0])
    dataset, _ = make_train_eval_datasets(first)
    runs = SeedRuns(config, seeds, dataset.meta)
    episodes = dataset.meta.episodes
    starts, ends = episodes["dataset_from_index"], episodes["dataset_to_index"]
    orders = [FrameOrder(starts, ends, dataset.episodes, seed, config.batch_size) for seed in seeds]
    frames = _prepared_frames(runs)
    bar = tqdm(
        total=config.steps * len(seeds),
        initial=runs.step * len(seeds),
        desc="Training",
        unit="seed-step",
        disable=parent is not None,
    )
    window: list[Tensor] = []
    while runs.step < config.steps:
        if parent is not None and os.getppid() != parent:
            raise SystemExit("the command has ended")
        count = min(STEPS_AT_ONCE, _steps_to_save(config, runs.step))
        for drawn in _draw(runs, orders, frames, count):
            window.append(runs.stack.step(drawn))
            runs.step += 1
            if config.log_freq > 0 and runs.step % config.log_freq == 0:
                means = torch.stack(window).mean(dim=0).tolist()
                listed = ", ".join(f"{seed}: {loss:.4f}" for seed, loss in zip(seeds, means, strict=True))
                logger.info("step %d, mean loss of %d steps by seed: %s", runs.step, len(window), listed)
                window = []
            if config.save_checkpoint and should_save_checkpoint(runs.step, config.save_freq, config.steps):
                runs.save()
            bar.update(len(seeds))
            if _progress is not None:
                _progress[group] += len(seeds)
    bar.close()


def _keep_freed_memory() -> None:
    """Let freed memory stay with the process where the C library is glibc.

    It would give large blocks back to the system, and every step would have the gradients' pages mapped anew.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, 32 << 20)
        mallopt(M_TRIM_THRESHOLD, 512 << 20)


def _steps_to_save(config: SeedsTrainConfig, step: int) -> int:
    """Steps up to the next checkpoint, which must hold no draws of steps after it."""
    to_end = config.steps - step
    return min(to_end, config.save_freq - step % config.save_freq) if config.save_freq > 0 else to_end


def _prepared_frames(runs: SeedRuns) -> dict[str, Tensor]:
    """All frames of the dataset as batches bring them to the policy: feature to (F, d), episode to (F,)."""
    policy = runs.policies[0]
    keys = [*policy.config.observation_keys, ACTION]
    raw = {key: torch.from_numpy(policy.trajectories.columns[key]) for key in keys}
    lengths = torch.from_numpy(policy.trajectories.lengths)
    episodes = torch.repeat_interleave(torch.arange(len(lengths)), lengths)
    prepared = runs.preprocessor(raw)
    frames = {key: prepared[key] for key in keys}
    device = frames[ACTION].device
    return {**frames, "episode_index": episodes.to(device), "index": torch.arange(len(episodes)).to(device)}


def _draw(
    runs: SeedRuns, orders: list[FrameOrder], frames: dict[str, Tensor], count: int
) -> Iterator[dict[str, Tensor]]:
    """What the policies learn from in the next steps, at most `count`: each step's draws (K, B, ...)."""
    parts: list[dict[str, Tensor]] = []
    n_steps = 0
    for policy, order in zip(runs.policies, orders, strict=True):
        rows = order.steps(runs.step, count).to(frames["index"].device)  # (S, B)
        n_steps = len(rows)
        batch = {key: value[rows.flatten()] for key, value in frames.items()}
        parts.append(policy.draw(batch, n_steps))
    stacked = {
        key: torch.stack([part[key].unflatten(0, (n_steps, -1)) for part in parts], dim=1)  # (S, K, B, ...)
        for key in parts[0]
    }
    for s in range(n_steps):
        yield {key: value[s] for key, value in stacked.items()}
