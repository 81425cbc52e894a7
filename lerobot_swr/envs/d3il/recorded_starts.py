"""How a D3IL task is put into the start of a recorded episode: options of `reset`, without a simulator."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE


def avoiding_start(observations: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The tool's first desired and actual position.

    Args:
        observations: ``observation.state`` (T, 4).
    """
    return {"agent_pos": observations[OBS_STATE][0]}


def aligning_start(observations: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """The tool's first desired and actual position, and where box and target stand.

    `reset` knows them by x, y and their turn about the vertical: a box that is recorded while it tilts or
    hangs in the air begins flat on the table.

    Args:
        observations: ``observation.state`` (T, 6) and ``observation.environment_state`` (T, 14).
    """
    scene = np.asarray(observations[OBS_ENV_STATE][0], dtype=np.float64)
    return {
        "agent_pos": observations[OBS_STATE][0],
        "box": [*scene[0:2], vertical_turn(scene[3:7])],
        "target": [*scene[7:9], vertical_turn(scene[10:14])],
    }


def vertical_turn(quaternion: np.ndarray) -> float:
    """Turn about the vertical in rad of a rotation (w, x, y, z), -pi to pi."""
    w, x, y, z = quaternion
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
