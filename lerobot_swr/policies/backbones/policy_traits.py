"""What a style policy takes over from a LeRobot policy that is its backbone."""

import copy
import logging
from functools import partial
from typing import TYPE_CHECKING, Any

from lerobot.configs import PreTrainedConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.policies import make_pre_post_processors
from lerobot.processor import RenameObservationsProcessorStep

from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.backbones.backbone import Backbone
from lerobot_swr.policies.backbones.plain_checkpoint import adopt_options, load_plain_weights
from lerobot_swr.policies.backbones.style_place import AUTO, check_takes_style, make_with_style
from lerobot_swr.policies.backbones.style_probe import invented_batch
from lerobot_swr.policies.backbones.traits import Traits
from lerobot_swr.policies.backbones.wrapped_policy import WrappedPolicy, make_policy_of, make_styled_policy_of
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.policies.vector_pipelines import FloatVectorsProcessorStep, Pipelines, prepared_statistics
from lerobot_swr.run_context import given_below

if TYPE_CHECKING:
    from lerobot_swr.policies.configuration_swr import BCConfig

STYLE_LR = 5e-3  # presets of networks range from 1e-5 to 1e-3; styles move at none of these
OF_THE_NETWORK = (  # options of a style policy that this package's own backbones read
    *("optimizer_lr", "optimizer_betas", "optimizer_weight_decay", "optimizer_grad_clip_norm"),
    "normalization_mapping",
)

logger = logging.getLogger(__name__)


class PolicyTraits(Traits):
    """Of any policy that LeRobot knows, by its contracts alone: each answer is the policy's own.

    Args:
        backbone: The policy's configuration, which has no features.
    """

    sees_images = True
    is_momentary = False

    def __init__(self, backbone: PreTrainedConfig):
        self.backbone = backbone
        self.observation_delta_indices = backbone.observation_delta_indices
        self.action_delta_indices = backbone.action_delta_indices
        self.reward_delta_indices = backbone.reward_delta_indices

    def settle(self, config: "BCConfig") -> None:
        """See `Traits.settle`."""
        backbone, where = self.backbone, f"policy.backbone.type={self.backbone.type!r}"
        if config.num_episodes is None and backbone.pretrained_path is not None:
            adopt_options(backbone, given_below("policy.backbone"))
        if config.num_episodes is not None and "pretrained_path" in given_below(
            "policy.backbone", files=False
        ):
            raise ValueError(
                f"policy.backbone.pretrained_path={str(backbone.pretrained_path)!r}: the weights come from "
                "the checkpoint at policy.path; give one of the two"
            )
        self._refuse_foreign_options(config)
        if getattr(config, "corrective", "none") != "none":
            raise ValueError(
                f"policy.corrective={config.corrective!r}, {where}: corrective labels teach one "
                "action for one observation; leave the flag out, or use --policy.backbone.type=mlp"
            )
        if config.takes_style:
            check_takes_style(backbone)
            if getattr(backbone, "prediction_type", None) == "epsilon":
                logger.warning(
                    "%s predicts the noise (prediction_type=epsilon), which tells little of the style: give "
                    "--policy.backbone.prediction_type=sample (docs/backbones.md)",
                    where,
                )
        backbone.device, backbone.use_amp = config.device, config.use_amp
        config.n_obs_steps = backbone.n_obs_steps
        config.normalization_mapping = backbone.normalization_mapping

    def _refuse_foreign_options(self, config: "BCConfig") -> None:
        """Refuse options that would have no effect."""
        unset = StateConfig.__dataclass_fields__
        for key in OF_THE_NETWORK:
            field, value = unset[key], getattr(config, key)
            default = field.default_factory() if callable(field.default_factory) else field.default
            told = getattr(self.backbone, key, None)
            if key == "normalization_mapping" and config.num_episodes is not None:
                continue  # that of the backbone when the checkpoint was made
            if value not in (default, told):
                raise ValueError(
                    f"policy.{key}={value}: belongs to the backbone {self.backbone.type!r}; give "
                    f"--policy.backbone.{key}, where it has that option"
                )
        scale = getattr(config, "style_lr_scale", None)
        if scale not in (None, 0):
            raise ValueError(
                f"policy.style_lr_scale={scale}: over the backbone {self.backbone.type!r} the styles' "
                f"learning rate is absolute; give --policy.style_lr (default {STYLE_LR:g})"
            )

    def style_lr(self, config: "BCConfig") -> float:
        """Absolute: the presets of networks differ by a factor of 100."""
        return STYLE_LR

    def optimizer(self, config: "BCConfig") -> OptimizerConfig:
        """The policy's preset."""
        return self.backbone.get_optimizer_preset()

    def scheduler(self, config: "BCConfig") -> LRSchedulerConfig | None:
        """The policy's preset."""
        return self.backbone.get_scheduler_preset()

    def plain(self, config: "BCConfig", meta: Any | None = None) -> PreTrainedConfig:
        """The policy's configuration as it would be without styles: with the dataset's features."""
        plain = copy.deepcopy(self.backbone)
        plain.input_features = dict(config.input_features or {})
        plain.output_features = dict(config.output_features or {})
        plain.pretrained_path = None
        plain._runtime_dataset_meta = meta  # type: ignore[attr-defined]  # as LeRobot's factory does
        return plain

    def processors(self, config: "BCConfig", stats: Statistics | None, meta: Any | None) -> Pipelines:
        """The policy's own, on vectors; constant dimensions are centred instead of being blown up."""
        plain, vectors = self.plain(config, meta), _vectors(config)
        prepared = prepared_statistics(vectors, stats)
        pre, post = make_pre_post_processors(plain, dataset_stats=prepared, dataset_meta=meta)
        steps = list(pre.steps)
        renames = [isinstance(step, RenameObservationsProcessorStep) for step in steps]
        steps.insert(renames.index(True) + 1 if True in renames else 0, FloatVectorsProcessorStep(vectors))
        pre.steps = steps
        return pre, post

    def make(
        self, config: "BCConfig", style_dim: int, stats: Statistics | None, meta: Any | None
    ) -> Backbone:
        """The policy, wrapped; on a new dataset with the weights of ``backbone.pretrained_path``."""
        plain, is_new = self.plain(config, meta), config.num_episodes is None
        more = {"dataset_stats": stats, "dataset_meta": meta}
        pre = self.processors(config, stats, meta)[0] if is_new and meta is not None else None
        place = None
        if style_dim == 0:
            policy = make_policy_of(plain, more)
        else:
            build = partial(make_styled_policy_of, more=more)
            place, policy = make_with_style(plain, build, getattr(config, "style_key", AUTO), style_dim, pre)
            config.style_key = place.name  # type: ignore[attr-defined]
        if pre is not None and self.backbone.pretrained_path is not None:
            batch = pre(invented_batch(plain, windows=True))
            load_plain_weights(policy, self.backbone, place, batch)
        return WrappedPolicy(policy, place)


def _vectors(config: "BCConfig") -> dict[str, int]:
    """The low-dimensional features that are vectors to their dimensions."""
    features = {**(config.input_features or {}), **(config.output_features or {})}
    return {key: d for key, d in config.dimensions.items() if len(features[key].shape) <= 1}
