"""Configuration of a policy with a backbone: what is the backbone's is asked of it."""

from dataclasses import dataclass, field
from typing import Any, ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.policies.backbones.own_traits import OwnTraits
from lerobot_swr.policies.backbones.policy_traits import PolicyTraits
from lerobot_swr.policies.backbones.registry import BackboneConfig
from lerobot_swr.policies.backbones.traits import Traits
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.policies.vector_pipelines import Pipelines
from lerobot_swr.run_context import DROP
from lerobot_swr.similarity import Manner


@dataclass
class BackedConfig(StateConfig):
    """What the configurations of ``bc``, ``zbc`` and ``wzbc`` have in common.

    Args of `StateConfig` apply (the paper's learning rate is constant); every other field is documented where
    it is defined.
    """

    # Tells style policies from those that can be their backbones.
    has_backbone: ClassVar[bool] = True
    # Whether the backbone is given styles.
    takes_style: ClassVar[bool] = False
    schedules: ClassVar[tuple[str | None, ...]] = (None, "cosine", "constant")

    # --- Backbone: what learns the actions ---
    # Its type (mlp, or any policy of LeRobot or of a plugin: act, diffusion, smolvla, ...) and, beside it,
    # the options of that type, e.g. --policy.backbone.hidden_dim=64 or --policy.backbone.chunk_size=16.
    backbone: BackboneConfig = field(default_factory=MLPConfig)

    # --- Training ---
    # "cosine" (to 0 at the run's last step, whatever --steps is) or "constant"; null takes the backbone's
    # own, which for mlp is "cosine". The options optimizer_... are mlp's; LeRobot's policies have their own.
    lr_schedule: str | None = None  # type: ignore[assignment]
    # Weight frames so that every episode counts the same, as the paper's sampling does (LeRobot draws frames
    # uniformly, which favours long episodes).
    balance_episodes: bool = True
    # Leave out the frames in which a demonstrator pauses before moving on. A policy without memory cannot
    # wait: it would learn to creep there. Deviates from the paper where demonstrations have pauses.
    skip_pauses: bool = True

    # --- Things in the observation ---
    # Feature to the names of its dimensions, in which hand and objects are found (box.x, box.y, box.qw, ...);
    # null takes the dataset's own names, and is replaced by them where an option looks for things.
    dimension_names: dict[str, list[str]] | None = None

    # --- Set from the dataset; not meant to be given ---
    # Number of episodes of the training dataset.
    num_episodes: int | None = None
    # Hash of the training dataset's states; tells resuming from fine-tuning on other data.
    dataset_fingerprint: str | None = None

    # --- Options of version 0.1, refused: they are the backbone's now ---
    hidden_dim: int | None = None
    num_hidden: int | None = None
    residual: bool | None = None

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        self._refuse_moved_options()
        super().__post_init__()
        self.traits.settle(self)

    def _refuse_moved_options(self) -> None:
        moved = {key: getattr(self, key) for key in ("hidden_dim", "num_hidden", "residual")}
        given = {key: value for key, value in moved.items() if value is not None}
        if self.num_episodes is not None and len(given) == len(moved):
            raise ValueError(
                f"this {self.type} checkpoint was made by version 0.1, which this version does not read: "
                "train the policy anew, or use it with lerobot_policy_swr 0.1"
            )
        if given:
            now = " ".join(f"--policy.backbone.{key}={str(value).lower()}" for key, value in given.items())
            raise ValueError(f"policy.{', policy.'.join(given)}: belongs to the backbone now; give {now}")

    # --- What the backbone says ---

    @property
    def traits(self) -> Traits:
        """What is to be known of the backbone."""
        backbone: Any = self.backbone
        return PolicyTraits(backbone) if isinstance(backbone, PreTrainedConfig) else OwnTraits(backbone)

    def __getattr__(self, name: str) -> Any:
        """What LeRobot asks of a policy's configuration where it has it (dtype, chunk_size, rtc_config, ...).

        Raises:
            AttributeError: If the backbone's does not have it, either.
        """
        backbone = self.__dict__.get("backbone")
        if name.startswith("__") or not isinstance(backbone, PreTrainedConfig):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(backbone, name)

    def __setattr__(self, name: str, value: Any) -> None:
        """What LeRobot tells a policy's configuration, and what is the backbone's option, is told to it."""
        backbone = self.__dict__.get("backbone")
        is_own = name in self.__dataclass_fields__ or hasattr(type(self), name)
        if not is_own and isinstance(backbone, PreTrainedConfig) and hasattr(backbone, name):
            setattr(backbone, name, value)
        else:
            super().__setattr__(name, value)

    @property
    def sees_images(self) -> bool:
        """Whether the backbone looks at pictures."""
        return self.traits.sees_images

    @property
    def unseen_frames(self) -> int:
        """How many frames at the end of every episode LeRobot's sampler leaves out."""
        return int(getattr(self, DROP, 0) or 0)

    @property
    def observation_delta_indices(self) -> list[int] | None:
        """Steps of the observations in a batch, as the backbone wants them."""
        return self.traits.observation_delta_indices

    @property
    def action_delta_indices(self) -> list[int] | None:
        """Steps of the actions in a batch, as the backbone wants them."""
        return self.traits.action_delta_indices

    @property
    def reward_delta_indices(self) -> Any:
        """Steps of the rewards in a batch, as the backbone wants them."""
        return self.traits.reward_delta_indices

    def get_optimizer_preset(self) -> OptimizerConfig:
        """The backbone's optimizer."""
        return self.traits.optimizer(self)

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """The learning rate's schedule: the backbone's, or what `lr_schedule` says."""
        return self.traits.scheduler(self) if self.lr_schedule is None else super().get_scheduler_preset()

    def make_pipelines(self, stats: Statistics | None, meta: Any | None) -> Pipelines:
        """The backbone's pre- and post-processing."""
        return self.traits.processors(self, stats, meta)

    @property
    def compared_keys(self) -> list[str]:
        """The features over which ν compares demonstrations; pictures are none."""
        return self.observation_keys

    @property
    def recorded_keys(self) -> list[str]:
        """The features of numbers that are read of demonstrations: inputs, action, and what ν compares."""
        return list(dict.fromkeys([*self.dimensions, *self.compared_keys]))

    @property
    def manner(self) -> Manner:
        """What of demonstrations ν compares."""
        return Manner(tuple(self.compared_keys))

    @property
    def looks_for_things(self) -> bool:
        """Whether an option needs the names of the observation's dimensions."""
        return bool(getattr(self.backbone, "looks_for_things", False))
