"""Replay: recorded actions played open loop from the recorded start. Do the data and the simulator agree?"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import check_environment, load_demonstrations, simulated_names
from lerobot_swr.evaluation.checks.check import Check, Finding, Subject
from lerobot_swr.evaluation.metrics import Interval, success_interval
from lerobot_swr.evaluation.open_loop import Replay, play
from lerobot_swr.evaluation.replay_plots import plot_replay
from lerobot_swr.evaluation.time_offsets import (
    OFFSETS,
    ColumnGroup,
    Deviation,
    Names,
    best_offset,
    column_groups,
    describe,
    deviations,
)
from lerobot_swr.progress import Progress


@dataclass(frozen=True)
class ReplayResult:
    """What ``replay.json`` holds.

    Attributes:
        n_episodes: Number of replays.
        success_rate: Share of successes.
        success_interval: Its Wilson 95 % interval.
        behavior_match: Share of replays that show their recording's behaviour; None without a rule.
        best_offset: Shift in steps of the recording against the environment at which they agree best, 1 if
            the recording is one step behind; None if nothing moves.
        finding: The same as a sentence, with the columns that it is about.
        offsets: The shift of each group of columns, and its mean deviation at every shift.
        deviation: Feature to the distance of observed to recorded states at equal index, in its units.
        clipped_actions: Share of actions beyond the action space, where environments clip them.
        cut_short: Share of replays that the environment ended without success before their recording did.
        episodes: One record per replay.
    """

    n_episodes: int
    success_rate: float
    success_interval: Interval
    behavior_match: float | None
    best_offset: int | None
    finding: str
    offsets: list[ColumnGroup]
    deviation: dict[str, Deviation]
    clipped_actions: float
    cut_short: float
    episodes: list[dict[str, Any]]


def run_replay(
    meta: LeRobotDatasetMetadata,
    env_cfg: EnvConfig,
    rule: BehaviorRule | None,
    episodes: Sequence[int] | None = None,
    batch_size: int = 100,
    seed: int = 1000,
) -> tuple[ReplayResult, list[dict[str, np.ndarray]], list[dict[str, np.ndarray]]]:
    """Replay a dataset and compare what the environment shows with what was recorded.

    Args:
        meta: Metadata of the dataset.
        env_cfg: The environment.
        rule: Labels an episode; None leaves behaviours out.
        episodes: Those to replay; None takes all.
        batch_size: Largest number of environments that run at once.
        seed: Seeds environment k with ``seed + k``.

    Returns:
        The result, the recorded and the observed episodes in its order.

    Raises:
        ValueError: If the dataset's dimensions are not the environment's, or it cannot be put into a recorded
            start.
    """
    task = task_of(env_cfg)
    start_rule = task.start_rule()
    trajectories = load_demonstrations(meta)
    shapes = {key: column.shape[1:] for key, column in trajectories.columns.items()}
    check_environment(env_cfg, shapes, {}, "the dataset")
    chosen = list(range(len(trajectories)) if episodes is None else episodes)
    recorded = [trajectories.episode(i) for i in chosen]
    replays: list[Replay] = []
    with Progress(total=sum(len(one[ACTION]) for one in recorded), desc="replay", unit="step") as progress:
        while len(replays) < len(recorded):
            batch = recorded[len(replays) : len(replays) + batch_size]
            env = task.create_rollout_env(len(batch))
            try:
                starts = [start_rule(one) for one in batch]
                replays += play(env, batch, starts, seed + len(replays), progress)
                space = env.single_action_space
            finally:
                env.close()
    names = {key: value for key, value in simulated_names(meta).items() if key in trajectories.columns}
    result = evaluate_replays(chosen, recorded, replays, names, rule, space)
    return result, recorded, [replay.observations for replay in replays]


def evaluate_replays(
    episodes: Sequence[int],
    recorded: Sequence[Mapping[str, np.ndarray]],
    replays: Sequence[Replay],
    names: Names,
    rule: BehaviorRule | None,
    action_space: gym.Space,
) -> ReplayResult:
    """Compare replays with their recordings.

    Args:
        episodes: Their numbers in the dataset.
        recorded: Observations and actions.
        replays: In the same order.
        names: `dimension_names` of the recorded features; those that the environment shows are compared.
        rule: Labels an episode; None leaves behaviours out.
        action_space: Of one environment.
    """
    observed = [replay.observations for replay in replays]
    shared = {key: columns for key, columns in names.items() if key in observed[0]}
    groups = column_groups(recorded, observed, shared)
    successes = [replay.success for replay in replays]
    rows: list[dict[str, Any]] = [
        {
            "episode": episode,
            "success": replay.success,
            "recorded": None if rule is None else rule(one),
            "shown": None if rule is None else rule(replay.observations),
            "recorded_length": len(one[ACTION]),
            "length": len(next(iter(replay.observations.values()))) - 1,
            "deviation": {
                key: value.mean for key, value in deviations([one], [replay.observations], shared).items()
            },
        }
        for episode, one, replay in zip(episodes, recorded, replays, strict=True)
    ]
    cut_short = [not row["success"] and row["length"] < row["recorded_length"] for row in rows]
    return ReplayResult(
        n_episodes=len(replays),
        success_rate=float(np.mean(successes)),
        success_interval=success_interval(successes),
        behavior_match=None
        if rule is None
        else float(np.mean([row["recorded"] == row["shown"] for row in rows])),
        best_offset=best_offset(groups),
        finding=describe(groups),
        offsets=groups,
        deviation=deviations(recorded, observed, shared),
        clipped_actions=_share_beyond(np.concatenate([one[ACTION] for one in recorded]), action_space),
        cut_short=float(np.mean(cut_short)),
        episodes=rows,
    )


def _share_beyond(actions: np.ndarray, space: gym.Space) -> float:
    """Share of the actions (F, A) beyond the limits of their space; 0 for one without limits."""
    if not isinstance(space, gym.spaces.Box):
        return 0.0
    rounding = 1e-6 * np.maximum(1.0, np.abs(actions))
    return float(((actions < space.low - rounding) | (actions > space.high + rounding)).any(axis=1).mean())


def format_replay(result: ReplayResult) -> str:
    """The figures, for the terminal."""
    bounds, match = result.success_interval, result.behavior_match
    shown = "-" if match is None else f"{match:.3f}"
    lines = [
        f"{'replays':<11} {result.n_episodes:>7}",
        f"{'success':<11} {result.success_rate:7.3f}  {bounds:.3f} Wilson 95 %",
        f"{'behaviour':<11} {shown:>7}  of the replays show that of their recording",
    ]
    if result.clipped_actions:
        lines.append(
            f"{'clipped':<11} {result.clipped_actions:7.3f}  of the actions: beyond the action space"
        )
    if result.cut_short:
        lines.append(
            f"{'cut short':<11} {result.cut_short:7.3f}  ended without success before their recording"
        )
    lines.append(f"{'deviation at equal index':<44} {'mean':>10} {'largest':>10}")
    for feature, deviation in result.deviation.items():
        lines.append(f"{feature:<44} {deviation.mean:10.3g} {deviation.largest:10.3g}")
    heads = "".join(f"{offset:>10d}" for offset in OFFSETS)
    lines.append(f"{'mean deviation at an offset of':<44} {heads}")
    for group in result.offsets:
        if group.deviation_by_offset is not None:
            values = "".join(f"{value:10.3g}" for value in group.deviation_by_offset.values())
            lines.append(f"{_shorten(group):<44} {values}")
    return "\n".join([*lines, result.finding])


def summarize(result: ReplayResult) -> str:
    """What the check found, in two lines."""
    n, rate = result.n_episodes, result.success_rate
    match = "" if result.behavior_match is None else f", {round(result.behavior_match * n)} as recorded"
    deviation = ", ".join(f"{key} {value.mean:.2g}" for key, value in result.deviation.items())
    return f"replayed: {round(rate * n)} of {n} succeed{match}; mean deviation: {deviation}\n{result.finding}"


def _shorten(group: ColumnGroup, width: int = 44) -> str:
    text = f"{group.feature}: {', '.join(group.columns)}"
    return text if len(text) <= width else f"{text[: width - 1]}…"


@Check.register_subclass("replay")
@dataclass
class ReplayCheck(Check):
    """Play every episode's recorded actions from its recorded start: do data and environment agree?"""

    file = "replay"
    heeds = frozenset({"batch_size", "behavior_rule", "dataset.episodes"})
    actor = "none"
    needs_rule = False

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """See `run_replay`."""
        assert subject.env is not None
        task, options = task_of(subject.env), subject.rollouts
        result, recorded, observed = run_replay(
            subject.dataset.metadata(),
            subject.env,
            subject.rule,
            subject.dataset.episodes,
            options.batch_size,
            options.seed,
        )
        succeeded = [row["success"] for row in result.episodes]
        heading = f"replay of {subject.title}: {result.finding}"
        return Finding(
            result,
            format_replay(result),
            lambda path: plot_replay(path, succeeded, result.offsets, recorded, observed, task, heading),
        )
