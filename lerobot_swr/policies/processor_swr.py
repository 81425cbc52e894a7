"""Pre- and post-processing of ``bc``, ``zbc`` and ``wzbc``: LeRobot's default pipelines."""

from typing import Any

import numpy as np
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_swr.policies.state_config import StateConfig

Pipelines = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]
Statistics = dict[str, dict[str, Any]]


def make_bc_pre_post_processors(config: StateConfig, dataset_stats: Statistics | None = None) -> Pipelines:
    """LeRobot's default pipelines; constant dimensions are centred instead of being blown up."""
    return make_default_pre_post_processors(config, with_unit_std_where_constant(config, dataset_stats))


make_zbc_pre_post_processors = make_bc_pre_post_processors
make_wzbc_pre_post_processors = make_bc_pre_post_processors


def with_unit_std_where_constant(config: StateConfig, stats: Statistics | None) -> Statistics | None:
    """Set the standard deviation of constant dimensions to 1.

    LeRobot divides by std + 1e-8, so the rounding error of a constant's mean would become an input or a
    target of the order of 1.
    """
    if stats is None:
        return None
    fixed = dict(stats)
    for key in {**(config.input_features or {}), **(config.output_features or {})}:
        if not {"std", "min", "max"} <= stats.get(key, {}).keys():
            continue
        constant = np.asarray(stats[key]["min"]) == np.asarray(stats[key]["max"])
        fixed[key] = {**stats[key], "std": np.where(constant, 1.0, stats[key]["std"])}
    return fixed
