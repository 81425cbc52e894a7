"""Pre- and post-processing of ``bc``, ``zbc`` and ``wzbc``: LeRobot's default pipelines."""

import logging
from typing import Any

import torch
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from lerobot_swr.policies.configuration_swr import BCConfig

Pipelines = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]
Statistics = dict[str, dict[str, Any]]

CONSTANT_STD = 1e-6  # relative to the mean's size; below it a dimension counts as constant


def make_bc_pre_post_processors(config: BCConfig, dataset_stats: Statistics | None = None) -> Pipelines:
    """LeRobot's default pipelines; constant dimensions are centred instead of being blown up."""
    return make_default_pre_post_processors(config, _with_unit_std_where_constant(config, dataset_stats))


make_zbc_pre_post_processors = make_bc_pre_post_processors
make_wzbc_pre_post_processors = make_bc_pre_post_processors


def _with_unit_std_where_constant(config: BCConfig, stats: Statistics | None) -> Statistics | None:
    """Set the standard deviation of constant dimensions to 1.

    LeRobot divides by std + 1e-8, so the rounding error of a constant's mean would become an input or a target
    of the order of 1.
    """
    if stats is None:
        return None
    fixed = dict(stats)
    for key in {**(config.input_features or {}), **(config.output_features or {})}:
        if "std" not in stats.get(key, {}):
            continue
        mean = torch.as_tensor(stats[key]["mean"], dtype=torch.float64)
        std = torch.as_tensor(stats[key]["std"], dtype=torch.float64)
        constant = std <= CONSTANT_STD * mean.abs().clamp(min=1.0)
        if constant.any():
            logging.info("%s: dimensions %s are constant", key, constant.nonzero().flatten().tolist())
            fixed[key] = {**stats[key], "std": torch.where(constant, 1.0, std).to(torch.float32).numpy()}
    return fixed
