"""Where LeRobot looks for the pre- and post-processing of ``bc``, ``zbc`` and ``wzbc``."""

from typing import Any

from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.policies.vector_pipelines import Pipelines


def make_bc_pre_post_processors(
    config: StateConfig, dataset_stats: Statistics | None = None, dataset_meta: Any | None = None
) -> Pipelines:
    """The pipelines of the policy's backbone."""
    return config.make_pipelines(dataset_stats, dataset_meta)


make_zbc_pre_post_processors = make_bc_pre_post_processors
make_wzbc_pre_post_processors = make_bc_pre_post_processors
