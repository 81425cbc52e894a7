"""Other policies of the comparison, with networks and batches that a CPU trains."""

import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import lerobot.policies  # noqa: F401  (registers act and diffusion)
from lerobot.configs import PreTrainedConfig

from lerobot_swr.reproduction.training import STACKED


@dataclass(frozen=True)
class Baseline:
    """A policy that LeRobot's own loop trains one seed after the other.

    Attributes:
        options: What differs from its defaults: networks that a CPU trains, as in ``configs/``.
        batch_size: Frames per step.
        steps: Name of the setting that holds its steps.
        slowness: Time of a seed's step in steps of a stacked seed, roughly; it orders the trainings.
        extra: What installs ``diffusers``, without which it cannot be trained; None does not need it.
    """

    options: Mapping[str, Any]
    batch_size: int
    steps: str = "baseline_steps"
    slowness: int = 60
    extra: str | None = "lerobot_policy_swr[baselines]"


# What lets the diffusion policies of D3IL learn in minutes on a CPU, see docs/baselines.md.
FAST = {
    "lr_schedule": "cosine",
    "optimizer_lr": 2e-3,
    "attention_dropout": 0.0,
    "residual_dropout": 0.0,
}

BASELINES = {
    "act": Baseline(
        {
            "chunk_size": 16,
            "n_action_steps": 8,
            "dim_model": 64,
            "n_heads": 4,
            "dim_feedforward": 128,
            "n_encoder_layers": 2,
            "n_decoder_layers": 1,
            "n_vae_encoder_layers": 2,
            "latent_dim": 8,
            "optimizer_lr": 3e-4,
        },
        batch_size=32,
        steps="act_steps",
        slowness=15,
        extra=None,
    ),
    "diffusion": Baseline(
        {
            "n_obs_steps": 2,
            "horizon": 16,
            "n_action_steps": 8,
            "down_dims": [32, 64],
            "diffusion_step_embed_dim": 32,
            "n_groups": 4,
            "num_train_timesteps": 50,
            "num_inference_steps": 10,
            "noise_scheduler_type": "DDIM",
            "optimizer_lr": 5e-4,
        },
        batch_size=64,
        steps="diffusion_steps",
        extra="lerobot[diffusion]",
    ),
    "beso": Baseline(FAST, batch_size=64),
    "ddpm_gpt": Baseline(FAST, batch_size=64),
    "ddpm_act": Baseline({**FAST, "optimizer_lr": 1e-3}, batch_size=64),
}


def known_policies() -> tuple[str, ...]:
    """Policies that this installation can train."""
    missing = missing_extras()
    return tuple(name for name in (*STACKED, *BASELINES) if _is_registered(name) and name not in missing)


def missing_extras() -> dict[str, str]:
    """Policies that cannot be trained for want of an optional package, and what to install."""
    if importlib.util.find_spec("diffusers") is not None:
        return {}
    return {name: b.extra for name, b in BASELINES.items() if b.extra is not None and _is_registered(name)}


def _is_registered(policy: str) -> bool:
    return policy in PreTrainedConfig.get_known_choices()
