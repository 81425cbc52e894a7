"""What the configurations of this package's policies share: low-dimensional observations, fused Adam."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import FeatureType, NormalizationMode, PreTrainedConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.optim.schedulers import CosineAnnealingWithWarmupSchedulerConfig
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_swr.configuration import check_dataset_folder, tells_bad_values
from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.optimizer_swr import FusedAdamConfig
from lerobot_swr.policies.vector_pipelines import Pipelines, vector_pipelines


@dataclass
class StateConfig(PreTrainedConfig):
    """A policy of low-dimensional observations; every field is documented where it is defined."""

    # Values of lr_schedule.
    schedules: ClassVar[tuple[str | None, ...]] = ("cosine", "constant")

    # --- Training ---
    # Adam's learning rate.
    optimizer_lr: float = 1e-3
    optimizer_betas: tuple[float, float] = (0.9, 0.999)
    optimizer_weight_decay: float = 0.0
    # Largest norm of the gradient; 0 does not clip.
    optimizer_grad_clip_norm: float = 0.0
    # "cosine" (to 0 at the run's last step, whatever --steps is) or "constant".
    lr_schedule: str = "cosine"
    # Treat numbers below 1e-38 as 0 in this process; they make the CPU several times slower.
    flush_denormal: bool = True

    # --- Normalization ---
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "STATE": NormalizationMode.MEAN_STD,
            "ENV": NormalizationMode.MEAN_STD,
            "ACTION": NormalizationMode.MEAN_STD,
        }
    )

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        super().__post_init__()
        check_dataset_folder()
        if not self.optimizer_lr > 0:
            raise ValueError(f"optimizer_lr={self.optimizer_lr}: expected a number > 0")
        if self.lr_schedule not in self.schedules:
            raise ValueError(f"lr_schedule={self.lr_schedule!r}: expected 'cosine' or 'constant'")

    def check_at_least_one(self, *keys: str) -> None:
        """Refuse numbers below 1.

        Raises:
            ValueError: Naming the first offending key and its value.
        """
        for key in keys:
            if getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected at least 1")

    @property
    def sees_images(self) -> bool:
        """Whether the policy looks at pictures; else they are left out of its features."""
        return False

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Only the current observation is used."""
        return None

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Only the current action is predicted."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """Rewards are not used."""
        return None

    @property
    def observation_keys(self) -> list[str]:
        """Names of the low-dimensional observations, in the order in which the network sees them."""
        inputs = self.input_features or {}
        return [key for key, ft in inputs.items() if ft.type in (FeatureType.STATE, FeatureType.ENV)]

    @property
    def dimensions(self) -> dict[str, int]:
        """Low-dimensional observations and action to how many numbers they are; a grid counts as a vector."""
        features = {**(self.input_features or {}), **(self.output_features or {})}
        keys = [*self.observation_keys, ACTION] if ACTION in features else self.observation_keys
        return {key: math.prod(features[key].shape) for key in keys}

    @property
    def observation_dim(self) -> int:
        """Dimensions of the observations together."""
        dimensions = self.dimensions
        return sum(dimensions[key] for key in self.observation_keys)

    @property
    def action_dim(self) -> int:
        """Dimension of the action."""
        return self.dimensions[ACTION]

    def get_optimizer_preset(self) -> OptimizerConfig:
        """Fused Adam."""
        return FusedAdamConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            weight_decay=self.optimizer_weight_decay,
            grad_clip_norm=self.optimizer_grad_clip_norm,
        )

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """The learning rate's schedule; it ends with the run."""
        return None if self.lr_schedule == "constant" else self.cosine_schedule()

    @staticmethod
    def cosine_schedule() -> LRSchedulerConfig:
        """To 0 at the run's last step, whatever ``--steps`` is."""
        return CosineAnnealingWithWarmupSchedulerConfig(num_warmup_steps=0)

    def make_pipelines(self, stats: Statistics | None, meta: Any | None) -> Pipelines:
        """The policy's pre- and post-processing.

        Args:
            stats: The dataset's statistics.
            meta: The dataset's metadata.
        """
        return vector_pipelines(self, self.dimensions, stats)

    def validate_features(self) -> None:
        """Check that the dataset has what the policy needs.

        Raises:
            ValueError: If it has no ``observation.state`` or no ``action``.
        """
        if self.robot_state_feature is None:
            raise ValueError(
                f"policy {self.type!r} needs the feature {OBS_STATE!r}; its inputs are: "
                f"{', '.join(self.input_features or {}) or 'none'}"
            )
        if self.action_feature is None:
            raise ValueError(f"policy {self.type!r} needs the feature {ACTION!r}; its outputs lack it")
