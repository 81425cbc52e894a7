"""Configurations of the policies ``ddpm_gpt``, ``ddpm_act`` and ``beso``.

Defaults are those of the D3IL benchmark's agents (Jia et al., ICLR 2024), with which the paper compares;
`docs/baselines.md` lists them with their sources and where we deviate.
"""

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.policies.state_config import StateConfig


@dataclass
class WindowDiffusionConfig(StateConfig):
    """Denoises actions with a transformer that sees a window of observations.

    Args of `StateConfig` apply; every other field is documented where it is defined.
    """

    # Fields that count something, of which there must be one at least.
    counts: ClassVar[tuple[str, ...]] = ("n_obs_steps", "dim_model", "n_heads", "denoising_steps")

    # --- Window ---
    # Observations that the policy sees: the current one and those before it.
    n_obs_steps: int = 5

    # --- Network ---
    # Width of the transformer.
    dim_model: int = 72
    # Attention heads.
    n_heads: int = 4
    # Dropout of attention weights.
    attention_dropout: float = 0.2
    # Dropout of what each attention and feed-forward block adds.
    residual_dropout: float = 0.1

    # --- Diffusion ---
    # Denoising steps.
    denoising_steps: int = 8

    # --- Training ---
    optimizer_lr: float = 5e-4
    # The benchmark does not clip gradients.
    optimizer_grad_clip_norm: float = 0.0
    lr_schedule: str = "constant"
    # Decay of the moving average of the weights, which is what acts.
    ema_decay: float = 0.995

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        super().__post_init__()
        self.check_at_least_one(*self.counts)
        if self.dim_model % self.n_heads or self.dim_model % 2:
            raise ValueError(
                f"dim_model={self.dim_model}: expected an even multiple of n_heads={self.n_heads}"
            )
        for key in ("attention_dropout", "residual_dropout", "ema_decay"):
            if not 0 <= getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected a number from 0 to below 1")

    @property
    def observation_delta_indices(self) -> list[int]:
        """The window of observations, up to the current one."""
        return list(range(1 - self.n_obs_steps, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """The action of every observation in the window."""
        return self.observation_delta_indices


@PreTrainedConfig.register_subclass("ddpm_gpt")
@dataclass
class DdpmGptConfig(WindowDiffusionConfig):
    """DDPM-GPT: a causal transformer denoises the actions of the whole window (Pearce et al., ICLR 2023)."""

    counts: ClassVar[tuple[str, ...]] = (*WindowDiffusionConfig.counts, "n_layers")

    # Number of transformer layers.
    n_layers: int = 4


@PreTrainedConfig.register_subclass("ddpm_act")
@dataclass
class DdpmActConfig(WindowDiffusionConfig):
    """DDPM-ACT: an encoder-decoder denoises a chunk of actions, which is executed (Chi et al., RSS 2023)."""

    counts: ClassVar[tuple[str, ...]] = (
        *WindowDiffusionConfig.counts,
        *("chunk_size", "n_encoder_layers", "n_decoder_layers"),
    )

    dim_model: int = 64
    attention_dropout: float = 0.1
    denoising_steps: int = 16
    # Actions predicted and executed at once.
    chunk_size: int = 4
    # Layers of the encoder of observations.
    n_encoder_layers: int = 2
    # Layers of the decoder of actions.
    n_decoder_layers: int = 4

    @property
    def action_delta_indices(self) -> list[int]:
        """The chunk, from the current action on."""
        return list(range(self.chunk_size))


@PreTrainedConfig.register_subclass("beso")
@dataclass
class BesoConfig(DdpmGptConfig):
    """BESO: a causal transformer as a score model of continuous noise levels (Reuss et al., RSS 2023)."""

    ema_decay: float = 0.999
    # Standard deviation of the data that the preconditioning assumes.
    sigma_data: float = 0.5
    # Least and largest noise level. Denoising starts at the largest.
    sigma_min: float = 0.1
    sigma_max: float = 1.0

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        super().__post_init__()
        if not self.sigma_data > 0:
            raise ValueError(f"sigma_data={self.sigma_data}: expected a number > 0")
        least = 1e-3 * self.sigma_data  # the scheduler's single precision ends there
        if not least <= self.sigma_min < self.sigma_max:
            raise ValueError(
                f"sigma_min={self.sigma_min}: expected a number >= {least:g} (a thousandth of "
                f"sigma_data) and < sigma_max={self.sigma_max}"
            )
