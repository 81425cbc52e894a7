"""Plays recorded actions in an environment, open loop, from the recorded start or another one."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION
from tqdm import tqdm

from lerobot_swr.evaluation.rollouts import StateRecorder


@dataclass(frozen=True)
class Replay:
    """One episode, played again.

    Attributes:
        observations: LeRobot feature name to (L + 1, d), the last state included.
        success: Whether the environment called it a success.
    """

    observations: dict[str, np.ndarray]
    success: bool


def play(
    env: gym.vector.VectorEnv,
    recorded: Sequence[Mapping[str, np.ndarray]],
    starts: Sequence[Mapping[str, Any]] | None,
    seed: int,
    progress: tqdm | None = None,
) -> list[Replay]:
    """Play recorded actions open loop, one episode in each sub-environment.

    Args:
        env: A vector environment that resets single sub-environments (Gymnasium's ``reset_mask``).
        recorded: One episode per sub-environment, with its actions.
        starts: Options of `reset` for each sub-environment, see `Task.start_rule`; None lets it draw its own.
        seed: Of the first sub-environment, the others count on.
        progress: Counts the steps.
    """
    recorder, n = StateRecorder(env), env.num_envs
    seeds = list(range(seed, seed + n))
    recorder.reset(seed=seeds, options={NEW_ROLLOUT_OPTION: True})
    for i, start in enumerate(starts or ()):
        options = {**start, NEW_ROLLOUT_OPTION: True, "reset_mask": np.arange(n) == i}
        recorder.reset(seed=seeds, options=options)
    actions = [episode[ACTION] for episode in recorded]
    lengths = np.array([len(own) for own in actions])
    success, ended = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for t in range(lengths.max()):
        playing = ~ended & (t < lengths)
        if not playing.any():
            break
        _, _, terminated, truncated, info = recorder.step(
            np.stack([own[min(t, len(own) - 1)] for own in actions])
        )
        success |= playing & _is_success(info, n)
        ended |= terminated | truncated
        if progress is not None:
            progress.update(int(playing.sum()) + int((lengths - t - 1)[playing & ended].sum()))
    shown = recorder.episodes()
    cut = [
        {key: value[: length + 1] for key, value in one.items()}
        for one, length in zip(shown, lengths, strict=True)
    ]
    return [Replay(*pair) for pair in zip(cut, success.tolist(), strict=True)]


def _is_success(info: Mapping[str, Any], n: int) -> np.ndarray:
    """(n,) bool: what Gymnasium's vector environments tell of success, of episodes that just ended, too."""
    told = [info.get("is_success"), info.get("final_info", {}).get("is_success")]
    return np.logical_or.reduce(
        [np.asarray(one, dtype=bool) for one in told if one is not None] or [np.zeros(n, bool)]
    )
