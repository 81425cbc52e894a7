"""The maze's behaviour rule: through which doors, in which order."""

from collections.abc import Mapping

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_swr.envs.maze2d.dynamics import in_goal
from lerobot_swr.envs.maze2d.layouts import LAYOUTS, MazeLayout
from lerobot_swr.envs.maze2d.scenes import maze_of


def checkpoints_passed(positions: np.ndarray, layout: MazeLayout) -> str:
    """The checkpoints of one episode in the order in which they are first passed.

    A door is passed when two consecutive positions lie on different sides of its wall; the goal (checkpoint
    0) is passed at the first position inside the goal disc, and ends the label.

    Args:
        positions: (T, 2) positions in the unit square.
        layout: The maze.

    Returns:
        For example ``"6410"``. An episode that never reaches the goal has no trailing 0; one that passes
        nothing at all is ``""``.
    """
    positions = np.asarray(positions, dtype=np.float64)
    at_goal = in_goal(positions, layout)  # (T,)
    reaches_goal = bool(at_goal.any())
    end = int(at_goal.argmax()) + 1 if reaches_goal else len(positions)

    y = positions[:end, 1]
    above = y[:, None] > layout.wall_y[None, :]  # (T, W)
    crossings = []  # (time, checkpoint)
    for t, w in np.argwhere(above[1:] != above[:-1]):
        wall = layout.walls[w]
        share = (wall.y - y[t]) / (y[t + 1] - y[t])  # of the step, in (0, 1]
        x = positions[t, 0] + share * (positions[t + 1, 0] - positions[t, 0])
        door = min(wall.doors, key=lambda door: abs(door.x - x))
        crossings.append((t + share, str(door.checkpoint)))

    label = dict.fromkeys(checkpoint for _, checkpoint in sorted(crossings))
    return "".join(label) + ("0" if reaches_goal else "")


class MazeBehaviorRule:
    """`checkpoints_passed` as a behaviour rule on an episode's observations.

    Args:
        layout: The maze.
    """

    def __init__(self, layout: MazeLayout):
        self.layout = layout

    def __call__(self, observations: Mapping[str, np.ndarray]) -> str:
        """Label an episode from its ``observation.state`` (T, 2) and its scene, if the maze has scenes."""
        return checkpoints_passed(observations[OBS_STATE], self.maze(observations))

    def maze(self, observations: Mapping[str, np.ndarray]) -> MazeLayout:
        """The maze of an episode, by its ``observation.environment_state`` (T, S) where scenes differ."""
        return maze_of(self.layout, observations[OBS_ENV_STATE][0]) if self.layout.scenes else self.layout


# The rules by name, for --policy.behavior_rule=lerobot_swr.envs.maze2d.behavior:medium
small = MazeBehaviorRule(LAYOUTS["small"])
medium = MazeBehaviorRule(LAYOUTS["medium"])
large = MazeBehaviorRule(LAYOUTS["large"])
scenes = MazeBehaviorRule(LAYOUTS["scenes"])
scenes_large = MazeBehaviorRule(LAYOUTS["scenes_large"])
