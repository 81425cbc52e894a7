"""The policies ``bc``, ``zbc`` and ``wzbc``, where LeRobot looks for them: beside `configuration_swr`."""

from lerobot_swr.policies.bc_policy import BCPolicy
from lerobot_swr.policies.wzbc_policy import WZBCPolicy
from lerobot_swr.policies.zbc_policy import ZBCPolicy

__all__ = ["BCPolicy", "WZBCPolicy", "ZBCPolicy"]
