"""The backbone ``mlp``: a deterministic policy of the current observation, fitted by squared error."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_swr.policies.backbones.backbone import Backbone, squared_errors, weighted_mean
from lerobot_swr.policies.backbones.objects import FITTED, Normalize, ObjectActions, ObjectEncoder


class ObservationEncoder(nn.Module):
    """Low-dimensional observations side by side.

    Args:
        keys: Names of the observations, in order.
    """

    def __init__(self, keys: Sequence[str]):
        super().__init__()
        self.keys = tuple(keys)

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, d) features of a batch of observations (B, d_k)."""
        return torch.cat([batch[key] for key in self.keys], dim=-1)


class Trunk(nn.Module):
    """A deep ReLU network on features and, for style policies, a style.

    Args:
        in_dim: Dimension of features and style together.
        hidden_dim: Width of every hidden layer.
        num_hidden: Number of hidden layers.
        residual: Add each hidden layer's input to its output (from the second layer on).
    """

    def __init__(self, in_dim: int, hidden_dim: int, num_hidden: int, residual: bool):
        super().__init__()
        dims = [in_dim] + [hidden_dim] * num_hidden
        self.layers = nn.ModuleList(nn.Linear(before, after) for before, after in pairwise(dims))
        self.residual = residual

    def forward(self, features: Tensor) -> Tensor:
        """(B, hidden_dim) of (B, in_dim)."""
        first, *others = self.layers
        hidden = torch.relu(first(features))
        for layer in others:
            update = torch.relu(layer(hidden))
            hidden = hidden + update if self.residual else update
        return hidden


class MLPBackbone(Backbone):
    """π_θ(a | s, z) as the mean of a Gaussian of fixed variance, i.e. a deterministic policy.

    Args:
        observations: Names of the observations to their dimensions, in order.
        style_dim: Dimension of z; 0 for a policy without styles.
        action_dim: A.
        hidden_dim: Width of every hidden layer.
        num_hidden: Number of hidden layers.
        residual: Whether hidden layers are residual.
        encoder: What features the network sees of observations; by default these side by side.
        actions: What makes normalised actions of its outputs; by default these are the actions.
    """

    def __init__(
        self,
        observations: Mapping[str, int],
        style_dim: int,
        action_dim: int,
        hidden_dim: int,
        num_hidden: int,
        residual: bool,
        encoder: ObjectEncoder | None = None,
        actions: ObjectActions | None = None,
    ):
        super().__init__()
        self.encoder = ObservationEncoder(list(observations)) if encoder is None else encoder
        self.actions = actions
        features = sum(observations.values()) if encoder is None else encoder.dim
        self.trunk = Trunk(features + style_dim, hidden_dim, num_hidden, residual)
        self.head = nn.Linear(hidden_dim, action_dim)

    def forward(self, batch: dict[str, Tensor], style: Tensor | None = None) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d_k) and styles (B, style_dim)."""
        features = self.encoder(batch)
        if style is not None:
            features = torch.cat([features, style], dim=-1)
        outputs = self.head(self.trunk(features))
        if self.actions is None or not isinstance(self.encoder, ObjectEncoder):
            return outputs
        scene = self.encoder.scene
        return self.actions(outputs, scene, scene.raw(batch))

    def fit(self, columns: Mapping[str, np.ndarray], normalize: Normalize) -> None:
        """Let what looks at things know the dataset's units; see `Backbone.fit`."""
        if self.actions is None or not isinstance(self.encoder, ObjectEncoder):
            return
        scene, count = self.encoder.scene, len(columns[ACTION])
        rows = np.random.default_rng(0).permutation(count)[:FITTED]
        frames = {key: torch.from_numpy(columns[key][rows]).float() for key in (*scene.keys, ACTION)}
        scene.fit(normalize)
        self.encoder.fit(frames)
        self.actions.fit(scene, frames, frames[ACTION], normalize)

    @property
    def units(self) -> dict[str, Tensor]:
        """How observations and actions are normalised, see `Backbone.units`."""
        names = ("actions.gain", "actions.shift")
        own = dict(self.named_buffers())
        return {name: value for name, value in own.items() if name in names or ".scene." in name}

    def loss(self, batch: dict[str, Tensor], style: Tensor | None, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Weighted squared error of the action, see `Backbone.loss`."""
        return weighted_mean(squared_errors(self(batch, style), batch), weight)

    def predict_action_chunk(self, batch: dict[str, Tensor], style: Tensor | None) -> Tensor:
        """(B, 1, A): one action at a time."""
        return self(batch, style).unsqueeze(1)
