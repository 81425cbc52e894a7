"""The baselines' networks: one transformer trunk, used as a GPT and as the encoder of an encoder-decoder.

Both predict something about noised actions from a window of observations and the noise level. Shapes: B
windows of T observations of O dimensions; K actions of A dimensions; width W.
"""

import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionSinusoidalPosEmb
from torch import Tensor, nn

INIT_SCALE = 0.02  # standard deviation of all initial weights, as in GPT-2 and in D3IL's agents


class Trunk(nn.Module):
    """A GPT's layers: pre-norm, GELU, feed-forward of four times the width, causal attention.

    Args:
        width: W.
        layers: Number of layers.
        heads: Number of attention heads.
        attention_dropout: Dropout of attention weights.
        residual_dropout: Dropout of what each block adds.
    """

    def __init__(
        self, width: int, layers: int, heads: int, attention_dropout: float, residual_dropout: float
    ):
        super().__init__()
        layer = nn.TransformerEncoderLayer(
            width, heads, 4 * width, residual_dropout, "gelu", batch_first=True, norm_first=True
        )
        self.layers = nn.TransformerEncoder(layer, layers, nn.LayerNorm(width), enable_nested_tensor=False)
        set_dropout(self.layers, attention_dropout)

    def forward(self, tokens: Tensor, is_pad: Tensor | None) -> Tensor:
        """(B, L, W) of tokens (B, L, W); those marked in `is_pad` (B, L) are seen by none."""
        return self.layers(tokens, mask=causal_mask(tokens), src_key_padding_mask=is_pad, is_causal=False)


class WindowGPT(nn.Module):
    """A causal transformer over (noise level, observation, action, observation, action, ...).

    An observation and the action taken in it share a learned place embedding; the first one of the episode,
    or of the window where that begins later, is at place 0.

    Args:
        observation_dim: O.
        action_dim: A.
        window: T, as many actions as observations.
        trunk: The transformer.
        width: W.
        level: Embeds noise levels, (B,) to (B, W).
    """

    def __init__(
        self, observation_dim: int, action_dim: int, window: int, trunk: Trunk, width: int, level: nn.Module
    ):
        super().__init__()
        self.observation = nn.Linear(observation_dim, width)
        self.action = nn.Linear(action_dim, width)
        self.places = nn.Parameter(torch.empty(window, width))
        self.level = level
        self.trunk = trunk
        self.head = nn.Linear(width, action_dim)
        initialize(self)

    def forward(
        self, observations: Tensor, actions: Tensor, level: Tensor, is_pad: Tensor | None = None
    ) -> Tensor:
        """One prediction per action, from what comes before it and itself.

        Args:
            observations: (B, T, O).
            actions: (B, T, A), noised.
            level: (B,) noise levels.
            is_pad: (B, T), steps before the episode's start; None for none.

        Returns:
            (B, T, A).
        """
        pairs = torch.stack([self.observation(observations), self.action(actions)], dim=2)  # (B, T, 2, W)
        tokens = (pairs + self.places[places_from_start(observations, is_pad)][:, :, None]).flatten(1, 2)
        tokens = torch.cat([self.level(level)[:, None], tokens], dim=1)  # (B, 1 + 2 T, W)
        if is_pad is not None:
            is_pad = nn.functional.pad(is_pad.repeat_interleave(2, dim=1), (1, 0))
        return self.head(self.trunk(tokens, is_pad)[:, 2::2])


class ChunkEncoderDecoder(nn.Module):
    """Encodes (noise level, observations); decodes a chunk of actions with cross-attention.

    The chunk's first action belongs to the last observation and shares its learned place embedding; the first
    observation of the episode, or of the window where that begins later, is at place 0.

    Args:
        observation_dim: O.
        action_dim: A.
        window: T.
        chunk: K.
        encoder: The transformer of observations, causal as in D3IL.
        decoder_layers: Layers of the decoder.
        width: W.
        heads: Attention heads of the decoder.
        attention_dropout: Dropout of the decoder's attention weights.
        residual_dropout: Dropout of what each of its blocks adds.
        level: Embeds noise levels, (B,) to (B, W).
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        window: int,
        chunk: int,
        encoder: Trunk,
        decoder_layers: int,
        width: int,
        heads: int,
        attention_dropout: float,
        residual_dropout: float,
        level: nn.Module,
    ):
        super().__init__()
        self.observation = nn.Linear(observation_dim, width)
        self.action = nn.Linear(action_dim, width)
        self.places = nn.Parameter(torch.empty(window - 1 + chunk, width))
        self.level = level
        self.encoder = encoder
        layer = nn.TransformerDecoderLayer(
            width, heads, 4 * width, residual_dropout, "gelu", batch_first=True, norm_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, decoder_layers, nn.LayerNorm(width))
        set_dropout(self.decoder, attention_dropout)
        self.head = nn.Linear(width, action_dim)
        initialize(self)

    def forward(
        self, observations: Tensor, actions: Tensor, level: Tensor, is_pad: Tensor | None = None
    ) -> Tensor:
        """One prediction per action of the chunk, from the observations and the actions up to it.

        Args:
            observations: (B, T, O).
            actions: (B, K, A), noised.
            level: (B,) noise levels.
            is_pad: (B, T), observations before the episode's start; None for none.

        Returns:
            (B, K, A).
        """
        places = places_from_start(observations, is_pad)
        tokens = self.observation(observations) + self.places[places]
        tokens = torch.cat([self.level(level)[:, None], tokens], dim=1)  # (B, 1 + T, W)
        if is_pad is not None:
            is_pad = nn.functional.pad(is_pad, (1, 0))
        memory = self.encoder(tokens, is_pad)
        chunk = torch.arange(actions.shape[1], device=actions.device)
        queries = self.action(actions) + self.places[places[:, -1:] + chunk]
        hidden = self.decoder(
            queries,
            memory,
            tgt_mask=causal_mask(queries),
            memory_key_padding_mask=is_pad,
            tgt_is_causal=False,
        )
        return self.head(hidden)


class StepEmbedding(nn.Sequential):
    """Embeds the number of a denoising step: sines, then a two-layer network with Mish.

    Args:
        width: W.
    """

    def __init__(self, width: int):
        super().__init__(
            DiffusionSinusoidalPosEmb(width),
            nn.Linear(width, 2 * width),
            nn.Mish(),
            nn.Linear(2 * width, width),
        )


class NoiseLevelEmbedding(nn.Module):
    """Embeds a noise level σ: a linear function of log(σ) / 4.

    Args:
        width: W.
    """

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(1, width)

    def forward(self, sigma: Tensor) -> Tensor:
        """(B, W) of (B,)."""
        return self.linear(sigma.log()[:, None] / 4)


def places_from_start(observations: Tensor, is_pad: Tensor | None) -> Tensor:
    """(B, T) or (1, T) places of observations (B, T, O): those marked in `is_pad` (B, T) do not count."""
    if is_pad is None:
        return torch.arange(observations.shape[1], device=observations.device)[None]
    return ((~is_pad).cumsum(dim=1) - 1).clamp(min=0)


def causal_mask(tokens: Tensor) -> Tensor:
    """(L, L), True where a token of (B, L, W) must not look: at those after it."""
    length = tokens.shape[1]
    return torch.ones(length, length, dtype=torch.bool, device=tokens.device).triu(1)


def set_dropout(layers: nn.Module, attention_dropout: float) -> None:
    """Give attention a dropout of its own, and take that inside feed-forward blocks away, as in GPT-2."""
    for module in layers.modules():
        if isinstance(module, nn.MultiheadAttention):
            module.dropout = attention_dropout
        elif isinstance(module, nn.TransformerEncoderLayer | nn.TransformerDecoderLayer):
            module.dropout.p = 0.0


def initialize(network: nn.Module) -> None:
    """Draw all weights and place embeddings from N(0, `INIT_SCALE`²); biases start at 0."""
    for name, parameter in network.named_parameters():
        if name.endswith("bias"):
            nn.init.zeros_(parameter)
        elif ".norm" not in name:
            nn.init.normal_(parameter, std=INIT_SCALE)
