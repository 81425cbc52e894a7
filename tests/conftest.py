"""Datasets, policies and commands that the tests share."""

import os
import sys
from collections.abc import Callable
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

import pytest
import torch
from hypothesis import HealthCheck, settings
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config
from lerobot.scripts import lerobot_train

import lerobot_swr  # noqa: F401  (registers policies and environments)
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.run_context import running

# A busy machine fails no test.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

pytest_plugins = [
    "corrective_policies",
    "odd_datasets",
    "reproduction_cells",
    "styled_policies",
    "tiny_smolvla",
    "training_command",
]  # more fixtures

SMALL_MAZE = {"10": 4, "20": 2}  # behaviour -> number of episodes
OBSERVATIONS = ("observation.state", "observation.environment_state")
WINDOW, CHUNK = 5, 4  # of the baselines


@pytest.fixture(scope="session")
def small_maze(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a dataset of 6 episodes in the small maze; tests must not change it."""
    root = tmp_path_factory.mktemp("datasets") / "small_maze"
    write_dataset(_recipe("small_maze", "small", SMALL_MAZE, steady), root, seed=0)
    return root


@pytest.fixture(scope="session")
def small_maze_meta(small_maze: Path) -> LeRobotDatasetMetadata:
    """Metadata of `small_maze`."""
    return LeRobotDatasetMetadata("local/small_maze", root=small_maze)


@pytest.fixture
def make_tiny_policy(small_maze_meta: LeRobotDatasetMetadata) -> Callable[..., PreTrainedPolicy]:
    """Builds a small policy on `small_maze` through LeRobot's factory, the same for the same seed.

    It is made to train on `episodes`; None takes all.
    """

    def make(
        policy_type: str, seed: int = 0, episodes: list[int] | None = None, **options
    ) -> PreTrainedPolicy:
        torch.manual_seed(seed)
        options = {"backbone": MLPConfig(16, 3), "device": "cpu", "push_to_hub": False, **options}
        with running(DatasetConfig("local/small_maze", episodes=episodes)):
            return make_policy(make_policy_config(policy_type, **options), ds_meta=small_maze_meta)

    return make


def make_batch(n_frames: int = 32, n_episodes: int = 6, seed: int = 1) -> dict[str, torch.Tensor]:
    """A batch of normalised frames of the small maze's dimensions, every episode in it."""
    generator = torch.Generator().manual_seed(seed)
    return {
        "observation.state": torch.randn(n_frames, 2, generator=generator),
        "observation.environment_state": torch.randn(n_frames, 2, generator=generator),
        "action": torch.randn(n_frames, 2, generator=generator),
        "episode_index": torch.arange(n_frames) % n_episodes,
    }


@pytest.fixture
def make_baseline(small_maze_meta: LeRobotDatasetMetadata) -> Callable[..., PreTrainedPolicy]:
    """Builds a small baseline on `small_maze` through LeRobot's factory, the same for the same seed."""

    def make(policy_type: str, seed: int = 0, **options) -> PreTrainedPolicy:
        torch.manual_seed(seed)
        options = {"dim_model": 16, "n_heads": 2, "device": "cpu", "push_to_hub": False, **options}
        policy = make_policy(make_policy_config(policy_type, **options), ds_meta=small_maze_meta)
        with torch.no_grad():  # as initialised, the networks say almost nothing
            for parameter in policy.network.parameters():
                parameter.add_(0.3 * torch.randn_like(parameter))
        policy.average.module.load_state_dict(policy.network.state_dict())
        return policy.eval()

    return make


def make_windows(n_windows: int = 32, policy_type: str = "beso", n_pads: int = 0, seed: int = 1) -> dict:
    """A batch of normalised windows of the small maze's dimensions, the first `n_pads` steps padded."""
    generator = torch.Generator().manual_seed(seed)
    n_actions = CHUNK if policy_type == "ddpm_act" else WINDOW
    batch = {key: torch.randn(n_windows, WINDOW, 2, generator=generator) for key in OBSERVATIONS}
    before = torch.arange(WINDOW).expand(n_windows, -1) < n_pads
    # A chunk's padding comes after the episode's end, a window's before its start.
    after = torch.arange(CHUNK, 0, -1).expand(n_windows, -1) <= n_pads
    return {
        **batch,
        "action": torch.randn(n_windows, n_actions, 2, generator=generator),
        "observation.state_is_pad": before,
        "action_is_pad": after if policy_type == "ddpm_act" else before,
    }


def save_checkpoint(policy: PreTrainedPolicy, meta: LeRobotDatasetMetadata, folder: Path) -> Path:
    """Save a policy with its processors, as LeRobot does after training."""
    preprocessor, postprocessor = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    policy.save_pretrained(folder)
    preprocessor.save_pretrained(folder)
    postprocessor.save_pretrained(folder)
    return folder


@pytest.fixture
def lerobot_train_command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs ``lerobot-train`` with the given flags in this process."""

    def run(*flags: str) -> None:
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags])
        lerobot_train.main()

    return run


@pytest.fixture
def run_command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs one of this package's commands with the given flags in this process."""

    def run(main: Callable[[], None], *flags: str) -> None:
        monkeypatch.setattr(sys, "argv", [main.__module__, *map(str, flags)])
        main()

    return run


def train_flags(policy_type: str, root: Path, output_dir: Path, steps: int, *more: str) -> list[str]:
    """Flags of a short ``lerobot-train`` run on the CPU."""
    return [
        f"--policy.type={policy_type}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--dataset.repo_id=local/{root.name}",
        f"--dataset.root={root}",
        "--batch_size=8",
        "--num_workers=0",
        f"--steps={steps}",
        f"--output_dir={output_dir}",
        *more,
    ]


@pytest.fixture(scope="module", autouse=True)
def subnormal_numbers() -> None:
    """Undo what policies of earlier modules set for the whole process (``flush_denormal``)."""
    torch.set_flush_denormal(False)
