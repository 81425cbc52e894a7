"""What every task of this package shares as a LeRobot environment configuration."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from matplotlib.axes import Axes

from lerobot_swr.behaviors import BehaviorRule


@dataclass
class TaskEnvConfig(EnvConfig):
    """A LeRobot environment that also knows which behaviour an episode shows.

    Subclasses register their Gymnasium id in the module that defines them, because the worker processes of
    `AsyncVectorEnv` import nothing else.
    """

    @property
    def package_name(self) -> str:
        """Module whose import registers the Gymnasium id."""
        return type(self).__module__

    @abc.abstractmethod
    def behavior_rule(self) -> BehaviorRule:
        """The pure rule that labels an episode of this task from its states."""

    @property
    def draws_scenes(self) -> bool:
        """Whether every episode has a scene of its own (object poses, goal), drawn from its seed."""
        return False

    def plot_path(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """(T, 2) path of an episode, as pictures draw it: by default the first two state dimensions."""
        return observations["observation.state"][:, :2]

    def steps_to_end(self, observations: Mapping[str, np.ndarray]) -> int:
        """Actions after which the environment would have ended a demonstration; by default all of them.

        Demonstrations may go on recording where an environment ends the episode.
        """
        return len(observations["observation.state"])

    def expected_behavior(self, requested: str, observations: Mapping[str, np.ndarray]) -> str:
        """What an episode has to show of a requested behaviour, given where it started.

        Args:
            requested: Label of a demonstration.
            observations: The episode's.
        """
        return requested

    def perturbations(self) -> dict[str, dict[str, Any]]:
        """Ways of making the task harder, for robustness evaluations: name to the options that it sets."""
        return {}

    def draw_scene(self, axes: Axes) -> None:
        """Draw what does not move (walls, obstacles) behind the paths; by default nothing."""

    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, gym.vector.VectorEnv]]:
        """LeRobot's vector environment for this task, whose finished episodes keep their last observation.

        Unlike LeRobot's default, a finished sub-environment is frozen instead of being reset at once: its
        last state is needed to label the behaviour, and it costs nothing while slower episodes go on.
        """
        env_fns = [freeze_after_episode_end(partial(_make_one, self)) for _ in range(n_envs)]
        if use_async_envs and n_envs > 1:
            vector_env: gym.vector.VectorEnv = AsyncVectorEnv(
                env_fns, autoreset_mode=AutoresetMode.SAME_STEP, context="forkserver"
            )
        else:
            vector_env = SyncVectorEnv(env_fns, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: vector_env}}

    def create_rollout_env(self, n_envs: int) -> gym.vector.VectorEnv:
        """The fastest vector environment of this task in this process, for behaviour evaluation."""
        return self.create_envs(n_envs)[self.type][0]


def _make_one(config: TaskEnvConfig) -> gym.Env:
    # The configuration goes along so that a worker process, unpickling it, registers its Gymnasium id.
    return gym.make(config.gym_id, disable_env_checker=config.disable_env_checker, **config.gym_kwargs)
