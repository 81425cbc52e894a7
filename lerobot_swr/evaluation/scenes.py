"""Own and new scenes: does a policy look where things are, or does its style remember where they were?"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from lerobot.envs import EnvConfig
from lerobot.utils.random_utils import set_seed

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.task import Task, task_of
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.metrics import Interval, success_interval
from lerobot_swr.evaluation.open_loop import Replay, play
from lerobot_swr.evaluation.rollouts import Rollout, run_rollouts
from lerobot_swr.styles.drawing import StyleDrawing, check_style_sampling
from lerobot_swr.styles.request import StyleRequest
from lerobot_swr.trajectories import Trajectories

SceneKind = Literal["own", "new"]


@dataclass(frozen=True)
class SceneRollouts:
    """Rollouts, and what is held against them.

    Attributes:
        rollouts: Of the policy.
        episodes: The demonstration that belongs to each: whose style it used, or of a policy without styles
            one that is drawn beside it.
        replays: The actions of these demonstrations, played blindly in the scenes of the rollouts.
    """

    rollouts: list[Rollout]
    episodes: list[int]
    replays: list[Replay]


@dataclass(frozen=True)
class SceneResult:
    """What ``scenes`` of ``behaviors.json`` holds.

    Attributes:
        kind: ``own``: every rollout has the recorded scene of its demonstration; ``new``: one that nobody
            demonstrated.
        success_rate: Share of successes.
        success_interval: Its Wilson 95 % interval.
        fidelity: Share of rollouts with the behaviour of their demonstration; of a policy without styles that
            of one drawn at random, so by chance.
        fidelity_interval: Its Wilson 95 % interval.
        replay_success_rate: The same of the demonstrations' actions, played blindly in the same scenes.
        replay_success_interval: Its Wilson 95 % interval.
        replay_fidelity: The same of the demonstrations' actions.
        replay_fidelity_interval: Its Wilson 95 % interval.
    """

    kind: SceneKind
    success_rate: float
    success_interval: Interval
    fidelity: float
    fidelity_interval: Interval
    replay_success_rate: float
    replay_success_interval: Interval
    replay_fidelity: float
    replay_fidelity_interval: Interval


def check_scenes(kind: str, env_cfg: EnvConfig) -> SceneKind:
    """The kind of scenes of that name, of an environment that has scenes.

    Raises:
        ValueError: Naming the value, or the environment.
    """
    found: SceneKind | None = next((known for known in get_args(SceneKind) if known == kind), None)
    if found is None:
        raise ValueError(f"scenes={kind!r}: expected 'own' or 'new'")
    task = task_of(env_cfg)
    if not task.draws_scenes:
        raise ValueError(
            f"scenes={kind!r}: every episode of env.type={env_cfg.type!r}, env.task={env_cfg.task!r} has the "
            "same scene; leave it out, or take a task that draws scenes (maze2d: scenes, scenes_large; d3il: "
            "aligning)"
        )
    task.start_rule()  # refuses environments that have none
    return found


def run_in_scenes(
    checkpoint: Checkpoint,
    trajectories: Trajectories,
    env_cfg: EnvConfig,
    rule: BehaviorRule,
    kind: SceneKind,
    n_episodes: int,
    batch_size: int,
    seed: int,
    episodes: Sequence[int] | None = None,
) -> SceneRollouts:
    """Roll a policy out in scenes of one kind, and play demonstrations blindly in the same scenes.

    Args:
        checkpoint: The policy.
        trajectories: The demonstrations, with their actions.
        env_cfg: The environment.
        rule: Labels an episode.
        kind: Of the scenes.
        n_episodes: Number of rollouts.
        batch_size: Largest number of environments that run at once.
        seed: Seeds the drawing of styles and demonstrations; new scene k has the seed ``seed + k``.
        episodes: The demonstrations of a policy without styles; None takes all.
    """
    start_rule = task_of(env_cfg).start_rule()
    own = _demonstrations(checkpoint, len(trajectories), n_episodes, seed, episodes)
    if kind == "own":
        starts = [start_rule(trajectories.episode(i)) for i in own]
        styles = checkpoint.policy.styles if checkpoint.has_styles else None
        with nullcontext() if styles is None else styles.requested(StyleRequest(own)):
            rollouts = run_rollouts(checkpoint, env_cfg, rule, n_episodes, batch_size, seed, starts=starts)
    else:
        starts = None
        rollouts = run_rollouts(checkpoint, env_cfg, rule, n_episodes, batch_size, seed)
        used = [rollout.style_episode for rollout in rollouts]
        own = [
            other if style is None or style >= len(trajectories) else style
            for style, other in zip(used, own, strict=True)
        ]
    replays = replay_blindly(trajectories, own, env_cfg, starts, batch_size, seed)
    return SceneRollouts(rollouts, own, replays)


def replay_blindly(
    trajectories: Trajectories,
    episodes: Sequence[int],
    env_cfg: EnvConfig,
    starts: Sequence[Mapping[str, Any]] | None,
    batch_size: int,
    seed: int,
) -> list[Replay]:
    """Play demonstrations' actions open loop, each in a scene.

    Args:
        trajectories: The demonstrations.
        episodes: Which, one for each scene.
        env_cfg: The environment.
        starts: Options of `reset` for each scene; None draws scene k from ``seed + k``.
        batch_size: Largest number of environments that run at once.
        seed: See `starts`.
    """
    replays: list[Replay] = []
    while len(replays) < len(episodes):
        batch = slice(len(replays), min(len(replays) + batch_size, len(episodes)))
        recorded = [trajectories.episode(i) for i in episodes[batch]]
        env = task_of(env_cfg).create_rollout_env(len(recorded))
        try:
            replays += play(env, recorded, None if starts is None else starts[batch], seed + batch.start)
        finally:
            env.close()
    return replays


def evaluate_scenes(
    found: SceneRollouts, kind: SceneKind, demonstrated: Sequence[str], rule: BehaviorRule, task: Task
) -> SceneResult:
    """The figures of rollouts and of blind replays beside them.

    Args:
        found: Both.
        kind: Of the scenes.
        demonstrated: The label of every demonstration.
        rule: Labels an episode.
        task: The environment as evaluations see it.
    """
    matches, replayed = scene_matches(found, demonstrated, rule, task)
    succeeded = [rollout.success for rollout in found.rollouts]
    replay_succeeded = [replay.success for replay in found.replays]
    return SceneResult(
        kind=kind,
        success_rate=float(np.mean(succeeded)),
        success_interval=success_interval(succeeded),
        fidelity=float(np.mean(matches)),
        fidelity_interval=success_interval(matches),
        replay_success_rate=float(np.mean(replay_succeeded)),
        replay_success_interval=success_interval(replay_succeeded),
        replay_fidelity=float(np.mean(replayed)),
        replay_fidelity_interval=success_interval(replayed),
    )


def scene_matches(
    found: SceneRollouts, demonstrated: Sequence[str], rule: BehaviorRule, task: Task
) -> tuple[list[bool], list[bool]]:
    """Whether each rollout, and each blind replay, shows the behaviour of its demonstration."""
    wanted = [
        task.expected_behavior(demonstrated[i], rollout.observations)
        for i, rollout in zip(found.episodes, found.rollouts, strict=True)
    ]
    return (
        [rollout.behavior == label for rollout, label in zip(found.rollouts, wanted, strict=True)],
        [rule(replay.observations) == label for replay, label in zip(found.replays, wanted, strict=True)],
    )


def format_scenes(result: SceneResult) -> str:
    """The figures, for the terminal."""
    which = "the demonstrations' own" if result.kind == "own" else "new ones"
    rows = (
        ("success", result.success_rate, result.success_interval),
        ("fidelity", result.fidelity, result.fidelity_interval),
        ("blind success", result.replay_success_rate, result.replay_success_interval),
        ("blind fidelity", result.replay_fidelity, result.replay_fidelity_interval),
    )
    lines = [f"scenes: {which}; blind: the demonstrations' actions, played open loop in the same scenes"]
    return "\n".join(
        [*lines, *(f"{name:<15} {value:7.3f}  {bounds:.3f} Wilson 95 %" for name, value, bounds in rows)]
    )


def _demonstrations(
    checkpoint: Checkpoint, n_demonstrations: int, count: int, seed: int, episodes: Sequence[int] | None
) -> list[int]:
    """The demonstration of each rollout, as the policy's way of sampling draws styles."""
    chosen = list(range(n_demonstrations) if episodes is None else episodes)
    sampling = "stratified"
    if checkpoint.has_styles:
        chosen = [i for i in checkpoint.policy.styles.allowed().tolist() if i < n_demonstrations]
        sampling = checkpoint.policy.config.style_sampling
    if sampling not in ("uniform", "fixed"):
        sampling = "stratified"  # also for ways that draw by what is seen: here the scene follows the style
    set_seed(seed)
    return StyleDrawing(check_style_sampling(sampling)).draw(torch.tensor(chosen), count).tolist()
