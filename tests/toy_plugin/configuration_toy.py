"""Configuration of the policy ``toy``."""

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig


@PreTrainedConfig.register_subclass("toy")
@dataclass
class ToyConfig(PreTrainedConfig):
    """A linear chunk of the state, which has to be a vector of known length; the loss is a mean."""

    chunk_size: int = 4
    n_action_steps: int = 2
    # What of the state the network reads: "linear", "rounded" or "nothing".
    reads: str = "linear"
    drop_n_last_frames: int = 3
    optimizer_lr: float = 0.5
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {"STATE": NormalizationMode.MIN_MAX, "ACTION": NormalizationMode.MIN_MAX}
    )

    @property
    def observation_delta_indices(self) -> list:
        """Only the present, as a window of one."""
        return [0]

    @property
    def action_delta_indices(self) -> list:
        """The chunk."""
        return list(range(self.chunk_size))

    @property
    def reward_delta_indices(self) -> None:
        """None."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW with decay."""
        return AdamWConfig(lr=self.optimizer_lr, weight_decay=0.1, grad_clip_norm=3.0)

    def get_scheduler_preset(self) -> None:
        """None."""
        return None

    def validate_features(self) -> None:
        """Nothing."""
