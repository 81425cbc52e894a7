"""The policies ``bc``, ``zbc`` and ``wzbc``, where LeRobot looks for them: beside `configuration_swr`."""

from lerobot_swr.policies.configuration_swr import BCConfig, WZBCConfig, ZBCConfig
from lerobot_swr.policies.style_policy import StylePolicy


class BCPolicy(StylePolicy):
    """``bc``: behaviour cloning without styles; a deterministic policy fitted by squared error."""

    config_class = BCConfig
    name = "bc"


class ZBCPolicy(StylePolicy):
    """``zbc``: one trainable style per demonstration, learned from that demonstration (eq. 1 and 2)."""

    config_class = ZBCConfig
    name = "zbc"


class WZBCPolicy(StylePolicy):
    """``wzbc``: similar demonstrations teach each other's styles (algorithm 1)."""

    config_class = WZBCConfig
    name = "wzbc"
