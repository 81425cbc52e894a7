"""Figures of a behaviour evaluation: rollouts beside demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.envs import EnvConfig

from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.metrics import (
    Histogram,
    Interval,
    coverage,
    histogram,
    l1_distance,
    l1_floor,
    l1_interval,
    mean_interval,
    median_interval,
    style_fidelity,
    success_entropy,
    success_interval,
)
from lerobot_swr.evaluation.rollouts import Rollout
from lerobot_swr.evaluation.scenes import SceneResult, format_scenes
from lerobot_swr.trajectories import Trajectories


@dataclass(frozen=True)
class BehaviorResult:
    """What ``behaviors.json`` holds.

    Attributes:
        style_sampling: How styles were drawn, ``uniform``, ``stratified`` or ``fixed``; None without styles.
        n_episodes: Number of rollouts.
        success_rate: Share of successes.
        success_interval: Its Wilson 95 % interval.
        max_reward: Mean over rollouts of an episode's largest reward; for tasks that reward partial success
            (PushT's usual score).
        max_reward_interval: Its bootstrap 95 % interval over rollouts.
        l1: L1 distance of the two histograms, 0 to 2.
        l1_interval: Its bootstrap 95 % interval over rollouts.
        l1_floor: L1 that a perfect reproducer of the demonstrations would score on average.
        l1_floor_band: The central 95 % of that.
        coverage: Share of the demonstrated behaviours that were shown.
        entropy: Of the successful rollouts' behaviours, in units of the log of their number in the dataset.
        style_fidelity: Share of rollouts with the behaviour of the demonstration whose style was used (in a
            maze: of its doors those ahead of the start).
        style_fidelity_interval: Its Wilson 95 % interval.
        length_error: Median difference in length of a rollout to the demonstration whose style was used, in
            steps, over successful rollouts with its behaviour.
        length_error_interval: Its bootstrap 95 % interval.
        histogram: Label to share of the rollouts.
        reference_histogram: Label to share of the demonstrations.
        episodes: One record per rollout.
        scenes: Own or new scenes, with blind replay beside the policy; None where it was not asked for.
    """

    style_sampling: str | None
    n_episodes: int
    success_rate: float
    success_interval: Interval
    max_reward: float
    max_reward_interval: Interval
    l1: float
    l1_interval: Interval
    l1_floor: float
    l1_floor_band: Interval
    coverage: float
    entropy: float
    style_fidelity: float | None
    style_fidelity_interval: Interval | None
    length_error: float | None
    length_error_interval: Interval | None
    histogram: Histogram
    reference_histogram: Histogram
    episodes: list[dict[str, Any]]
    scenes: SceneResult | None = None


def evaluate_behaviors(
    rollouts: Sequence[Rollout],
    demonstrated: Sequence[str],
    style_sampling: str | None,
    reference_episodes: Sequence[int] | None = None,
    drawn_episodes: Sequence[int] | None = None,
    demonstrated_lengths: Sequence[int] | None = None,
    env_cfg: EnvConfig | None = None,
) -> BehaviorResult:
    """Compare rollouts with demonstrations.

    Args:
        rollouts: Episodes of the policy.
        demonstrated: The label of every episode of the dataset; rollouts with a style added for an
            episode of another dataset are left out of the style fidelity.
        style_sampling: How styles were drawn; None for a policy without styles.
        reference_episodes: The episodes that make up the reference histogram; None takes all.
        drawn_episodes: The episodes whose styles may be drawn, for the floor; None takes the reference's.
        demonstrated_lengths: Steps of every episode of the dataset, for the length error; None leaves it out.
        env_cfg: Tells what a rollout has to show of a requested behaviour, given its start; None: all of it.
    """
    labels = [rollout.behavior for rollout in rollouts]
    successes = [rollout.success for rollout in rollouts]
    rewards = [rollout.max_reward for rollout in rollouts]
    chosen = range(len(demonstrated)) if reference_episodes is None else reference_episodes
    reference = [demonstrated[i] for i in chosen]
    reference_histogram = histogram(reference)
    floor = l1_floor(
        reference,
        len(rollouts),
        stratified=style_sampling in ("stratified", "fixed"),
        drawn_from=None if drawn_episodes is None else [demonstrated[i] for i in drawn_episodes],
    )
    styled = [r for r in rollouts if r.style_episode is not None and r.style_episode < len(demonstrated)]
    requested = [demonstrated[r.style_episode] for r in styled if r.style_episode is not None]
    if env_cfg is not None:
        task = task_of(env_cfg)
        requested = [
            task.expected_behavior(label, r.observations) for label, r in zip(requested, styled, strict=True)
        ]
    matches = [r.behavior == wanted for r, wanted in zip(styled, requested, strict=True)]
    length_errors = [
        abs(r.length - demonstrated_lengths[r.style_episode])
        for r, match in zip(styled, matches, strict=True)
        if demonstrated_lengths is not None and r.style_episode is not None and r.success and match
    ]
    return BehaviorResult(
        style_sampling=style_sampling,
        n_episodes=len(rollouts),
        success_rate=sum(successes) / len(successes),
        success_interval=success_interval(successes),
        max_reward=float(np.mean(rewards)),
        max_reward_interval=mean_interval(rewards),
        l1=l1_distance(histogram(labels), reference_histogram),
        l1_interval=l1_interval([labels], reference_histogram),
        l1_floor=floor.mean,
        l1_floor_band=floor.band,
        coverage=coverage(labels, reference_histogram),
        entropy=success_entropy(labels, successes, len(reference_histogram)),
        style_fidelity=style_fidelity([r.behavior for r in styled], requested) if styled else None,
        style_fidelity_interval=success_interval(matches) if styled else None,
        length_error=float(np.median(length_errors)) if length_errors else None,
        length_error_interval=median_interval(length_errors) if length_errors else None,
        histogram=histogram(labels),
        reference_histogram=reference_histogram,
        episodes=[
            {
                "behavior": rollout.behavior,
                "success": rollout.success,
                "length": rollout.length,
                "max_reward": rollout.max_reward,
                "style_episode": rollout.style_episode,
            }
            for rollout in rollouts
        ],
    )


def steps_to_end(env_cfg: EnvConfig, trajectories: Trajectories) -> list[int]:
    """Steps of every demonstration until the environment would have ended it."""
    task = task_of(env_cfg)
    return [task.steps_to_end(episode) for episode in trajectories.episodes()]


def format_result(result: BehaviorResult) -> str:
    """A table for the terminal."""
    fidelity = "-" if result.style_fidelity is None else f"{result.style_fidelity:.3f}"
    rows = [
        ("rollouts", f"{result.n_episodes}", f"styles drawn: {result.style_sampling or 'none'}"),
        ("success", f"{result.success_rate:.3f}", f"{result.success_interval:.3f} Wilson 95 %"),
        ("max reward", f"{result.max_reward:.3f}", f"{result.max_reward_interval:.3f} bootstrap 95 %"),
        ("L1", f"{result.l1:.3f}", f"{result.l1_interval:.3f} bootstrap 95 %"),
        ("L1 floor", f"{result.l1_floor:.3f}", f"{result.l1_floor_band:.3f} perfect reproducer, 95 %"),
        ("coverage", f"{result.coverage:.3f}", "share of demonstrated behaviours shown"),
        ("entropy", f"{result.entropy:.3f}", "of successes, in log(number of demonstrated behaviours)"),
        ("style fidelity", fidelity, "rollouts that show their style's demonstration's behaviour"),
    ]
    if result.length_error is not None and result.length_error_interval is not None:
        bounds = f"{result.length_error_interval:.3f}"
        rows.append(("length error", f"{result.length_error:.1f}", f"{bounds} bootstrap 95 %, median, steps"))
    lines = [f"{name:<15} {value:>7}  {note}" for name, value, note in rows]
    lines.append(f"{'behaviour':<24} {'demos':>6} {'rollouts':>8}")
    for label in {**result.reference_histogram, **result.histogram}:
        shares = result.reference_histogram.get(label, 0.0), result.histogram.get(label, 0.0)
        lines.append(f"{label or '(none)':<24} {shares[0]:6.3f} {shares[1]:8.3f}")
    if result.scenes is not None:
        lines.append(format_scenes(result.scenes))
    return "\n".join(lines)
