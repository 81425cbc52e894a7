"""Draws the maze, its numbered doors and the path so far."""

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lerobot_swr.envs.maze2d.layouts import MazeLayout

WALL, DOOR, PATH, GOAL = (38, 50, 56), (120, 144, 156), (30, 110, 200), (46, 160, 67)


def draw_maze(layout: MazeLayout, size: int) -> Image.Image:
    """The empty maze.

    Args:
        layout: The maze.
        size: Side of the picture, in pixels.
    """
    image = Image.new("RGB", (size, size), "white")
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=max(9, size // 20))
    width = max(2, size // 80)

    def pixel(x: float, y: float) -> tuple[float, float]:
        return x * (size - 1), (1 - y) * (size - 1)

    draw.rectangle((0, 0, size - 1, size - 1), outline=WALL, width=width)
    for wall in layout.walls:
        left = 0.0
        for door in sorted(wall.doors, key=lambda door: door.x):
            draw.line(
                (*pixel(left, wall.y), *pixel(door.x - door.half_width, wall.y)), fill=WALL, width=width
            )
            draw.text(pixel(door.x, wall.y), str(door.checkpoint), fill=DOOR, font=font, anchor="mm")
            left = door.x + door.half_width
        draw.line((*pixel(left, wall.y), *pixel(1.0, wall.y)), fill=WALL, width=width)

    (gx, gy), r = pixel(*layout.goal), layout.goal_radius * (size - 1)
    draw.ellipse((gx - r, gy - r, gx + r, gy + r), outline=GOAL, width=width)
    draw.text((gx, gy), "0", fill=GOAL, font=font, anchor="mm")
    return image


def draw_episode(maze: Image.Image, path: np.ndarray) -> np.ndarray:
    """The maze with an episode's path and the agent at its end.

    Args:
        maze: Picture from `draw_maze`.
        path: (T, 2) positions so far.

    Returns:
        (size, size, 3) uint8.
    """
    image = maze.copy()
    draw = ImageDraw.Draw(image)
    size = image.width
    points = [(x * (size - 1), (1 - y) * (size - 1)) for x, y in path]
    if len(points) > 1:
        draw.line(points, fill=PATH, width=max(1, size // 160), joint="curve")
    x, y = points[-1]
    r = max(3, size // 50)
    draw.ellipse((x - r, y - r, x + r, y + r), fill=PATH)
    return np.asarray(image)
