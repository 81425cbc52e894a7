"""Rollouts of any LeRobot policy, with the states that behaviour rules need."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.envs import EnvConfig, make_env_pre_post_processors, preprocess_observation
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.random_utils import set_seed

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.observed import as_simulated
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.progress import without_bars_in_logs
from lerobot_swr.styles.drawing import check_style_sampling
from lerobot_swr.styles.request import BLENDED
from lerobot_swr.trajectories import Trajectories


@dataclass(kw_only=True)
class RolloutOptions:
    """How many rollouts, and how."""

    # Number of rollouts.
    n_episodes: int = 100
    # Largest number of environments that run at once.
    batch_size: int = 100
    # How styles are drawn: uniform (the paper), stratified (each style once before any again) or fixed; null
    # keeps the checkpoint's setting.
    style_sampling: str | None = None
    # Begin rollout k where the k-th demonstration (of dataset.episodes) began, not where the environment
    # draws; with style_sampling fixed it has that demonstration's style, too.
    recorded_starts: bool = False
    # own: each rollout begins in the recorded scene of the demonstration whose style it uses; new: in a scene
    # that nobody demonstrated. Blind replay of the demonstrations is measured beside. Of tasks whose episodes
    # have scenes of their own.
    scenes: str | None = None
    # Seeds the drawing of styles and the environments.
    seed: int = 1000

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        if self.style_sampling is not None:
            check_style_sampling(self.style_sampling)
        for key in ("n_episodes", "batch_size"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected at least 1")


@dataclass(frozen=True)
class Rollout:
    """One episode of a policy in an environment.

    Attributes:
        observations: LeRobot feature name to (T + 1, d), the last state included.
        behavior: Label that the rule gave.
        success: Whether the environment called it a success.
        length: T, number of actions.
        max_reward: The largest reward of an action.
        style_episode: The demonstration whose style was used; None for a policy without styles or a blend.
    """

    observations: dict[str, np.ndarray]
    behavior: str
    success: bool
    length: int
    max_reward: float
    style_episode: int | None


class StateRecorder(gym.vector.VectorWrapper):
    """Keeps every sub-environment's low-dimensional observations up to the end of its first episode."""

    def reset(self, **kwargs: Any) -> tuple[dict, dict]:  # type: ignore[override]
        """Reset all sub-environments and start recording."""
        observations, info = self.env.reset(**kwargs)
        self._done = np.zeros(self.num_envs, dtype=bool)
        self._recorded: list[list[dict[str, np.ndarray]]] = [[row] for row in self._rows(observations)]
        return observations, info

    def step(self, actions: np.ndarray) -> tuple[dict, np.ndarray, np.ndarray, np.ndarray, dict]:  # type: ignore[override]
        """Step all sub-environments and record those that are under way."""
        observations, reward, terminated, truncated, info = self.env.step(actions)
        final_observations = info.get("final_obs")
        for i, row in enumerate(self._rows(observations)):
            if self._done[i]:
                continue
            if final_observations is not None and final_observations[i] is not None:
                row = _low_dimensional(final_observations[i])  # the row itself is the next episode's already
            self._recorded[i].append(row)
        self._done |= terminated | truncated
        return observations, reward, terminated, truncated, info

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Ask every sub-environment, as LeRobot's rollout does."""
        return self.env.call(name, *args, **kwargs)  # type: ignore[attr-defined]

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every sub-environment."""
        return self.env.get_attr(name)  # type: ignore[attr-defined]

    def episodes(self) -> list[dict[str, np.ndarray]]:
        """States of each sub-environment's first episode, by LeRobot's feature names, (T + 1, d).

        They are the simulator's, also where a policy sees pictures instead.
        """
        stacked = [{key: np.stack([row[key] for row in rows]) for key in rows[0]} for rows in self._recorded]
        named = [{k: v.numpy() for k, v in preprocess_observation(episode).items()} for episode in stacked]
        return list(map(as_simulated, named))

    def _rows(self, observations: dict) -> list[dict[str, np.ndarray]]:
        low_dimensional = _low_dimensional(observations)
        return [{key: value[i] for key, value in low_dimensional.items()} for i in range(self.num_envs)]


class StartedRecorder(StateRecorder):
    """Lets every sub-environment begin in a given state.

    Args:
        env: A vector environment that resets single sub-environments (Gymnasium's ``reset_mask``).
        starts: Options of `reset` for each sub-environment, see `Task.start_rule`.
    """

    def __init__(self, env: gym.vector.VectorEnv, starts: Sequence[Mapping[str, Any]]):
        super().__init__(env)
        self._starts = starts

    def reset(self, **kwargs: Any) -> tuple[dict, dict]:  # type: ignore[override]
        """Reset all sub-environments, each into its start, and begin recording."""
        observations, info = super().reset(**kwargs)
        for i, start in enumerate(self._starts):
            mask = np.arange(self.num_envs) == i
            options = {**(kwargs.get("options") or {}), **start, "reset_mask": mask}
            observations, info = super().reset(**{**kwargs, "options": options})
        return observations, info


def _low_dimensional(observations: dict) -> dict[str, np.ndarray]:
    return {k: np.array(v) for k, v in observations.items() if k != "pixels" and isinstance(v, np.ndarray)}


def recorded_starts(
    env_cfg: EnvConfig,
    trajectories: Trajectories,
    options: RolloutOptions,
    episodes: Sequence[int] | None = None,
) -> list[dict[str, Any]] | None:
    """Where rollouts begin if they begin where demonstrations did, see `run_rollouts`; None otherwise.

    Args:
        env_cfg: The environment.
        trajectories: The demonstrations.
        options: Say whether, and how many.
        episodes: The demonstrations to take, one after the other and again from the first; None takes all.

    Raises:
        MissingRuleError: If the environment cannot be put into a recorded start.
    """
    if not options.recorded_starts:
        return None
    start_of = task_of(env_cfg).start_rule()
    chosen = range(len(trajectories)) if episodes is None else episodes
    return [start_of(trajectories.episode(chosen[k % len(chosen)])) for k in range(options.n_episodes)]


def allowed_episodes(checkpoint: Checkpoint, n_demonstrations: int) -> list[int] | None:
    """The demonstrations whose styles a style policy may draw; None without styles, or if none is theirs."""
    if not checkpoint.has_styles:
        return None
    allowed = checkpoint.policy.styles.allowed().tolist()
    return [episode for episode in allowed if episode < n_demonstrations] or None


def run_rollouts(
    checkpoint: Checkpoint,
    env_cfg: EnvConfig,
    rule: BehaviorRule,
    n_episodes: int,
    batch_size: int,
    seed: int,
    env_seeds: Sequence[int] | None = None,
    starts: Sequence[Mapping[str, Any]] | None = None,
) -> list[Rollout]:
    """Roll a policy out and label its behaviours.

    Args:
        checkpoint: The policy.
        env_cfg: The environment.
        rule: Labels an episode from its observations.
        n_episodes: Number of episodes.
        batch_size: Largest number of environments that run at once.
        seed: Seeds torch once and environment k with ``seed + k``.
        env_seeds: Seeds of the environments, one per episode, instead.
        starts: Options of `reset` for recorded starts, one per episode; None lets the environment draw.
    """
    env_seeds = range(seed, seed + n_episodes) if env_seeds is None else env_seeds
    set_seed(seed)
    if checkpoint.has_styles:
        checkpoint.policy.styles.restart()
    env_preprocessor, env_postprocessor = make_env_pre_post_processors(env_cfg, checkpoint.policy.config)
    rollouts: list[Rollout] = []
    while len(rollouts) < n_episodes:
        size = min(batch_size, n_episodes - len(rollouts))
        batch = slice(len(rollouts), len(rollouts) + size)
        env = task_of(env_cfg).create_rollout_env(size)
        env = StateRecorder(env) if starts is None else StartedRecorder(env, starts[batch])
        try:
            with without_bars_in_logs():
                outcome = rollout(
                    env,
                    checkpoint.policy,
                    env_preprocessor,
                    env_postprocessor,
                    checkpoint.preprocessor,
                    checkpoint.postprocessor,
                    seeds=list(env_seeds[batch]),
                )
            episodes = env.episodes()
        finally:
            env.close()
        styles = checkpoint.policy.styles.active.tolist() if checkpoint.has_styles else [None] * size
        for i, observations in enumerate(episodes):
            length = int(outcome["done"][i].int().argmax()) + 1
            states = {key: value[: length + 1] for key, value in observations.items()}
            success = bool(outcome["success"][i, :length].any())
            max_reward = float(outcome["reward"][i, :length].max())
            style = None if styles[i] in (None, BLENDED) else styles[i]
            rollouts.append(Rollout(states, rule(states), success, length, max_reward, style))
    return rollouts
