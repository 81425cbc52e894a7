"""Writes a recipe's demonstrations as a LeRobotDataset v3, all or nothing."""

import json
import shutil
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from datasets import disable_progress_bars
from lerobot.datasets import LeRobotDataset
from tqdm import tqdm

from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration


def write_dataset(
    recipe: DatasetRecipe, root: Path, seed: int = 0, repo_id: str | None = None, overwrite: bool = False
) -> Counter[str]:
    """Write a dataset into `root`.

    The dataset is built in a temporary folder beside `root` and moved there when it is complete, so that an
    interrupted run leaves nothing half-written and an overwritten dataset is replaced at once.

    Args:
        recipe: What to write.
        root: Folder of the new dataset.
        seed: Seed of the demonstrations; the same seed gives the same data files, byte for byte.
        repo_id: Name of the dataset, by default ``local/<recipe name>``.
        overwrite: Replace a dataset that is already there.

    Returns:
        The behaviour histogram of the dataset.

    Raises:
        FileExistsError: If `root` exists and is not to be overwritten, or is no dataset.
    """
    check_root(root, overwrite)
    root.parent.mkdir(parents=True, exist_ok=True)
    histogram: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix=f".{root.name}-", dir=root.parent) as workspace:
        dataset = LeRobotDataset.create(
            repo_id=repo_id or f"local/{recipe.name}",
            fps=recipe.fps,
            features={
                key: {"dtype": "float32", "shape": (len(names),), "names": list(names)}
                for key, names in recipe.features.items()
            },
            root=Path(workspace) / "dataset",
            robot_type=recipe.robot_type,
            use_videos=False,
        )
        disable_progress_bars()  # those of `datasets`, one per episode
        try:
            for demonstration in tqdm(
                recipe.demonstrations(seed), total=recipe.n_episodes, desc=recipe.name, unit="episode"
            ):
                _add_episode(dataset, demonstration, recipe.instruction)
                histogram[recipe.behavior_rule(demonstration.observations)] += 1
        finally:
            dataset.finalize()  # else the writer would do so later, in a folder that is gone by then
        _sort_statistics(Path(workspace) / "dataset" / "meta" / "stats.json")
        if root.exists():
            shutil.rmtree(root)
        (Path(workspace) / "dataset").rename(root)
    return histogram


def _add_episode(dataset: LeRobotDataset, demonstration: Demonstration, instruction: str) -> None:
    columns = {**demonstration.observations, "action": demonstration.actions}
    for t in range(len(demonstration.actions)):
        frame = {key: np.asarray(column[t], dtype=np.float32) for key, column in columns.items()}
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
