"""The mazes as plain literals: walls with numbered doors in the unit square."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Door:
    """A gap in a wall.

    Attributes:
        checkpoint: The number that names the door in a behaviour label; one digit, 0 is the goal.
        x: Centre of the gap, as a share of the maze's side; an array (n,) where this stands for n mazes.
        half_width: Half the width of the gap, in the same unit.
    """

    checkpoint: int
    x: float
    half_width: float


@dataclass(frozen=True)
class Wall:
    """A horizontal wall of zero thickness across the whole maze, open only at its doors."""

    y: float
    doors: tuple[Door, ...]


@dataclass(frozen=True)
class Scenes:
    """What every episode draws for itself, uniformly.

    Attributes:
        start: Ranges of x and y of the start.
        goal: Ranges of x and y of the goal.
        door_shift: Doors lie within this distance of the place that the layout gives them.
    """

    start: tuple[tuple[float, float], tuple[float, float]]
    goal: tuple[tuple[float, float], tuple[float, float]]
    door_shift: float


@dataclass(frozen=True)
class MazeLayout:
    """A maze in the unit square; x grows to the right, y upwards.

    Attributes:
        walls: From the start (bottom) to the goal (top).
        start: (2,) start position.
        goal: (2,) centre of the goal disc; (n, 2) where this stands for n mazes.
        goal_radius: The goal is reached at this distance from its centre or nearer.
        scenes: Where start, goal and doors differ from episode to episode; None where all are the same.
    """

    walls: tuple[Wall, ...]
    start: tuple[float, float] = (0.5, 0.08)
    goal: tuple[float, float] = (0.5, 0.92)
    goal_radius: float = 0.05
    scenes: Scenes | None = None

    @property
    def wall_y(self) -> np.ndarray:
        """(W,) heights of the walls."""
        return np.array([wall.y for wall in self.walls])


_SCENES = Scenes(start=((0.1, 0.9), (0.06, 0.16)), goal=((0.1, 0.9), (0.84, 0.94)), door_shift=0.13)

LAYOUTS = {
    # 2 forward behaviours.
    "small": MazeLayout(walls=(Wall(0.50, (Door(1, 0.27, 0.10), Door(2, 0.73, 0.10))),)),
    # 2 * 3 * 2 = 12 forward behaviours.
    "medium": MazeLayout(
        walls=(
            Wall(0.25, (Door(6, 0.27, 0.10), Door(7, 0.73, 0.10))),
            Wall(0.50, (Door(3, 0.17, 0.09), Door(4, 0.50, 0.09), Door(5, 0.83, 0.09))),
            Wall(0.75, (Door(1, 0.27, 0.10), Door(2, 0.73, 0.10))),
        )
    ),
    # 2 * 3 * 2 * 2 = 24 forward behaviours.
    "large": MazeLayout(
        walls=(
            Wall(0.20, (Door(8, 0.27, 0.09), Door(9, 0.73, 0.09))),
            Wall(0.40, (Door(5, 0.17, 0.09), Door(6, 0.50, 0.09), Door(7, 0.83, 0.09))),
            Wall(0.60, (Door(3, 0.27, 0.09), Door(4, 0.73, 0.09))),
            Wall(0.80, (Door(1, 0.30, 0.09), Door(2, 0.70, 0.09))),
        )
    ),
    # 2 forward behaviours, in scenes that differ.
    "scenes": MazeLayout(
        walls=(Wall(0.50, (Door(1, 0.28, 0.07), Door(2, 0.72, 0.07))),),
        scenes=_SCENES,
    ),
    # 2 * 3 = 6 forward behaviours, in scenes that differ.
    "scenes_large": MazeLayout(
        walls=(
            Wall(0.36, (Door(4, 0.28, 0.07), Door(5, 0.72, 0.07))),
            Wall(0.64, (Door(1, 0.18, 0.06), Door(2, 0.50, 0.06), Door(3, 0.82, 0.06))),
        ),
        scenes=replace(_SCENES, door_shift=0.08),
    ),
}


def get_layout(task: str) -> MazeLayout:
    """The layout called `task`.

    Raises:
        ValueError: If there is no such layout.
    """
    if task not in LAYOUTS:
        raise ValueError(f"task={task!r}: unknown maze; known mazes: {', '.join(LAYOUTS)}")
    return LAYOUTS[task]
