"""Where things stand in the two D3IL tasks and when they are done: numbers only, in metres and radians.

Source: Jia et al., ICLR 2024, and measurements of the running benchmark. The simulator-free behaviour rules
and the environments both read them here.
"""

from typing import NamedTuple

import numpy as np

CONTROL_PERIOD_S = 0.035
"""Time between two actions: 35 ms of simulation."""

FPS = 29
"""Control rate as LeRobot stores it, in whole Hz; the exact rate is 1 / 0.035 s = 28.57 Hz."""

CAMERA_SIZE = 96
"""Side of the observed pictures, in pixels."""

ACTION_LIMIT_M = 0.05
"""Largest change of the desired position per step and axis; actions beyond are clipped."""


class Obstacle(NamedTuple):
    """A vertical cylinder that stands on z = 0, centred there; it cannot be moved."""

    name: str
    x: float
    y: float
    radius: float
    half_height: float


# --- Avoiding: find a way through three levels of cylinders to the finish line.

OBSTACLES = (
    Obstacle("level1", 0.5, -0.1, 0.03, 0.07),
    Obstacle("level2_low_x", 0.425, 0.08, 0.025, 0.1),
    Obstacle("level2_high_x", 0.575, 0.08, 0.025, 0.1),
    Obstacle("level3_low_x", 0.35, 0.26, 0.025, 0.1),
    Obstacle("level3_mid_x", 0.5, 0.26, 0.025, 0.1),
    Obstacle("level3_high_x", 0.65, 0.26, 0.025, 0.1),
)
ROD_RADIUS = 0.01
FINISH_LINE_Y = 0.35
AVOIDING_EPISODE_LENGTH = 250
AVOIDING_DESCRIPTION = "Move the rod past the obstacles to the finish line without touching them."
AVOIDING_SCENE_NAMES = (
    *(f"{obstacle.name}.{part}" for obstacle in OBSTACLES for part in ("x", "y", "radius")),
    "finish_line.y",
)
"""Dimensions of the observed ``environment_state``."""
AVOIDING_SCENE = np.array(
    [value for o in OBSTACLES for value in (o.x, o.y, o.radius)] + [FINISH_LINE_Y], dtype=np.float32
)
"""(19,) the ``environment_state`` of avoiding, which never changes."""
LEVEL_BAND = 0.03
"""Levels 1 and 2 are judged when the tool is first this close to their obstacles' y, level 3 on passing."""

AVOIDING_START_JOINTS = (
    -0.3564086847191445, 0.4294454540368537, -0.1350105953007747, -2.0546518930206967,
    0.093578222915761, 2.480717940701337, 0.23250675884947175,
)  # fmt: skip
AVOIDING_START_TOOL = (0.52492846634074, -0.27973672759214413, 0.12235930599088181)
"""Tool position in the start pose. Its height is the desired height throughout an avoiding episode."""

# --- Aligning: push or pull an open box onto a target pose.

ALIGNING_EPISODE_LENGTH = 400
ALIGNING_START_JOINTS = (
    -0.39275835987073365, 0.3217781233957073, -0.21250285252375786, -1.8435813567122021,
    0.08314888038640006, 2.160344058282072, 0.14479521819682337,
)  # fmt: skip
ALIGNING_START_TOOL = (0.5249578088772141, -0.34881810941048447, 0.25159789342766353)
ALIGNING_DESCRIPTION = "Move the box onto the target and align it with the matching colours."
ALIGNING_SCENE_NAMES = tuple(
    f"{thing}.{part}" for thing in ("box", "target") for part in ("x", "y", "z", "qw", "qx", "qy", "qz")
)
"""Dimensions of the observed ``environment_state``."""
BOX_SIDE = 0.11
"""Outer side of the box; its walls are 0.01 thick and the box is open at the top."""
BOX_POSITION_RANGE = ((0.4, 0.6), (-0.25, -0.1))
TARGET_POSITION_RANGE = ((0.4, 0.6), (0.2, 0.35))
ANGLE_RANGE = (-np.pi / 2, np.pi / 2)
POSITION_TOLERANCE = 0.018
"""Largest 3-D distance of the box to its target; resting 9.2 mm below it leaves 15.5 mm in the plane."""
ROTATION_TOLERANCE = 0.048 * np.pi
"""Largest rotation between the box and its target: 8.64 degrees."""
INSIDE_DISTANCE = 0.051
"""The tool works from inside the box if it is closer than this to the box's centre, in the plane."""
