"""What styles cost: a training step and an action of a style policy beside those of its plain backbone.

All are timed in one run, in rounds that take turns, on random episodes of unequal lengths: with the small
networks of the recipes or, with --full, with the sizes that LeRobot has by default; with and without two
cameras of 96 × 96 pixels; smolvla with a tiny random model, where transformers is there.
"""

import argparse
import copy
import importlib.util
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config

import lerobot_swr  # noqa: F401
from benchmarks.tiny_vlm import write_tiny_vlm
from lerobot_swr.policies.backbones.style_probe import invented_batch

KINDS = ("plain", "zbc", "wzbc")
CAMERAS = ("observation.images.front", "observation.images.wrist")
SMALL: dict[str, dict[str, Any]] = {
    "act": {
        **{"chunk_size": 16, "n_action_steps": 8, "dim_model": 64, "n_heads": 4, "dim_feedforward": 256},
        **{"n_encoder_layers": 2, "use_vae": False, "pretrained_backbone_weights": None},
    },
    "diffusion": {
        **{
            "horizon": 16,
            "n_action_steps": 8,
            "down_dims": (32, 64),
            "n_groups": 4,
            "num_inference_steps": 10,
        },
        **{"diffusion_step_embed_dim": 32, "prediction_type": "sample", "noise_scheduler_type": "DDIM"},
        **{"pretrained_backbone_weights": None},
    },
    "smolvla": {
        "chunk_size": 16,
        "n_action_steps": 8,
        "num_vlm_layers": 2,
        "resize_imgs_with_padding": (64, 64),
    },
}
FULL: dict[str, dict[str, Any]] = {
    "act": {"use_vae": False, "pretrained_backbone_weights": None},
    "diffusion": {
        "num_inference_steps": 10,
        "noise_scheduler_type": "DDIM",
        "pretrained_backbone_weights": None,
    },
}


def write_data(root: Path, cameras: bool) -> LeRobotDatasetMetadata:
    """A dataset of 8 random episodes."""
    numbers = {"observation.state": (6,), "observation.environment_state": (4,), "action": (6,)}
    features: dict[str, dict] = {
        k: {"dtype": "float32", "shape": s, "names": None} for k, s in numbers.items()
    }
    picture = {"dtype": "image", "shape": (96, 96, 3), "names": ["height", "width", "channels"]}
    features |= dict.fromkeys(CAMERAS, picture) if cameras else {}
    dataset = LeRobotDataset.create("local/bench", fps=10, root=root, features=features, use_videos=False)
    random = np.random.default_rng(0)
    for length in range(16, 24):
        for _ in range(length):
            frame = {key: random.normal(size=shape).astype(np.float32) for key, shape in numbers.items()}
            frame |= {k: random.integers(0, 255, (96, 96, 3), np.uint8) for k in CAMERAS} if cameras else {}
            dataset.add_frame({**frame, "task": "bench"})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDatasetMetadata("local/bench", root=root)


def make(
    kind: str, method: str, options: dict[str, Any], meta: LeRobotDatasetMetadata, device: str
) -> PreTrainedPolicy:
    torch.manual_seed(0)
    if method == "plain":
        return make_policy(make_policy_config(kind, device=device, **options), ds_meta=meta)
    backbone = PreTrainedConfig.get_choice_class(kind)(device=device, **options)
    return make_policy(make_policy_config(method, backbone=backbone, device=device), ds_meta=meta)


def train_step(policy: PreTrainedPolicy, meta: LeRobotDatasetMetadata, batch_size: int) -> Callable[[], None]:
    plain = plain_config(policy)
    pre, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    raw = invented_batch(plain, windows=True)
    raw = {
        k: v.repeat(batch_size // 2, *[1] * (v.ndim - 1)) if torch.is_tensor(v) else v * (batch_size // 2)
        for k, v in raw.items()
    }
    batch = pre(raw)
    batch["episode_index"] = torch.arange(batch_size, device=batch["action"].device) % meta.total_episodes
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())

    def step() -> None:
        policy.train()
        loss, _ = policy.forward(dict(batch))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def act(policy: PreTrainedPolicy, meta: LeRobotDatasetMetadata) -> Callable[[], None]:
    """A chunk of actions of one environment, planning included."""
    pre, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    batch = pre(invented_batch(plain_config(policy), windows=False))
    observed = {k: v for k, v in batch.items() if k.startswith("observation") or k == "task"}
    observed = {k: v[:1] for k, v in observed.items()}
    steps = plain_config(policy).n_action_steps

    def chunk() -> None:
        policy.eval()
        policy.reset()
        for _ in range(steps):
            policy.select_action(dict(observed))

    return chunk


def plain_config(policy: PreTrainedPolicy) -> PreTrainedConfig:
    plain = copy.deepcopy(getattr(policy.config, "backbone", policy.config))
    plain.input_features, plain.output_features = policy.config.input_features, policy.config.output_features
    return plain


def race(runners: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    """Median seconds of each, in turn."""
    times: dict[str, list[float]] = {name: [] for name in runners}
    for runner in runners.values():
        runner()
    for _ in range(rounds):
        for name, runner in runners.items():
            begin = time.perf_counter()
            runner()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            times[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values)) for name, values in times.items()}


def compare(kind: str, options: dict[str, Any], cameras: bool, args: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as folder:
        meta = write_data(Path(folder) / "data", cameras)
        if kind == "smolvla":
            options = {**options, "vlm_model_name": str(write_tiny_vlm(Path(folder) / "vlm"))}
        policies = {method: make(kind, method, options, meta, args.device) for method in KINDS}
        training = race({n: train_step(p, meta, args.batch_size) for n, p in policies.items()}, args.rounds)
        acting = race({n: act(p, meta) for n, p in policies.items()}, args.rounds)
    for what, seconds in (("training step", training), ("chunk", acting)):
        plain = seconds.pop("plain")
        styled = ", ".join(f"{n} {1e3 * s:7.1f} ms ({s / plain:.3f})" for n, s in seconds.items())
        print(
            f"{kind:>9} {'two cameras' if cameras else 'numbers':>11}, {what:>13}: plain "
            f"{1e3 * plain:7.1f} ms, {styled}",
            flush=True,
        )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=40)
    parser.add_argument("--batch_size", type=int, default=32)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--full", action="store_true", help="LeRobot's default sizes of act and diffusion")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    for kind, options in (FULL if args.full else SMALL).items():
        if kind == "smolvla" and importlib.util.find_spec("transformers") is None:
            print(
                "  smolvla: left out, transformers is not installed (pip install 'lerobot_policy_swr[vla]')"
            )
            continue
        for cameras in (False, True):
            if kind == "smolvla" and not cameras:
                continue  # it needs a picture
            compare(kind, options, cameras, args)


if __name__ == "__main__":
    main(sys.argv[1:])
