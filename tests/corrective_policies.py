"""Small policies with corrective labels, a dataset of absolute targets, and batches of their frames."""

from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config

from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
LAG = 4


def servo_demonstrations(seed: int):
    """Two joints that follow absolute targets."""
    rng = np.random.default_rng(seed)
    for _ in range(6):
        noise = rng.standard_normal((90, 2))
        targets = np.stack([np.convolve(n, np.ones(15) / 15, "same") for n in noise.T], axis=1).cumsum(axis=0)
        states = np.zeros((90, 2))
        for t in range(1, 90):
            states[t] = states[t - 1] + (targets[t - 1] - states[t - 1]) / LAG
        yield Demonstration({STATE: states.astype(np.float32)}, targets.astype(np.float32))


@pytest.fixture(scope="session")
def servo_dataset(tmp_path_factory) -> Path:
    """Folder of a dataset whose actions are absolute targets; tests must not change it."""
    root = tmp_path_factory.mktemp("datasets") / "servo"
    features = {STATE: ("a", "b"), ACTION: ("a", "b")}
    recipe = DatasetRecipe(
        "servo", "Move.", 20, "arm", features, 6, servo_demonstrations, lambda episode: "moved"
    )
    write_dataset(recipe, root)
    return root


def make(root: Path, policy_type: str = "zbc", **options):
    """A small policy on a dataset, in training mode."""
    torch.manual_seed(0)
    options = {"backbone": MLPConfig(16, 3), "device": "cpu", "push_to_hub": False, **options}
    meta = LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    return make_policy(make_policy_config(policy_type, **options), ds_meta=meta).train(), meta


def batch_of(policy, meta, rows: torch.Tensor) -> dict[str, torch.Tensor]:
    """Frames as LeRobot's loader and preprocessor bring them."""
    trajectories = policy.trajectories
    raw = {key: torch.from_numpy(column)[rows] for key, column in trajectories.columns.items()}
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    prepared = preprocessor({key: raw[key] for key in [*policy.config.observation_keys, ACTION]})
    episodes = np.repeat(np.arange(len(trajectories)), trajectories.lengths)
    keys = [*policy.config.observation_keys, ACTION]
    return {
        **{k: prepared[k] for k in keys},
        "episode_index": torch.from_numpy(episodes)[rows],
        "index": rows,
    }


def every_frame(policy) -> torch.Tensor:
    """All rows of the dataset, shuffled."""
    count = int(policy.trajectories.lengths.sum())
    return torch.randperm(count, generator=torch.Generator().manual_seed(3))
