"""Which behaviour an episode of a D3IL task shows: pure functions of its states, without a simulator.

The same functions label demonstrations, rollouts and converted recordings, and the environments judge their
states with them. The keys are LeRobot's: ``observation.state`` (T, 4) or (T, 6) holds the desired and then
the actual tool position, ``observation.environment_state`` the scene.
"""

from collections.abc import Mapping

import numpy as np

from lerobot_swr.envs.d3il.layouts import (
    FINISH_LINE_Y,
    INSIDE_DISTANCE,
    LEVEL_BAND,
    OBSTACLES,
    POSITION_TOLERANCE,
    ROD_RADIUS,
    ROTATION_TOLERANCE,
)

COLLISION = "collision"
UNFINISHED = "unfinished"
INSIDE, OUTSIDE = "inside", "outside"
NOT_ALIGNED = "not_aligned"

GAP_NAMES = (("top", "bottom"), ("top", "mid", "bottom"), ("top", "midtop", "midbottom", "bottom"))
"""Names of the gaps at each level, from small to large x; small x (the robot) is at the top of pictures."""

AVOIDING_BEHAVIORS = tuple(f"{a}-{b}-{c}" for a in GAP_NAMES[0] for b in GAP_NAMES[1] for c in GAP_NAMES[2])
"""The 24 ways through the three levels."""

_LEVEL_1, _LEVEL_2, _LEVEL_3 = (
    sorted(o.x for o in OBSTACLES if o.name.startswith(f"level{i}")) for i in (1, 2, 3)
)
_LEVEL_Y = tuple(next(o.y for o in OBSTACLES if o.name.startswith(f"level{i}")) for i in (1, 2, 3))
_BIT_OFFSETS = (0, 2, 5)
_TOUCH_TOLERANCE = 0.003  # metres; the rod tilts a little, so that it may touch before its tool point is near

Gaps = tuple[int | None, int | None, int | None]
"""The gap taken at each level, counted from small x, or None where the level was not reached."""


def gaps_after(gaps: Gaps, tool_xy: np.ndarray) -> Gaps:
    """The gaps known once the tool is at `tool_xy` (2,); each level is judged once, when first reached.

    Levels 1 and 2 are judged within `LEVEL_BAND` of their obstacles' y, level 3 on passing it. A tool exactly
    between two gaps belongs to neither at levels 1 and 2 and is judged again at the next state.
    Source: the mode encoding of Jia et al., ICLR 2024.
    """
    x, y = float(tool_xy[0]), float(tool_xy[1])
    first, second, third = gaps
    if first is None and abs(y - _LEVEL_Y[0]) <= LEVEL_BAND and x not in _LEVEL_1:
        first = int(np.searchsorted(_LEVEL_1, x))
    if second is None and abs(y - _LEVEL_Y[1]) <= LEVEL_BAND and x not in _LEVEL_2:
        second = int(np.searchsorted(_LEVEL_2, x))
    if third is None and y >= _LEVEL_Y[2]:
        # On an obstacle's axis the benchmark counts the last gap.
        third = 3 if x in _LEVEL_3 else int(np.searchsorted(_LEVEL_3, x))
    return first, second, third


def mode_bits(gaps: Gaps) -> np.ndarray:
    """(9,) int8: the benchmark's encoding, one bit per gap of the three levels (2 + 3 + 4)."""
    bits = np.zeros(9, dtype=np.int8)
    for gap, offset in zip(gaps, _BIT_OFFSETS, strict=True):
        if gap is not None:
            bits[offset + gap] = 1
    return bits


def gaps_of_behavior(behavior: str) -> tuple[int, int, int]:
    """The gaps that a label such as ``"top-mid-bottom"`` names."""
    first, second, third = behavior.split("-")
    return GAP_NAMES[0].index(first), GAP_NAMES[1].index(second), GAP_NAMES[2].index(third)


def avoiding_behavior(observations: Mapping[str, np.ndarray]) -> str:
    """Which way through the obstacles an avoiding episode took.

    Args:
        observations: ``observation.state`` (T, 4): desired xy, actual xy in metres.

    Returns:
        One of `AVOIDING_BEHAVIORS` (level names joined by "-", "none" for a level that was jumped over) if
        the tool crossed the finish line; else ``"collision"`` if the last state touches an obstacle, else
        ``"unfinished"``.
    """
    path = np.asarray(observations["observation.state"])[:, 2:4]
    if not (path[:, 1] > FINISH_LINE_Y).any():
        gap_to_rod = min(
            np.hypot(path[-1, 0] - o.x, path[-1, 1] - o.y) - o.radius - ROD_RADIUS for o in OBSTACLES
        )
        return COLLISION if gap_to_rod <= _TOUCH_TOLERANCE else UNFINISHED
    gaps: Gaps = (None, None, None)
    for tool_xy in path:
        gaps = gaps_after(gaps, tool_xy)
    return "-".join("none" if gap is None else names[gap] for gap, names in zip(gaps, GAP_NAMES, strict=True))


def rotation_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle in rad between rotations given as unit quaternions (..., 4), in [0, pi]."""
    cosine = np.abs(np.sum(np.asarray(first, np.float64) * np.asarray(second, np.float64), axis=-1))
    return 2.0 * np.arccos(np.minimum(cosine, 1.0))


def is_aligned(environment_state: np.ndarray) -> np.ndarray:
    """Whether the box is on its target.

    Args:
        environment_state: (..., 14): box position and quaternion, target position and quaternion.

    Returns:
        (...,) bool: position within 18 mm (in 3-D; the box rests 9.2 mm below the target's height) and
        rotation within 8.64 degrees.
    """
    state = np.asarray(environment_state, np.float64)
    distance = np.linalg.norm(state[..., 0:3] - state[..., 7:10], axis=-1)
    angle = rotation_distance(state[..., 3:7], state[..., 10:14])
    return (distance <= POSITION_TOLERANCE) & (angle <= ROTATION_TOLERANCE)


def is_inside(tool_position: np.ndarray, box_position: np.ndarray) -> np.ndarray:
    """(...,) bool: whether the tool (..., >= 2) is closer to the box's centre than its walls."""
    offset = np.asarray(tool_position, np.float64)[..., :2] - np.asarray(box_position, np.float64)[..., :2]
    return np.linalg.norm(offset, axis=-1) < INSIDE_DISTANCE


def aligning_behavior(observations: Mapping[str, np.ndarray]) -> str:
    """Whether an aligning episode moved the box from its inside or from its outside.

    Args:
        observations: ``observation.state`` (T, 6): desired xyz, actual xyz; ``observation.environment_state``
            (T, 14): box position and quaternion (wxyz), target position and quaternion.

    Returns:
        ``"inside"`` or ``"outside"``, judged at the last state, if the box reached its target at any state
        (an environment ends there; recordings may run on); else ``"not_aligned"``.
    """
    scene = np.asarray(observations["observation.environment_state"])
    if not is_aligned(scene).any():
        return NOT_ALIGNED
    tool = np.asarray(observations["observation.state"])[-1, 3:6]
    return INSIDE if is_inside(tool, scene[-1, 0:3]) else OUTSIDE
