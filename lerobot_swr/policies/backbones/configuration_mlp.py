"""Configuration of the backbone ``mlp``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.policies.backbones.modeling_mlp import MLPBackbone
from lerobot_swr.policies.backbones.registry import BackboneConfig


@BackboneConfig.register_subclass("mlp")
@dataclass
class MLPConfig(BackboneConfig):
    """A deep ReLU network on the current observation and the style."""

    is_stackable: ClassVar[bool] = True

    # Width of the hidden layers.
    hidden_dim: int = 128
    # Number of hidden layers.
    num_hidden: int = 10
    # Add each hidden layer's input to its output. Deviates from the paper's plain network, which trains
    # unreliably at this depth.
    residual: bool = True

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        for key in ("hidden_dim", "num_hidden"):
            if getattr(self, key) < 1:
                raise ValueError(f"backbone.{key}={getattr(self, key)}: expected at least 1")

    def make(self, observations: Mapping[str, int], style_dim: int, action_dim: int) -> MLPBackbone:
        """A new network."""
        return MLPBackbone(
            observations, style_dim, action_dim, self.hidden_dim, self.num_hidden, self.residual
        )
