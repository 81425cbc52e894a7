"""LeRobot's default pre- and post-processing, on vectors."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature, PreTrainedConfig
from lerobot.lerobot_types import EnvTransition, PolicyAction, TransitionKey
from lerobot.processor import (
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_swr.dataset_statistics import Statistics

Pipelines = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]


@ProcessorStepRegistry.register("float_vectors_processor")
@dataclass
class FloatVectorsProcessorStep(ProcessorStep):
    """Turns the policy's observations and actions into batches of vectors (B, d) of 32-bit floats.

    LeRobot hands a feature of shape (1,) over as (B,), a grid as (B, h, w), whole numbers and truth values as
    such; its normaliser would take on their type and round its statistics to it.

    Attributes:
        dimensions: Feature to d.
    """

    dimensions: dict[str, int] = field(default_factory=dict)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Convert one batch; windows of steps, (B, T, ...), become (B, T, d).

        Raises:
            ValueError: If an observation is missing, or a feature has another number of dimensions.
        """
        converted = transition.copy()
        more = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        observation = transition.get(TransitionKey.OBSERVATION)
        if observation is not None:
            keys = [key for key in self.dimensions if key != ACTION]
            missing = [key for key in keys if key not in observation]
            if missing:
                raise ValueError(
                    f"the policy looks at {', '.join(missing)}, which is not among the observations "
                    f"{', '.join(observation)}; give it, or rename one (rename_map)"
                )
            vectors = {key: self._vectors(observation[key], key, more) for key in keys}
            converted[TransitionKey.OBSERVATION] = {**observation, **vectors}
        action = transition.get(TransitionKey.ACTION)
        if action is not None and ACTION in self.dimensions:
            converted[TransitionKey.ACTION] = self._vectors(action, ACTION, more)
        return converted

    def _vectors(self, value: Any, key: str, more: dict[str, Any]) -> Tensor:
        """A feature as (B, d), or (B, T, d) where LeRobot's dataset says which of T steps are padding."""
        values, d = torch.as_tensor(value).to(torch.float32), self.dimensions[key]
        steps = values.shape[: 2 if f"{key}_is_pad" in more else 1]
        if steps and values.numel() == steps.numel() * d:
            return values.reshape(*steps, d)
        if values.ndim < 2 and values.numel() == d:  # a single frame
            return values.reshape(1, d)
        raise ValueError(
            f"feature {key!r} arrives with shape {list(values.shape)}, the policy takes (batch, {d})"
        )

    def get_config(self) -> dict[str, Any]:
        """What a checkpoint remembers of this step."""
        return {"dimensions": self.dimensions}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The features with their shapes flattened."""
        return {
            kind: {
                key: PolicyFeature(ft.type, (self.dimensions[key],)) if key in self.dimensions else ft
                for key, ft in group.items()
            }
            for kind, group in features.items()
        }


def vector_pipelines(
    config: PreTrainedConfig, dimensions: dict[str, int], dataset_stats: Statistics | None = None
) -> Pipelines:
    """LeRobot's default pipelines, on vectors; constant dimensions are centred instead of being blown up.

    Args:
        config: The policy's configuration.
        dimensions: Its inputs and outputs to how many numbers they are.
        dataset_stats: The dataset's statistics.
    """
    steps = make_default_policy_processor_steps(config, prepared_statistics(dimensions, dataset_stats))
    vectors = FloatVectorsProcessorStep(dimensions)
    return make_policy_processor_pipelines(
        # The step that adds a batch's dimension takes any tensor of one dimension for a single frame.
        [steps.rename_observations, vectors, steps.add_batch_dim, steps.to_device, steps.normalize],
        [steps.unnormalize, steps.to_cpu],
    )


def prepared_statistics(dimensions: Mapping[str, int], stats: Statistics | None) -> Statistics | None:
    """Statistics as vectors, with the standard deviation of constant dimensions set to 1.

    LeRobot divides by std + 1e-8, so the rounding error of a constant's mean would become an input or a
    target of the order of 1.
    """
    if stats is None:
        return None
    prepared = dict(stats)
    for key, d in dimensions.items():
        if key not in stats:
            continue
        values = {name: _as_vector(value, d) for name, value in stats[key].items() if name != "count"}
        if {"std", "min", "max"} <= values.keys():
            values["std"] = np.where(values["min"] == values["max"], 1.0, values["std"])
        prepared[key] = {**stats[key], **values}
    return prepared


def _as_vector(value: Any, d: int) -> np.ndarray:
    """(d,) of a statistic of a vector, or of a grid, whose rows LeRobot pools."""
    array = np.asarray(value)
    return np.tile(array.reshape(-1), d // array.size) if d % array.size == 0 else array
