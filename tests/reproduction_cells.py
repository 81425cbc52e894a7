"""Cells of the paper's experiments on the small maze, and the folder that keeps their results."""

import pytest
from conftest import save_checkpoint

from lerobot_swr.reproduction.cells import Cell, Labels, Store
from lerobot_swr.reproduction.demonstrations import Demonstrations, prepare
from lerobot_swr.reproduction.experiments import training
from lerobot_swr.reproduction.settings import ReproductionSettings
from lerobot_swr.reproduction.training import checkpoint_folder


def cell(**definition) -> Cell:
    """A cell without a training."""
    return Cell("similarity", Labels("data", "", "similarity"), definition)


@pytest.fixture
def store(tmp_path) -> Store:
    """An empty folder of results."""
    return Store(tmp_path / "store")


@pytest.fixture
def demos(small_maze, store) -> Demonstrations:
    """The small maze, described."""
    return prepare(small_maze.name, small_maze.parent, store)


@pytest.fixture
def settings(tmp_path) -> ReproductionSettings:
    """Two seeds, twelve rollouts."""
    return ReproductionSettings(
        steps=20,
        seeds=2,
        n_rollouts=12,
        policy_options={"backbone.hidden_dim": 16},
        output_dir=tmp_path / "store",
    )


@pytest.fixture
def trained(settings, demos, store, make_tiny_policy, small_maze_meta) -> Cell:
    """A finished training cell of zbc; its policies are fresh, all of their styles marked as trained."""
    one = training(settings, demos, "zbc")
    for seed in one.definition["seeds"]:
        policy = make_tiny_policy("zbc", seed=seed)
        policy.styles.trained[:] = 1
        save_checkpoint(policy, small_maze_meta, checkpoint_folder(one, store, seed))
    store.write(one, {}, 0.0)
    return one
