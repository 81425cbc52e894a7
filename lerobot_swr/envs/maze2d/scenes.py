"""Scenes: a maze's goal and doors as numbers, drawn for an episode or read from its ``environment_state``."""

from dataclasses import replace

import numpy as np

from lerobot_swr.envs.maze2d.layouts import MazeLayout


def scene_names(layout: MazeLayout) -> tuple[str, ...]:
    """What the numbers of a scene mean: the goal's place and, where they differ, those of the doors."""
    doors = [f"door_{door.checkpoint}_x" for wall in layout.walls for door in wall.doors]
    return ("goal_x", "goal_y", *(doors if layout.scenes else ()))


def draw_scene(layout: MazeLayout, rng: np.random.Generator) -> np.ndarray:
    """(S,) the scene of one episode; a maze without scenes draws nothing.

    The numbers are ones that 32-bit floats hold, so that a recording tells the scene exactly.
    """
    doors = np.array([door.x for wall in layout.walls for door in wall.doors])
    if layout.scenes is None:
        return np.array(layout.goal)
    goal = rng.uniform(*np.transpose(layout.scenes.goal))
    shifts = rng.uniform(-layout.scenes.door_shift, layout.scenes.door_shift, size=len(doors))
    return as_recorded(np.concatenate([goal, doors + shifts]))


def draw_start(layout: MazeLayout, rng: np.random.Generator) -> np.ndarray:
    """(2,) the start of one episode."""
    if layout.scenes is None:
        return np.array(layout.start)
    return as_recorded(rng.uniform(*np.transpose(layout.scenes.start)))


def as_recorded(numbers: np.ndarray) -> np.ndarray:
    """The nearest numbers that 32-bit floats hold, as float64."""
    return numbers.astype(np.float32).astype(np.float64)


def maze_of(layout: MazeLayout, scene: np.ndarray) -> MazeLayout:
    """The maze of one scene (S,), or of n at once (n, S)."""
    if layout.scenes is None:
        return layout
    scene = np.asarray(scene, dtype=np.float64)
    doors = iter(np.moveaxis(scene[..., 2:], -1, 0))
    walls = tuple(
        replace(wall, doors=tuple(replace(door, x=next(doors)) for door in wall.doors))  # type: ignore[arg-type]
        for wall in layout.walls
    )
    return replace(layout, walls=walls, goal=scene[..., :2])  # type: ignore[arg-type]
