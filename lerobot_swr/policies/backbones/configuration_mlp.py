"""Configuration of the backbone ``mlp``."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from lerobot.utils.constants import ACTION

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.object_poses import Names
from lerobot_swr.policies.backbones.modeling_mlp import MLPBackbone
from lerobot_swr.policies.backbones.objects import ObjectActions, ObjectEncoder, Scene, most_moved
from lerobot_swr.policies.backbones.registry import BackboneConfig

logger = logging.getLogger(__name__)


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
    # What the network sees: "plain", the observations as they are, or "objects", hand and objects as seen
    # from each other too, with actions in an object's frame; things are found by the names of dimensions.
    encoder: str = "plain"
    # With encoder=objects: the object from which hand and actions are seen; null takes the one that moves
    # most in the demonstrations.
    frame: str | None = None
    # With encoder=objects: see positions at several scales, and small offsets enlarged.
    multiscale: bool = True

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        for key in ("hidden_dim", "num_hidden"):
            if getattr(self, key) < 1:
                raise ValueError(f"backbone.{key}={getattr(self, key)}: expected at least 1")
        if self.encoder not in ("plain", "objects"):
            raise ValueError(f"backbone.encoder={self.encoder!r}: expected 'plain' or 'objects'")
        if self.frame is not None and not self.looks_for_things:
            raise ValueError(f"backbone.frame={self.frame!r}: needs backbone.encoder=objects")

    @property
    def looks_for_things(self) -> bool:
        """Whether hand and objects are to be found."""
        return self.encoder == "objects"

    def adopt(self, columns: Mapping[str, np.ndarray], lengths: np.ndarray, names: Names) -> None:
        """Choose the object from which hand and actions are seen.

        Raises:
            ValueError: If there is none, or no hand.
        """
        if self.looks_for_things and self.frame is None:
            self.frame = most_moved(columns, lengths, names)
            logger.info("Hand and actions are seen from %r, which moves most.", self.frame)

    def make_named(
        self, observations: Mapping[str, int], style_dim: int, action_dim: int, names: Names
    ) -> MLPBackbone:
        """A new network that may see hand and objects."""
        if not self.looks_for_things:
            return self.make(observations, style_dim, action_dim)
        if self.frame is None:
            raise ValueError(
                "backbone.encoder='objects': only a policy that is created to train can begin to"
            )
        scene = Scene(observations, names, self.frame)
        encoder = ObjectEncoder(observations, scene, self.multiscale)
        actions = ObjectActions(names[ACTION])
        shape = (self.hidden_dim, self.num_hidden, self.residual)
        return MLPBackbone(observations, style_dim, action_dim, *shape, encoder, actions)

    def make(self, observations: Mapping[str, int], style_dim: int, action_dim: int) -> MLPBackbone:
        """A new network."""
        return MLPBackbone(
            observations, style_dim, action_dim, self.hidden_dim, self.num_hidden, self.residual
        )
