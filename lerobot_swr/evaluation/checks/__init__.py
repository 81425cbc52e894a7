"""What ``lerobot-swr-eval`` can check, one module per ``--check.type``.

A module holds its options (a `Check`), what it measures (a frozen dataclass, written as JSON), its picture
and its table. A further check is a module here and a line below, which registers it.
"""

from lerobot_swr.evaluation.checks import (  # noqa: F401
    behaviors,
    blend,
    counterfactual,
    length,
    offline,
    replay,
    robustness,
)
