"""What every task of this package shares as a LeRobot environment configuration."""

from dataclasses import dataclass
from functools import partial

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end

from lerobot_swr.envs.task import Task, task_of


@dataclass
class TaskEnvConfig(EnvConfig, Task):
    """A LeRobot environment configuration that is its own task.

    Subclasses register their Gymnasium id in the module that defines them, because the worker processes of
    `AsyncVectorEnv` import nothing else.
    """

    @property
    def package_name(self) -> str:
        """Module whose import registers the Gymnasium id."""
        return type(self).__module__

    @property
    def env_cfg(self) -> EnvConfig:
        """This configuration."""
        return self

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


@task_of.register
def _itself(env_cfg: TaskEnvConfig) -> Task:
    return env_cfg


def _make_one(config: TaskEnvConfig) -> gym.Env:
    # The configuration goes along so that a worker process, unpickling it, registers its Gymnasium id.
    return gym.make(config.gym_id, disable_env_checker=config.disable_env_checker, **config.gym_kwargs)
