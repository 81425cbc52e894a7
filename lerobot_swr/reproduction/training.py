"""Computes a training cell with `lerobot-swr-train`, one ordinary LeRobot run per seed."""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from lerobot_swr.reproduction.cells import Cell, Store
from lerobot_swr.training.memory import LARGE_PAGES

STACKED = ("bc", "zbc", "wzbc")  # lerobot-swr-train trains all seeds at once, of others one after the other
CHECKPOINTS = 10  # periodic checkpoints of a training, from which it resumes


def train(cell: Cell, store: Store, dataset: Path, lock: int) -> dict[str, Any]:
    """Train all seeds of a cell, or go on where an interrupted attempt stopped.

    Args:
        cell: A training cell.
        store: Where its checkpoints go.
        dataset: Folder of the dataset.
        lock: The cell's lock, which the training processes hold as well.

    Returns:
        The result: seed to checkpoint folder, relative to the store.

    Raises:
        ChildProcessError: If a training fails; the cell's log says why.
    """
    definition = cell.definition
    output_dir = store.work_folder(cell) / "run"
    seeds = ",".join(str(seed) for seed in definition["seeds"])
    flags = [f"--seeds={seeds}", "--jobs=1", "--num_workers=0", "--resume=true"]
    _run(cell, store, dataset, output_dir, flags, lock)
    for seed in definition["seeds"]:
        _keep_the_last_checkpoint(output_dir / f"seed_{seed}")
    return {
        "checkpoints": {
            str(seed): str(checkpoint_folder(cell, store, seed).relative_to(store.root))
            for seed in definition["seeds"]
        }
    }


def checkpoint_folder(cell: Cell, store: Store, seed: int) -> Path:
    """The trained policy of one seed."""
    step = f"{cell.definition['steps']:06d}"
    return store.work_folder(cell) / "run" / f"seed_{seed}" / "checkpoints" / step / "pretrained_model"


def steps_done(cell: Cell, store: Store) -> float:
    """Share of a training that its periodic checkpoints hold, 0 to 1."""
    seeds = cell.definition["seeds"]
    folders = (store.work_folder(cell) / "run").glob("seed_*/checkpoints")
    saved = [max((int(p.name) for p in f.iterdir() if p.name.isdigit()), default=0) for f in folders]
    return min(1.0, sum(saved) / (len(seeds) * cell.definition["steps"]))


def _run(
    cell: Cell,
    store: Store,
    dataset: Path,
    output_dir: Path,
    more: Sequence[str],
    lock: int,
) -> None:
    definition = cell.definition
    steps = definition["steps"]
    options = [f"--policy.{key}={_flag(value)}" for key, value in definition["options"].items()]
    command = [
        *_lerobot_swr_train(),
        f"--policy.type={definition['policy']}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        *options,
        f"--dataset.repo_id=local/{dataset.name}",
        f"--dataset.root={dataset}",
        f"--batch_size={definition['batch_size']}",
        f"--steps={steps}",
        f"--save_freq={-(-steps // CHECKPOINTS)}",
        f"--log_freq={max(1, steps // 100)}",
        f"--output_dir={output_dir}",
        *more,
    ]
    _execute(command, cell, store, lock)


def _execute(command: Sequence[str], cell: Cell, store: Store, lock: int) -> None:
    settings = {**LARGE_PAGES, **os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    with store.log_path(cell).open("a") as log:
        log.write(f"$ {' '.join(command)}\n")
        log.flush()
        run = subprocess.run(
            list(command), stdout=log, stderr=subprocess.STDOUT, env=settings, pass_fds=(lock,)
        )
    if run.returncode != 0:
        raise ChildProcessError(f"the training of {cell.labels} ended with status {run.returncode}")


def _lerobot_swr_train() -> list[str]:
    return [sys.executable, "-c", "from lerobot_swr.cli.train import main; main()"]


def _flag(value: Any) -> str:
    """A value as LeRobot's command line reads it."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("\n...\n").strip()


def _keep_the_last_checkpoint(run: Path) -> None:
    last = (run / "checkpoints" / "last").resolve().name
    for folder in (run / "checkpoints").iterdir():
        if folder.name in ("last", last):
            continue
        if folder.is_symlink():  # left by a run that was killed while it moved "last"
            folder.unlink()
        else:
            shutil.rmtree(folder)
