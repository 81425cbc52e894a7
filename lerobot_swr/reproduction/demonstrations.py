"""The datasets of the experiments: made where absent, and described for everything that comes after."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION

from lerobot_swr.behaviors import DATASET_RULES
from lerobot_swr.demos.catalog import RECIPES, get_recipe
from lerobot_swr.demos.d3il_converter import human_name, recorded_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.recipe import DatasetRecipe
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.behavior_evaluation import steps_to_end
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.evaluation.checks.length import frames_after_end
from lerobot_swr.reproduction.cells import Cell, Labels, Store
from lerobot_swr.trajectories import Trajectories, load_trajectories

HUMAN_DATASETS = {human_name(task): task for task in ("avoiding", "unbalanced_avoiding")}
"""Datasets of the benchmark's human recordings to the task that `recorded_recipe` makes them of."""

DESCRIPTION = 2  # another way of describing makes every dataset's cell a new one
PATH_POINTS = 40  # of a stored path
MAX_PATHS = 100  # stored per dataset


@dataclass(frozen=True)
class Demonstrations:
    """A dataset of the experiments.

    Attributes:
        name: Its name.
        root: Its folder.
        fingerprint: Hash of its observations and actions.
        env: Options of its environment, ``type`` and ``task`` among them.
        lengths: Frames of each demonstration.
    """

    name: str
    root: Path
    fingerprint: str
    env: dict[str, Any]
    lengths: tuple[int, ...]

    @property
    def cell(self) -> Cell:
        """The cell that holds the dataset's description."""
        definition = {
            "fingerprint": self.fingerprint,
            "env": whole_environment(self.env),
            "described": DESCRIPTION,
        }
        return Cell("dataset", Labels(self.name, "", ""), definition)


def prepare(name: str, folder: Path, store: Store, from_d3il: Path | None = None) -> Demonstrations:
    """Find or make a dataset, and store its description.

    Args:
        name: Name of the dataset.
        folder: Where datasets lie.
        store: Where the description goes.
        from_d3il: Folder with the benchmark's human recordings of avoiding, if there is one.

    Raises:
        ValueError: If there is no such dataset, or its environment is not one of this package's.
    """
    root = folder / name
    if not (root / "meta" / "info.json").is_file():
        print(f"making {name} in {root}", flush=True)
        write_dataset(_recipe(name, folder, from_d3il), root, seed=0)
    meta = DatasetSource(root=root).metadata()
    if meta.robot_type not in DATASET_RULES:
        raise ValueError(
            f"datasets: {name!r} has robot_type={meta.robot_type!r}; the experiments need an environment, "
            f"which this package has for {', '.join(DATASET_RULES)}"
        )
    trajectories = load_low_dimensional(root)
    env_type, task = meta.robot_type.split("_", 1)
    fingerprint = trajectories.fingerprint(sorted(trajectories.columns))
    lengths = tuple(trajectories.lengths.tolist())
    demonstrations = Demonstrations(name, root, fingerprint, {"type": env_type, "task": task}, lengths)
    if not store.is_done(demonstrations.cell):
        store.write(demonstrations.cell, _describe(trajectories, environment(demonstrations.env)), 0.0)
    return demonstrations


def _recipe(name: str, folder: Path, from_d3il: Path | None) -> DatasetRecipe:
    if name in HUMAN_DATASETS:
        if from_d3il is None:
            raise ValueError(
                f"datasets: {name!r} is made of the D3IL benchmark's human recordings of avoiding, which are "
                "not part of this package: give their folder with --from_d3il=FOLDER"
            )
        return recorded_recipe(from_d3il, HUMAN_DATASETS[name])
    if name not in RECIPES:
        raise ValueError(
            f"datasets: {name!r} is neither in {folder} nor one of the package's: {', '.join(RECIPES)}"
        )
    return get_recipe(name)


def load_low_dimensional(root: Path) -> Trajectories:
    """All observations and actions of a dataset of this package."""
    meta = DatasetSource(root=root).metadata()
    return load_trajectories(
        meta, [key for key in meta.features if key.startswith("observation.")] + [ACTION]
    )


def environment(options: Mapping[str, Any]) -> EnvConfig:
    """The environment's configuration from its type and the options that differ from its defaults, or all."""
    return draccus.decode(EnvConfig, dict(options))


def whole_environment(options: Mapping[str, Any]) -> dict[str, Any]:
    """All options of an environment, as cells hold them: a default that changes makes another cell."""
    return draccus.encode(environment(options), EnvConfig)


def short_path(path: np.ndarray) -> list[list[float]]:
    """At most `PATH_POINTS` points of a (T, 2) path, rounded, for pictures."""
    chosen = np.linspace(0, len(path) - 1, min(len(path), PATH_POINTS)).round().astype(int)
    return np.round(path[chosen].astype(float), 3).tolist()


def _describe(trajectories: Trajectories, env_cfg: EnvConfig) -> dict[str, Any]:
    task = task_of(env_cfg)
    rule = task.behavior_rule()
    stride = -(-len(trajectories) // MAX_PATHS)
    return {
        "behavior": [rule(episode) for episode in trajectories.episodes()],
        "length": trajectories.lengths.tolist(),
        "steps_to_end": steps_to_end(env_cfg, trajectories),
        "frames_after_end": frames_after_end(trajectories, env_cfg),
        "path_episodes": list(range(0, len(trajectories), stride)),
        "paths": [
            short_path(task.plot_path(trajectories.episode(i))) for i in range(0, len(trajectories), stride)
        ],
    }
