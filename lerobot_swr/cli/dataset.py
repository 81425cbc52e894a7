"""``lerobot-swr-dataset``: write one of the package's demonstration datasets.

Examples:
    lerobot-swr-dataset --task=medium_maze-only_forward --root=data/only_forward --seed=0
    lerobot-swr-dataset --task=scenes_maze-two_ways --n_episodes=500 --root=data/two_ways
    lerobot-swr-dataset --task=avoiding --from_d3il=recordings/avoiding --root=data/recorded_avoiding
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.configs import parser
from lerobot.envs import make_env_config
from lerobot.utils.utils import init_logging

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.d3il_converter import recorded_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.evaluation.checks.replay import run_replay, summarize

REPLAYED_FRAMES = 10_000
"""About as many frames of converted recordings are replayed, of episodes spread over all of them."""


@dataclass
class DatasetCommand:
    """Options of ``lerobot-swr-dataset``."""

    # Which dataset: medium_maze-one_side, medium_maze-only_forward, medium_maze-only_fast or
    # medium_maze-spread_out; scenes_maze-two_ways, scenes_maze-two_ways_500 or scenes_large_maze-six_ways;
    # d3il_avoiding, d3il_unbalanced_avoiding, d3il_aligning or d3il_unbalanced_aligning.
    # With from_d3il: avoiding, unbalanced_avoiding (a seeded selection of avoiding's recordings) or aligning.
    task: str
    # Folder of the new dataset.
    root: Path
    # Number of demonstrations, of the scenes_* datasets; null takes the dataset's usual one.
    n_episodes: int | None = None
    # Seed of the demonstrations.
    seed: int = 0
    # Add what a camera sees (observation.images.top), for policies that are used with --env.obs_type=both.
    images: bool = False
    # What the environment shows that the dataset is for (--env.obs_type): state, both (the same as images) or
    # pixels: pictures, and as observation.state the change since the last step instead of places.
    obs_type: str | None = None
    # Name of the dataset for LeRobot; default: local/<task>.
    repo_id: str | None = None
    # Replace a dataset that is already in the folder.
    overwrite: bool = False
    # Convert the D3IL benchmark's own recordings (*.pkl) in this folder instead, and replay a
    # sample of them in the simulator.
    from_d3il: Path | None = None
    # With from_d3il: a pickled list of the file names to convert; default: all of them.
    file_list: Path | None = None


@parser.wrap()
def write(cfg: DatasetCommand) -> None:
    """Write the dataset and print its behaviour histogram."""
    if cfg.from_d3il is not None:
        recipe = recorded_recipe(cfg.from_d3il, cfg.task, cfg.file_list)
    else:
        recipe = get_recipe(cfg.task)
    if cfg.n_episodes is not None:
        recipe = recipe.with_episodes(cfg.n_episodes)
    obs_type = cfg.obs_type or ("both" if cfg.images else "state")
    if cfg.images and obs_type == "state":
        raise ValueError("--images=true and --obs_type=state exclude each other: leave out one of them")
    histogram = write_dataset(recipe, cfg.root, cfg.seed, cfg.repo_id, cfg.overwrite, obs_type)
    total = sum(histogram.values())
    print(f"{total} episodes of {recipe.name} in {cfg.root}")
    for behavior, count in histogram.most_common():
        print(f"  {behavior:>12} {count:4d}  {'#' * round(40 * count / max(histogram.values()))}")
    if cfg.from_d3il is not None:
        print(_replay(cfg.root))


def _replay(root: Path) -> str:
    """Whether the converted recordings and our simulator agree, on a sample that takes seconds."""
    meta = DatasetSource(root=root).metadata()
    env_type, task = str(meta.robot_type).split("_", 1)
    env_cfg = make_env_config(env_type, task=task)
    n = max(1, round(REPLAYED_FRAMES * meta.total_episodes / meta.total_frames))
    episodes = np.linspace(0, meta.total_episodes - 1, min(n, meta.total_episodes)).round().astype(int)
    try:
        rule = task_of(env_cfg).behavior_rule()
        result, *_ = run_replay(meta, env_cfg, rule, episodes.tolist())
    except ModuleNotFoundError as error:
        return f"not replayed in the simulator: {error}"
    return summarize(result)


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging()
    write()


if __name__ == "__main__":
    main()
