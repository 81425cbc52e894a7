"""What a style policy takes over from this package's own backbones."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from lerobot.optim import LRSchedulerConfig, OptimizerConfig

from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.backbones.backbone import Backbone
from lerobot_swr.policies.backbones.registry import BackboneConfig
from lerobot_swr.policies.backbones.traits import Traits
from lerobot_swr.policies.optimizer_swr import FusedAdamConfig
from lerobot_swr.policies.vector_pipelines import Pipelines, vector_pipelines

if TYPE_CHECKING:
    from lerobot_swr.policies.configuration_swr import BCConfig

STYLE_LR_SCALE = 5.0  # in units of the network's rate: a style learns from its own episode alone


class OwnTraits(Traits):
    """Of this package's own backbones: the present numbers side by side, fused Adam."""

    def __init__(self, backbone: BackboneConfig):
        self._backbone = backbone
        self.is_stackable = backbone.is_stackable

    def settle(self, config: "BCConfig") -> None:
        """Nothing."""

    def adopt(self, config: "BCConfig", columns: Mapping[str, np.ndarray], lengths: np.ndarray) -> None:
        """What the backbone's own options ask for."""
        self._backbone.adopt(columns, lengths, config.dimension_names or {})

    def style_lr(self, config: "BCConfig") -> float:
        """In units of the network's."""
        scale = getattr(config, "style_lr_scale", None)
        return config.optimizer_lr * (STYLE_LR_SCALE if scale is None else scale)

    def optimizer(self, config: "BCConfig") -> OptimizerConfig:
        """Fused Adam."""
        return FusedAdamConfig(
            lr=config.optimizer_lr,
            betas=config.optimizer_betas,
            weight_decay=config.optimizer_weight_decay,
            grad_clip_norm=config.optimizer_grad_clip_norm,
        )

    def scheduler(self, config: "BCConfig") -> LRSchedulerConfig | None:
        """To 0 at the run's last step."""
        return config.cosine_schedule()

    def processors(self, config: "BCConfig", stats: Statistics | None, meta: Any | None) -> Pipelines:
        """LeRobot's default pipelines, on vectors."""
        return vector_pipelines(config, config.dimensions, stats)

    def make(
        self, config: "BCConfig", style_dim: int, stats: Statistics | None, meta: Any | None
    ) -> Backbone:
        """Of the dimensions of the low-dimensional observations."""
        observations = {key: config.dimensions[key] for key in config.observation_keys}
        names = config.dimension_names or {}
        return self._backbone.make_named(observations, style_dim, config.action_dim, names)
