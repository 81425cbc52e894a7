"""What a behaviour is: a label that a pure rule gives to the states of one episode.

One rule labels demonstrations and rollouts alike, so that their histograms can be compared. Every task of
this package carries its own rule; a user names another one (`lerobot_swr.behavior_rules`).
"""

from collections.abc import Callable, Mapping

import numpy as np

BehaviorRule = Callable[[Mapping[str, np.ndarray]], str]
"""Maps an episode's observations, ``{"observation.state": (T, d), ...}``, to a label.

The keys are LeRobot's feature names; T counts the states of the episode, the last one included where it is
known (rollouts) or recorded (demonstrations). An episode that fails the task gets a label of its own, which
no successful episode has.
"""


DATASET_RULES = {
    "maze2d_small": "lerobot_swr.envs.maze2d.behavior:small",
    "maze2d_medium": "lerobot_swr.envs.maze2d.behavior:medium",
    "maze2d_large": "lerobot_swr.envs.maze2d.behavior:large",
    "maze2d_scenes": "lerobot_swr.envs.maze2d.behavior:scenes",
    "maze2d_scenes_large": "lerobot_swr.envs.maze2d.behavior:scenes_large",
    "d3il_avoiding": "lerobot_swr.envs.d3il.behavior:avoiding_behavior",
    "d3il_aligning": "lerobot_swr.envs.d3il.behavior:aligning_behavior",
}
"""``robot_type`` of this package's own datasets to the rule that labels their episodes."""
