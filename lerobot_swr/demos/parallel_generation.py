"""Makes demonstrations on all cores and keeps the finished ones, so that an interrupted run can go on."""

import os
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from lerobot_swr.demos.recipe import Demonstration

Job = Callable[[int], Demonstration]
"""Makes episode number i; all of its randomness comes from i and what the job holds. Must be picklable."""


def generate(
    job: Job, n_episodes: int, work_dir: Path, n_workers: int | None = None
) -> Iterator[Demonstration]:
    """The episodes 0 to n - 1, in order.

    Every finished episode is kept as a file in `work_dir`, which a later run with the same job continues
    from. As each episode depends on its number alone, the result depends neither on interruptions nor on
    `n_workers`.

    Args:
        job: Makes one episode.
        n_episodes: How many.
        work_dir: Folder of the finished episodes, made if it is missing. Whoever chooses it removes it.
        n_workers: Processes, by default one per core; with 1, this process does the work.
    """
    work_dir.mkdir(parents=True, exist_ok=True)
    n_workers = n_workers or os.cpu_count() or 1
    missing = [i for i in range(n_episodes) if load_episode(_episode_path(work_dir, i)) is None]
    if n_workers == 1 or len(missing) < 2:
        for i in range(n_episodes):
            yield _made(job, i, work_dir)
        return
    # Not forked: a fork of a process that has started threads (torch, numba) may hang. The server imports the
    # job's module once for all workers.
    context = get_context("forkserver")
    context.set_forkserver_preload([type(job).__module__])
    pool = ProcessPoolExecutor(min(n_workers, len(missing)), mp_context=context)
    try:
        pending: dict[int, Future[None]] = {i: pool.submit(_make, job, i, work_dir) for i in missing}
        for i in range(n_episodes):
            if i in pending:
                pending.pop(i).result()
            yield _made(job, i, work_dir)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _episode_path(work_dir: Path, i: int) -> Path:
    return work_dir / f"episode-{i:06d}.npz"


def _make(job: Job, i: int, work_dir: Path) -> None:
    save_episode(_episode_path(work_dir, i), job(i))


def _made(job: Job, i: int, work_dir: Path) -> Demonstration:
    episode = load_episode(_episode_path(work_dir, i))
    if episode is None:
        episode = job(i)
        save_episode(_episode_path(work_dir, i), episode)
    return episode


def save_episode(path: Path, episode: Demonstration) -> None:
    """Write an episode so that the file is either complete or not there."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.partial")
    with temporary.open("wb") as file:
        observations = {f"observations/{key}": value for key, value in episode.observations.items()}
        np.savez(file, actions=episode.actions, **observations)  # type: ignore[arg-type]
    temporary.replace(path)


def load_episode(path: Path) -> Demonstration | None:
    """Read an episode; None if there is no readable one."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        actions = arrays.pop("actions")
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    return Demonstration({key.removeprefix("observations/"): value for key, value in arrays.items()}, actions)
