"""A vector environment that steps its sub-environments on all cores of one process."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate


class _SteppedAhead(gym.Wrapper):
    """Lets a thread take the next step early; `step` then hands over its result."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self._result: Future | None = None

    def step_ahead(self, pool: ThreadPoolExecutor, action: Any) -> None:
        self._result = pool.submit(self.env.step, action)

    def step(self, action: Any) -> Any:
        if self._result is None:
            return self.env.step(action)
        result, self._result = self._result, None
        return result.result()


class ThreadVectorEnv(SyncVectorEnv):
    """`SyncVectorEnv`, with the steps of its sub-environments taken by one thread per core.

    It behaves identically: everything but the steps themselves is `SyncVectorEnv`'s own code. It pays for
    environments that release Python's global lock while they step, as MuJoCo and numba do, and saves the
    worker processes and copies of `AsyncVectorEnv`.

    Args:
        env_fns: Make the sub-environments, whose steps must not share anything that changes.
        n_threads: By default one per core.
    """

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]], n_threads: int | None = None):
        def stepped_ahead(env_fn: Callable[[], gym.Env]) -> Callable[[], gym.Env]:
            return lambda: _SteppedAhead(env_fn())

        # In this mode every sub-environment steps at every call, so that steps can be taken ahead.
        super().__init__([stepped_ahead(fn) for fn in env_fns], autoreset_mode=AutoresetMode.SAME_STEP)
        self._pool = ThreadPoolExecutor(n_threads or os.cpu_count(), thread_name_prefix="env-step")

    def step(self, actions: Any) -> Any:
        """Step every sub-environment; see `SyncVectorEnv.step`."""
        for env, action in zip(self.envs, iterate(self.action_space, actions), strict=True):
            assert isinstance(env, _SteppedAhead)
            env.step_ahead(self._pool, action)
        return super().step(actions)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads and close the sub-environments."""
        self._pool.shutdown()
        super().close_extras(**kwargs)
