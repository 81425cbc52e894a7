"""How an agent goes through a maze, wherever its doors are, for ``--policy.similarity_features``."""

from collections.abc import Mapping

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_swr.envs.maze2d.layouts import LAYOUTS, MazeLayout
from lerobot_swr.envs.maze2d.scenes import maze_of


class Ways:
    """Where an episode first passes each wall, in the frame of that wall's doors.

    As an object's frame does for a hand's path, it leaves out where things lie, and keeps how they are used.

    Args:
        layout: The maze.
    """

    def __init__(self, layout: MazeLayout):
        self.layout = layout

    def __call__(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """(W,) from the lowest wall up: 0 is the centre of its leftmost door, 1 that of its rightmost one.

        A wall that is not passed counts as one that is passed half way between them.

        Args:
            observations: ``observation.state`` (T, 2) and ``observation.environment_state`` (T, S).
        """
        path = np.asarray(observations[OBS_STATE], dtype=np.float64)
        found = []
        for wall in maze_of(self.layout, observations[OBS_ENV_STATE][0]).walls:
            above = path[:, 1] > wall.y
            crossings = np.flatnonzero(above[1:] != above[:-1])
            left, right = (pick(door.x for door in wall.doors) for pick in (min, max))
            if not len(crossings):
                found.append(0.5)
                continue
            before, after = path[crossings[0]], path[crossings[0] + 1]
            share = (wall.y - before[1]) / (after[1] - before[1])
            found.append((before[0] + share * (after[0] - before[0]) - left) / (right - left))
        return np.array(found)


# By name, for --policy.similarity_features=lerobot_swr.envs.maze2d.manner:scenes
scenes = Ways(LAYOUTS["scenes"])
scenes_large = Ways(LAYOUTS["scenes_large"])
