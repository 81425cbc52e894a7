"""A camera above the maze: small pictures, fast enough for training and rollouts on one core.

Everything is drawn by how much of a pixel it covers, so that a picture shows places to a fraction of a pixel.
"""

import numpy as np

from lerobot_swr.envs.maze2d.layouts import MazeLayout
from lerobot_swr.envs.maze2d.scenes import maze_of

CAMERA_SIZE = 64  # pixels
AGENT_RADIUS = 0.03
WALL_HALF_WIDTH = 0.012
_FLOOR, _WALL, _GOAL, _AGENT = (
    np.array(colour, dtype=np.float32)
    for colour in ((245, 245, 245), (38, 50, 56), (46, 160, 67), (30, 110, 200))
)
_KEPT = 1024  # empty mazes that are kept


class MazeCamera:
    """Draws agents in the mazes of their scenes, seen from above; x grows to the right, y upwards.

    Args:
        layout: The maze.
        size: Side of a picture, in pixels.

    Raises:
        ValueError: If a picture has less than 16 pixels a side.
    """

    def __init__(self, layout: MazeLayout, size: int):
        if size < 16:
            raise ValueError(f"camera_size={size}: expected at least 16 pixels")
        self.layout, self.size = layout, size
        self._empty: dict[bytes, np.ndarray] = {}

    def pictures(self, positions: np.ndarray, scenes: np.ndarray) -> np.ndarray:
        """(n, size, size, 3) uint8 of (n, 2) positions in (n, S) scenes."""
        drawn = np.stack([self._maze(scene) for scene in scenes])
        for picture, position in zip(drawn, np.asarray(positions, dtype=np.float64), strict=True):
            self._draw_agent(picture, position)
        return drawn

    def _maze(self, scene: np.ndarray) -> np.ndarray:
        """(size, size, 3) uint8 of a scene without an agent."""
        key = np.asarray(scene, dtype=np.float32).tobytes()
        if key not in self._empty:
            if len(self._empty) >= _KEPT:
                self._empty.clear()
            self._empty[key] = draw_empty_maze(maze_of(self.layout, scene), self.size)
        return self._empty[key]

    def _draw_agent(self, picture: np.ndarray, position: np.ndarray) -> None:
        radius = AGENT_RADIUS * self.size
        x, y = position[0] * self.size, (1 - position[1]) * self.size
        left, top = (max(0, int(at - radius - 1)) for at in (x, y))
        right, bottom = (min(self.size, int(at + radius + 2)) for at in (x, y))
        columns, rows = np.arange(left, right) + 0.5 - x, np.arange(top, bottom) + 0.5 - y
        share = np.clip(radius + 0.5 - np.hypot(columns, rows[:, None]), 0, 1)[..., None]
        patch = picture[top:bottom, left:right]
        patch[:] = np.rint(patch + share * (_AGENT - patch))


def draw_empty_maze(maze: MazeLayout, size: int) -> np.ndarray:
    """(size, size, 3) uint8 picture of floor, goal disc and walls."""
    picture = np.broadcast_to(_FLOOR, (size, size, 3)).copy()
    centres = (np.arange(size) + 0.5) / size
    x, y = centres, 1 - centres[:, None]

    def paint(share: np.ndarray, colour: np.ndarray) -> None:
        picture[:] += np.clip(share, 0, 1)[..., None] * (colour - picture)

    goal_x, goal_y = maze.goal
    paint((maze.goal_radius - np.hypot(x - goal_x, y - goal_y)) * size + 0.5, _GOAL)
    for wall in maze.walls:
        across = np.clip((WALL_HALF_WIDTH - np.abs(y - wall.y)) * size + 0.5, 0, 1)
        along: np.ndarray = np.ones(size)
        for door in wall.doors:
            along = np.minimum(along, np.clip((np.abs(x - door.x) - door.half_width) * size + 0.5, 0, 1))
        paint(across * along, _WALL)
    return np.rint(picture).astype(np.uint8)
