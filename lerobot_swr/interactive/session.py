"""One environment that a person or a policy acts in, step by step; no web, no clock."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from lerobot.envs import EnvConfig, make_env, make_env_pre_post_processors, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION, OBS_STR

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.demos.recipe import Demonstration
from lerobot_swr.envs.pointer import Command, Pointer
from lerobot_swr.envs.task import MissingRuleError, task_of
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.styles.request import Styles


@dataclass(frozen=True)
class Scene:
    """What there is to see after a step.

    Attributes:
        observations: LeRobot feature name to (d,), low-dimensional ones.
        steps: Actions taken in this episode.
        success: Whether the environment calls it a success.
        over: Whether the episode has ended.
        style: The demonstration whose style acts; None for a person, a blend or a policy without styles.
    """

    observations: Mapping[str, np.ndarray]
    steps: int
    success: bool
    over: bool
    style: int | None


class Session:
    """An environment, and a policy where there is one.

    Args:
        env_cfg: The environment's configuration; its pictures are those of `Task.live`.
        checkpoint: The policy; None leaves the acting to a person.
        seed: Of the environment's first episode; the others follow from it.
        rule: Labels episodes; None takes the environment's own rule, and where there is none, success.

    Attributes:
        task: What the environment says of itself.
        rule: Labels episodes; None where the environment has no rule.
        pointer: How a person acts; None where the environment does not say so.

    Raises:
        ValueError: If the configuration stands for several tasks, or nobody could act.
    """

    def __init__(
        self,
        env_cfg: EnvConfig,
        checkpoint: Checkpoint | None = None,
        seed: int = 0,
        rule: BehaviorRule | None = None,
    ):
        self.task = task_of(env_cfg)
        self._env = _single(self.task.live())
        self.rule = rule or _own_rule(env_cfg)
        self.pointer: Pointer | None = None
        try:
            self.pointer = self.task.pointer(self._env)
        except MissingRuleError:
            if checkpoint is None:
                raise
        self.checkpoint = checkpoint
        if checkpoint is not None:
            self._before, self._after = make_env_pre_post_processors(env_cfg, checkpoint.policy.config)
        self._observations: list[dict[str, np.ndarray]] = []
        self._actions: list[np.ndarray] = []
        self.scene = self.reset(seed=seed)

    @property
    def instruction(self) -> str:
        """The task string."""
        unwrapped = self._env.unwrapped
        return str(getattr(unwrapped, "task_description", "") or getattr(unwrapped, "task", ""))

    @property
    def shows_pictures(self) -> bool:
        """Whether pictures are among the observations."""
        return isinstance(self._raw, Mapping) and "pixels" in self._raw

    @property
    def action_dim(self) -> int:
        """A."""
        return int(np.prod(self._env.action_space.shape or ()))

    def reset(
        self, seed: int | None = None, styles: Styles = None, options: Mapping[str, Any] | None = None
    ) -> Scene:
        """Begin an episode.

        Args:
            seed: Of the environment; None goes on with its random numbers.
            styles: As in `steer`; None leaves in force what is.
            options: The environment's, for example those of a `StartRule`.
        """
        self._raw, info = self._env.reset(seed=seed, options={NEW_ROLLOUT_OPTION: True, **(options or {})})
        self._observations, self._actions = [_low_dimensional(self._raw)], []
        if self.checkpoint is not None:
            self.checkpoint.policy.reset()
        if styles is not None:
            self.steer(styles)
        return self._see(bool(info.get("is_success", False)), over=False)

    def step(self, action: np.ndarray | None = None) -> Scene:
        """Take an action (A,); None lets the policy act.

        Raises:
            RuntimeError: If the episode is over, or there is no policy.
        """
        if self.scene.over:
            raise RuntimeError("the episode is over: reset the session first")
        action = self._policy_action() if action is None else np.asarray(action, dtype=np.float32)
        self._raw, _, terminated, truncated, info = self._env.step(action)
        self._observations.append(_low_dimensional(self._raw))
        self._actions.append(action)
        return self._see(bool(info.get("is_success", False)), over=bool(terminated or truncated))

    def follow(self, command: Command) -> np.ndarray:
        """(A,) action of a person's hand in the present scene.

        Raises:
            MissingRuleError: If the environment does not say how a pointer acts.
        """
        return (self.pointer or self.task.pointer(self._env)).action(self.scene.observations, command)

    def steer(self, styles: Styles) -> None:
        """From the next step on act by these styles, see `StyleCookbook.request`.

        Raises:
            ValueError: If the policy has no styles, or not these.
        """
        if self.checkpoint is None or not self.checkpoint.has_styles:
            raise ValueError("there is no policy with styles to steer: give --policy.path=CHECKPOINT")
        self.checkpoint.policy.styles.request(styles)

    def behavior(self) -> str:
        """Label of the episode so far."""
        return self.rule(self.states()) if self.rule else ("success" if self.scene.success else "failure")

    def states(self) -> dict[str, np.ndarray]:
        """LeRobot feature name to the episode's observations (T + 1, d), the last included."""
        return _stacked(self._observations)

    def recording(self) -> Demonstration:
        """The episode so far, T + 1 frames: the last holds the state in which it ended and an idle action."""
        idle = self.follow(Command())
        actions = np.stack([*self._actions, idle]).astype(np.float32)
        states = {key: values.astype(np.float32) for key, values in self.states().items()}
        return Demonstration(states, actions)

    def path(self) -> np.ndarray:
        """(T + 1, 2) the tool's places in the picture, as shares of its sides."""
        if self.pointer is None:
            return np.zeros((0, 2))
        return self.pointer.project(self.states())

    def place(self) -> list[float] | None:
        """Where the tool is in the picture now, as shares of its sides."""
        if self.pointer is None:
            return None
        return self.pointer.project({k: v[None] for k, v in self.scene.observations.items()})[0].tolist()

    def picture(self) -> np.ndarray:
        """(h, w, 3) uint8."""
        return np.asarray(self._env.render())

    def close(self) -> None:
        """Free what the environment holds."""
        self._env.close()

    def _policy_action(self) -> np.ndarray:
        if self.checkpoint is None:
            raise RuntimeError("there is no policy: give an action")
        observation = self._before({**preprocess_observation(_batch(self._raw)), "task": [self.instruction]})
        with torch.inference_mode():
            action = self.checkpoint.policy.select_action(self.checkpoint.preprocessor(observation))
        action = self._after({ACTION: self.checkpoint.postprocessor(action)})[ACTION]
        return action[0].cpu().numpy().astype(np.float32)

    def _see(self, success: bool, over: bool) -> Scene:
        observations = {key: values[0] for key, values in _stacked(self._observations[-1:]).items()}
        self.scene = Scene(observations, len(self._actions), success, over, self._style())
        return self.scene

    def _style(self) -> int | None:
        if self.checkpoint is None or not self.checkpoint.has_styles:
            return None
        active = self.checkpoint.policy.styles.active
        return None if active is None or active[0] < 0 else int(active[0])


def _single(env_cfg: EnvConfig) -> gym.Env:
    suites = make_env(env_cfg, n_envs=1, use_async_envs=False)
    envs = [env for tasks in suites.values() for env in tasks.values()]
    if len(envs) != 1:
        raise ValueError(f"env.type={env_cfg.type!r}: {len(envs)} tasks; choose one with --env.task")
    return envs[0].envs[0]  # alone, it is not reset behind our back when an episode ends


def _own_rule(env_cfg: EnvConfig) -> BehaviorRule | None:
    try:
        return task_of(env_cfg).behavior_rule()
    except MissingRuleError:
        return None


def _low_dimensional(observation: Any) -> dict[str, np.ndarray]:
    observation = observation if isinstance(observation, Mapping) else {"agent_pos": observation}
    arrays = {key: value for key, value in observation.items() if key != "pixels"}
    return {key: np.array(value) for key, value in arrays.items() if isinstance(value, np.ndarray)}


def _batch(observation: Any) -> Any:
    if isinstance(observation, Mapping):
        return {key: _batch(value) for key, value in observation.items()}
    return np.asarray(observation)[None]


def _stacked(rows: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """LeRobot feature name to (T, d)."""
    columns = preprocess_observation({key: np.stack([row[key] for row in rows]) for key in rows[0]})
    return {key: value.numpy() for key, value in columns.items() if key.startswith(OBS_STR)}
