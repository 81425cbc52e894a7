"""The policies ``ddpm_gpt``, ``ddpm_act`` and ``beso``."""

from collections import deque

import torch
from torch import Tensor, nn

from lerobot_swr.policies.baselines.configuration_baselines import BesoConfig, DdpmActConfig, DdpmGptConfig
from lerobot_swr.policies.baselines.diffusion import Ddpm, Karras
from lerobot_swr.policies.baselines.transformers import (
    ChunkEncoderDecoder,
    NoiseLevelEmbedding,
    StepEmbedding,
    Trunk,
    WindowGPT,
)
from lerobot_swr.policies.baselines.window_diffusion import WindowDiffusionPolicy


class DdpmGptPolicy(WindowDiffusionPolicy):
    """DDPM-GPT: denoises the actions of the whole window and executes the last one."""

    config_class = DdpmGptConfig
    name = "ddpm_gpt"
    config: DdpmGptConfig

    def _make_network(self) -> WindowGPT:
        return _window_gpt(self.config, StepEmbedding(self.config.dim_model))

    def _make_process(self) -> Ddpm:
        return Ddpm(self.config.denoising_steps)

    @property
    def _n_actions(self) -> int:
        return self.config.n_obs_steps

    def _executed(self, actions: Tensor) -> Tensor:
        return actions[:, -1:]


class DdpmActPolicy(WindowDiffusionPolicy):
    """DDPM-ACT: denoises a chunk of actions with an encoder-decoder and executes all of it."""

    config_class = DdpmActConfig
    name = "ddpm_act"
    config: DdpmActConfig

    def _make_network(self) -> ChunkEncoderDecoder:
        config = self.config
        encoder = Trunk(
            config.dim_model,
            config.n_encoder_layers,
            config.n_heads,
            config.attention_dropout,
            config.residual_dropout,
        )
        return ChunkEncoderDecoder(
            config.observation_dim,
            config.action_dim,
            config.n_obs_steps,
            config.chunk_size,
            encoder,
            config.n_decoder_layers,
            config.dim_model,
            config.n_heads,
            config.attention_dropout,
            config.residual_dropout,
            StepEmbedding(config.dim_model),
        )

    def _make_process(self) -> Ddpm:
        return Ddpm(self.config.denoising_steps)

    @property
    def _n_actions(self) -> int:
        return self.config.chunk_size


class BesoPolicy(WindowDiffusionPolicy):
    """BESO: DDPM-GPT's network as a score model of continuous noise levels.

    At inference the window's earlier actions start from those that were executed, without noise, and are
    denoised along, as in D3IL's agent.
    """

    config_class = BesoConfig
    name = "beso"
    config: BesoConfig

    def _make_network(self) -> WindowGPT:
        return _window_gpt(self.config, NoiseLevelEmbedding(self.config.dim_model))

    def _make_process(self) -> Karras:
        config = self.config
        return Karras(config.denoising_steps, config.sigma_data, config.sigma_min, config.sigma_max)

    @property
    def _n_actions(self) -> int:
        return self.config.n_obs_steps

    def reset(self) -> None:
        """Start a rollout."""
        super().reset()
        self._past: deque[Tensor] = deque(maxlen=self.config.n_obs_steps - 1)

    def _start(self, noise: Tensor) -> Tensor:
        if self._past:
            noise[:, -1 - len(self._past) : -1] = torch.stack(list(self._past), dim=1)
        return noise

    def _executed(self, actions: Tensor) -> Tensor:
        self._past.append(actions[:, -1])
        return actions[:, -1:]


def _window_gpt(config: DdpmGptConfig, level_embedding: nn.Module) -> WindowGPT:
    """The network that denoises the actions of a whole window."""
    trunk = Trunk(
        config.dim_model,
        config.n_layers,
        config.n_heads,
        config.attention_dropout,
        config.residual_dropout,
    )
    return WindowGPT(
        config.observation_dim,
        config.action_dim,
        config.n_obs_steps,
        trunk,
        config.dim_model,
        level_embedding,
    )
