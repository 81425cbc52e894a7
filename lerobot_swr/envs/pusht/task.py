"""What evaluations ask of LeRobot's own environment type ``pusht``."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from lerobot.envs.configs import PushtEnv
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.pointer import PlanePointer, Pointer
from lerobot_swr.envs.pusht.block import GOAL_POSE, OUTLINE, keypoints_of, reset_state
from lerobot_swr.envs.task import StartRule, Task, task_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # half a second, for pictures alone

FIELD = 512  # side of the field, in its unit
MAX_LEAD = 60  # how far ahead of the agent its set-point is put; demonstrators led it by as much
KEYPOINT_OBSERVATIONS = "environment_state_agent_pos"


@task_of.register(PushtEnv)
class PushTTask(Task):
    """PushT, with the block's keypoints as observations.

    Pictures show the way of the block's centre to the goal.
    """

    def behavior_rule(self) -> BehaviorRule:
        """The side of the T from which it is pushed first, see `first_push`.

        Raises:
            ValueError: If the environment does not observe the block's keypoints.
        """
        self._check_observations()
        # Shapely comes with gym-pusht, which nobody needs who has other tasks.
        from lerobot_swr.envs.pusht.behavior import first_push

        return first_push

    def start_rule(self) -> StartRule:
        """Puts agent and block where they were; see `reset_state`.

        Raises:
            ValueError: If the environment does not observe the block's keypoints.
        """
        self._check_observations()
        return _start

    @property
    def draws_scenes(self) -> bool:
        """Where block and agent lie."""
        return True

    def pointer(self, env: gym.Env) -> Pointer:
        """The agent is led to the pointer's place."""
        return PlanePointer((0, FIELD), (FIELD, 0), "position", speed=MAX_LEAD)

    def plot_path(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """(T, 2) path of the middle of the block's keypoints, in pixels."""
        return observations[OBS_ENV_STATE].reshape(-1, 8, 2).mean(axis=1)

    def draw_scene(self, axes: "Axes") -> None:
        """The goal, in the field as the environment renders it (y downwards)."""
        axes.fill(*keypoints_of(GOAL_POSE)[list(OUTLINE)].T, color="lightgreen")
        axes.set(xlim=(0, FIELD), ylim=(FIELD, 0))

    def _check_observations(self) -> None:
        observed = self.env_cfg.obs_type  # type: ignore[attr-defined]
        if observed != KEYPOINT_OBSERVATIONS:
            raise ValueError(
                f"env.obs_type={observed!r}: what happens in PushT is read from the block's keypoints; give "
                f"--env.obs_type={KEYPOINT_OBSERVATIONS}"
            )


def _start(observations: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    keypoints = observations[OBS_ENV_STATE][0].reshape(8, 2)
    return {"reset_to_state": reset_state(observations[OBS_STATE][0], keypoints)}
