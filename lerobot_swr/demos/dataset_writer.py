"""Writes a recipe's demonstrations as a LeRobotDataset v3, all or nothing."""

import json
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from datasets import disable_progress_bars
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION

from lerobot_swr.demos.columns import check_columns, feature_columns, frame_columns
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.progress import Progress


def write_dataset(
    recipe: DatasetRecipe,
    root: Path,
    seed: int = 0,
    repo_id: str | None = None,
    overwrite: bool = False,
    obs_type: str = "state",
) -> Counter[str]:
    """Write a dataset into `root`.

    The dataset is built in a hidden work folder beside `root` and moved there when it is complete, so that an
    interrupted run leaves nothing half-written and an old dataset is removed only when the new one is
    complete. Where the recipe keeps finished episodes in the work folder, the next run with the same seed
    continues from them.

    Args:
        recipe: What to write.
        root: Folder of the new dataset.
        seed: Seed of the demonstrations; the same seed gives the same data files, byte for byte.
        repo_id: Name of the dataset, by default ``local/<recipe name>``.
        overwrite: Replace a dataset that is already there.
        obs_type: What the environment shows for which the dataset is made: ``state``, ``both`` or ``pixels``,
            see `lerobot_swr.envs.observed`.

    Returns:
        The behaviour histogram of the dataset.

    Raises:
        FileExistsError: If `root` exists and is not to be overwritten, or is no dataset.
        ValueError: If the recipe has no pictures for what the environment shows.
    """
    check_columns(recipe, obs_type)
    check_root(root, overwrite)
    work_dir = root.parent / f".{root.name}-{recipe.name}-seed{seed}"
    work_dir.mkdir(parents=True, exist_ok=True)
    for leftover in work_dir.glob("building-*"):
        shutil.rmtree(leftover)  # of a run that was killed
    histogram: Counter[str] = Counter()
    with (
        _removed_if_useless(work_dir),
        tempfile.TemporaryDirectory(prefix="building-", dir=work_dir) as workspace,
    ):
        dataset = LeRobotDataset.create(
            repo_id=repo_id or f"local/{recipe.name}",
            fps=recipe.fps,
            features=feature_columns(recipe, obs_type),
            root=Path(workspace) / "dataset",
            robot_type=recipe.robot_type,
            use_videos=False,
        )
        disable_progress_bars()  # those of `datasets`, one per episode
        try:
            for demonstration in Progress(
                _demonstrations(recipe, seed, work_dir),
                total=recipe.n_episodes,
                desc=recipe.name,
                unit="episode",
            ):
                add_episode(dataset, frame_columns(recipe, demonstration, obs_type), recipe.instruction)
                histogram[recipe.behavior_rule(demonstration.observations)] += 1
        finally:
            dataset.finalize()  # else the writer would do so later, in a folder that is gone by then
        _sort_statistics(Path(workspace) / "dataset" / "meta" / "stats.json")
        if root.exists():
            shutil.rmtree(root)
        (Path(workspace) / "dataset").rename(root)
    shutil.rmtree(work_dir)
    return histogram


def _demonstrations(recipe: DatasetRecipe, seed: int, work_dir: Path) -> Iterator[Demonstration]:
    if recipe.resumable_demonstrations is None:
        return recipe.demonstrations(seed)
    return recipe.resumable_demonstrations(seed, work_dir / "episodes")


@contextmanager
def _removed_if_useless(work_dir: Path) -> Iterator[None]:
    """Remove the work folder after an error or an interruption, unless it holds finished episodes."""
    try:
        yield
    except BaseException:
        if not any(path.is_file() for path in work_dir.rglob("*")):
            shutil.rmtree(work_dir)
        raise


def add_episode(dataset: LeRobotDataset, columns: Mapping[str, np.ndarray], instruction: str) -> None:
    """Write one episode, its observations and actions (T, ...), into a dataset that is open for writing."""
    for t in range(len(columns[ACTION])):
        frame = {
            key: column[t] if column.dtype == np.uint8 else np.asarray(column[t], dtype=np.float32)
            for key, column in columns.items()
        }
        dataset.add_frame({**frame, "task": instruction})
    dataset.save_episode()


def _sort_statistics(path: Path) -> None:
    """Give the statistics a fixed order; LeRobot writes them in the order of a set of strings."""
    path.write_text(json.dumps(json.loads(path.read_text()), indent=4, sort_keys=True))


def check_root(root: Path, overwrite: bool) -> None:
    """Refuse a target folder that must not be replaced.

    Raises:
        FileExistsError: If `root` exists and is not to be overwritten, or is no dataset.
    """
    if not root.exists():
        return
    if not overwrite:
        raise FileExistsError(f"root={str(root)!r} already exists; pass --overwrite=true to replace it")
    if not (root / "meta" / "info.json").is_file():
        raise FileExistsError(
            f"root={str(root)!r} exists and is not a LeRobot dataset (no meta/info.json); "
            "it is not overwritten, choose another folder"
        )
