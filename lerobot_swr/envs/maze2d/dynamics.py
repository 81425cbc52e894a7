"""The maze's physics for any number of agents at once: pure functions on an array of positions."""

import numpy as np

from lerobot_swr.envs.maze2d.layouts import MazeLayout

MAX_STEP = 0.02  # largest displacement per axis and step, as a share of the maze's side
WALL_GAP = 1e-3  # an agent that slides along a wall keeps this distance from it


def move(
    positions: np.ndarray, displacements: np.ndarray, layout: MazeLayout, sticky_walls: bool = False
) -> np.ndarray:
    """Move agents along straight lines and stop them at walls.

    Args:
        positions: (n, 2) positions in the unit square.
        displacements: (n, 2) intended displacement, noise included.
        layout: The maze, or those of the n agents.
        sticky_walls: An agent that hits a wall or the border stays where it was; otherwise it slides along.

    Returns:
        (n, 2) new positions.
    """
    intended = positions + displacements
    targets = np.clip(intended, 0.0, 1.0)
    hit_border = (targets != intended).any(axis=1)

    y0, y1 = positions[:, 1], targets[:, 1]
    first_hit = np.full(len(positions), np.inf)  # share of the step at which the first closed wall is met
    stop_y = y1.copy()
    for wall in layout.walls:
        crosses = (y0 > wall.y) != (y1 > wall.y)
        share = np.divide(wall.y - y0, y1 - y0, out=np.zeros_like(y0), where=crosses)
        x = positions[:, 0] + share * (targets[:, 0] - positions[:, 0])
        in_door = np.zeros(len(positions), dtype=bool)
        for door in wall.doors:
            in_door |= np.abs(x - door.x) <= door.half_width
        blocked = crosses & ~in_door & (share < first_hit)
        first_hit[blocked] = share[blocked]
        stop_y[blocked] = wall.y - np.sign(wall.y - y0[blocked]) * WALL_GAP
    hit_wall = np.isfinite(first_hit)

    if sticky_walls:
        return np.where((hit_wall | hit_border)[:, None], positions, targets)
    return np.stack([targets[:, 0], stop_y], axis=1)


def in_goal(positions: np.ndarray, layout: MazeLayout) -> np.ndarray:
    """Which of the (n, 2) positions lie in the goal disc: (n,) bool."""
    return np.linalg.norm(positions - np.array(layout.goal), axis=1) <= layout.goal_radius
