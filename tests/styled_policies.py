"""Style policies over LeRobot's own policies and a plugin's, small and quick."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import toy_plugin.configuration_toy  # noqa: F401  (registers the plugin)
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config
from odd_datasets import PLAIN, arcs, feature, write

from lerobot_swr.run_context import running

CAMERAS = ("observation.images.front", "observation.images.wrist")
LENGTHS = (9, 12, 10)
KINDS = ("act", "diffusion", "toy", "smolvla")

TINY: dict[str, dict[str, Any]] = {
    "act": {
        "chunk_size": 4,
        "n_action_steps": 2,
        "dim_model": 16,
        "n_heads": 2,
        "dim_feedforward": 16,
        "n_encoder_layers": 1,
        "n_vae_encoder_layers": 1,
        "latent_dim": 4,
        "pretrained_backbone_weights": None,
    },
    "diffusion": {
        "horizon": 8,
        "n_action_steps": 4,
        "down_dims": (8, 16),
        "n_groups": 4,
        "diffusion_step_embed_dim": 8,
        "num_train_timesteps": 10,
        "num_inference_steps": 3,
        "prediction_type": "sample",
        "pretrained_backbone_weights": None,
        "spatial_softmax_num_keypoints": 4,
    },
    "toy": {},
    "tdmpc": {"horizon": 2},
    "beso": {"dim_model": 16, "n_layers": 1, "n_heads": 2},
    "ddpm_gpt": {"dim_model": 16, "n_layers": 1, "n_heads": 2},
    "ddpm_act": {"dim_model": 16, "n_heads": 2},
    "smolvla": {
        "chunk_size": 4,
        "n_action_steps": 2,
        "resize_imgs_with_padding": (64, 64),
        "num_vlm_layers": 2,
        "num_steps": 2,
        "max_state_dim": 16,
        "max_action_dim": 4,
        "optimizer_lr": 1e-3,
    },
}


def tiny_options(kind: str, tiny_vlm: Path | None = None) -> dict[str, Any]:
    """Options of a small backbone."""
    return {**TINY[kind], **({} if tiny_vlm is None else {"vlm_model_name": str(tiny_vlm)})}


def seen(i: int, t: int, n: int) -> dict[str, Any]:
    """A frame of an arc, with two pictures."""
    frame = arcs(i, t, n)
    shade = np.round(120 * (frame["observation.state"] + 1)).astype(np.uint8)
    pictures = {key: np.full((32, 32, 3), shade[k % 2], np.uint8) for k, key in enumerate(CAMERAS)}
    return {**frame, **pictures}


@pytest.fixture(scope="session")
def camera_arcs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a dataset of three arcs with two cameras; tests must not change it."""
    cameras = {
        key: {**feature(32, 32, 3, dtype="image"), "names": ["height", "width", "channels"]}
        for key in CAMERAS
    }
    root = tmp_path_factory.mktemp("cameras") / "arcs"
    return write(root, {**PLAIN, **cameras}, seen, LENGTHS)


@pytest.fixture
def make_styled(request: pytest.FixtureRequest) -> Callable[..., PreTrainedPolicy]:
    """Builds a style policy over a small backbone through LeRobot's factory, the same for the same seed."""

    def make(
        policy_type: str,
        kind: str,
        root: Path,
        seed: int = 0,
        episodes: list[int] | None = None,
        backbone: dict[str, Any] | None = None,
        **options: Any,
    ) -> PreTrainedPolicy:
        vlm = request.getfixturevalue("tiny_vlm") if kind == "smolvla" else None
        inner = {"device": "cpu", **tiny_options(kind, vlm), **(backbone or {})}
        chosen = PreTrainedConfig.get_choice_class(kind)(**inner)
        torch.manual_seed(seed)
        config = make_policy_config(policy_type, backbone=chosen, device="cpu", push_to_hub=False, **options)
        with running(DatasetConfig(f"local/{root.name}", episodes=episodes)):
            return make_policy(config, ds_meta=metadata_of(root))

    return make


def metadata_of(root: Path) -> LeRobotDatasetMetadata:
    """Metadata of a dataset on disk."""
    return LeRobotDatasetMetadata(f"local/{root.name}", root=root)


def batch_of(policy: PreTrainedPolicy, root: Path, size: int = 8) -> dict[str, Any]:
    """A preprocessed batch as LeRobot's training brings it to a policy, in a fixed order."""
    meta = metadata_of(root)
    windows = resolve_delta_timestamps(policy.config, meta)
    dataset = LeRobotDataset(meta.repo_id, root=root, delta_timestamps=windows)
    rows = torch.randperm(len(dataset), generator=torch.Generator().manual_seed(0))[:size].tolist()
    raw = torch.utils.data.default_collate([dataset[row] for row in rows])
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    return preprocessor(raw)


def observed(policy: PreTrainedPolicy, root: Path, size: int = 3, row: int = 0) -> dict[str, Any]:
    """Preprocessed observations as an environment brings them: no windows, no action."""
    meta = metadata_of(root)
    dataset = LeRobotDataset(meta.repo_id, root=root)
    keys = list(policy.config.input_features)
    raw = torch.utils.data.default_collate([dataset[row + k] for k in range(size)])
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    return preprocessor({**{key: raw[key] for key in keys}, "task": raw["task"]})


@pytest.fixture
def data_of(request: pytest.FixtureRequest) -> Callable[[str], Path]:
    """The dataset that a kind of backbone is tried on: with pictures for those that need one."""

    def find(kind: str) -> Path:
        return request.getfixturevalue("camera_arcs" if kind == "smolvla" else "small_maze")

    return find


def nested(kind: str, prefix: str = "policy.backbone.") -> list[str]:
    """A small backbone on the command line."""
    options = {"type": kind, **TINY[kind]}
    return [f"--{prefix}{key}={_plain(value)}" for key, value in options.items()]


def _plain(value) -> str:
    return json.dumps(list(value) if isinstance(value, tuple) else value).strip('"')


def checkpoint(folder: Path, step: str = "last") -> Path:
    """A run's checkpoint."""
    return folder / "checkpoints" / step / "pretrained_model"


def load(folder: Path):
    """A policy."""
    config = PreTrainedConfig.from_pretrained(folder)
    return get_policy_class(config.type).from_pretrained(folder, config=config)
