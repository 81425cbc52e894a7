"""What evaluations ask of an environment: this package's tasks answer themselves, others through an adapter.

An adapter is a small class, registered for the type of another package's configuration::

    @task_of.register(SomeEnvConfig)
    class SomeTask(Task):
        def start_rule(self) -> StartRule:
            return lambda observations: {"reset_to_state": observations["observation.state"][0]}
"""

from collections.abc import Callable, Mapping
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from lerobot.envs import EnvConfig, make_env
from lerobot.utils.constants import OBS_STATE

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.pointer import PlanePointer, Pointer

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # half a second, for pictures alone

StartRule = Callable[[Mapping[str, np.ndarray]], dict[str, Any]]
"""Maps an episode's observations to the options of `reset` that put the environment into its first state."""


class MissingRuleError(ValueError):
    """An environment has no rule of its own for what is asked."""


class Task:
    """An environment as evaluations see it; the answers here are those about an unknown one.

    Attributes:
        env_cfg: The environment's configuration.
    """

    def __init__(self, env_cfg: EnvConfig):
        self._env_cfg = env_cfg

    @property
    def env_cfg(self) -> EnvConfig:
        """The environment's configuration."""
        return self._env_cfg

    def behavior_rule(self) -> BehaviorRule:
        """The pure rule that labels an episode from its states.

        Raises:
            MissingRuleError: If the environment has none.
        """
        raise MissingRuleError(
            f"env.type={self.env_cfg.type!r} has no behaviour rule of its own: name one with "
            "--behavior_rule=module:function, or find one: lerobot-swr-behaviors"
        )

    def start_rule(self) -> StartRule:
        """How the environment is put into the start of a recorded episode.

        Raises:
            MissingRuleError: If it cannot be.
        """
        raise MissingRuleError(
            f"env.type={self.env_cfg.type!r} cannot be put into a recorded start: no start rule is "
            "registered for it (lerobot_swr.envs.task)"
        )

    @property
    def draws_scenes(self) -> bool:
        """Whether every episode has a scene of its own (object poses, goal), drawn from its seed."""
        return False

    def plot_path(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """(T, 2) path of an episode, as pictures draw it: by default the first two state dimensions."""
        return observations[OBS_STATE][:, :2]

    def steps_to_end(self, observations: Mapping[str, np.ndarray]) -> int:
        """Actions after which the environment would have ended a demonstration; by default all of them.

        Demonstrations may go on recording where an environment ends the episode.
        """
        return len(observations[OBS_STATE])

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

    @property
    def rate_hz(self) -> float:
        """Steps per second of the real thing."""
        return float(self.env_cfg.fps)

    def live(self) -> EnvConfig:
        """The configuration whose pictures can be watched at that rate; by default as it is."""
        return self.env_cfg

    def pointer(self, env: gym.Env) -> Pointer:
        """How a person's pointer in the picture acts; by default as the environment's metadata say.

        Args:
            env: An environment of this configuration.

        Raises:
            MissingRuleError: If the environment does not say so.
        """
        said = env.metadata.get("pointer")
        if said is None:
            raise MissingRuleError(
                f"env.type={self.env_cfg.type!r} does not say how a pointer acts in it: give the "
                "environment's class metadata['pointer'], or register a task with a pointer "
                "(lerobot_swr.envs.pointer)"
            )
        return PlanePointer.of_metadata(said)

    def draw_scene(self, axes: "Axes") -> None:
        """Draw what does not move (walls, obstacles) behind the paths; by default nothing."""

    def create_rollout_env(self, n_envs: int) -> gym.vector.VectorEnv:
        """The fastest vector environment of this task in this process.

        Raises:
            ValueError: If the configuration stands for several tasks.
        """
        suites = make_env(self.env_cfg, n_envs=n_envs, use_async_envs=False)
        envs = [env for tasks in suites.values() for env in tasks.values()]
        if len(envs) != 1:
            raise ValueError(f"env.type={self.env_cfg.type!r}: {len(envs)} tasks; choose one with --env.task")
        return envs[0]


@singledispatch
def task_of(env_cfg: EnvConfig) -> Task:
    """The task of a LeRobot environment configuration, by its type."""
    return Task(env_cfg)
