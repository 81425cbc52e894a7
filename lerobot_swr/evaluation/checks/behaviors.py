"""Behaviours: which ones does a policy show, and which were demonstrated?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from lerobot.envs import EnvConfig

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.behavior_evaluation import (
    BehaviorResult,
    evaluate_behaviors,
    format_result,
    steps_to_end,
)
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.checks.check import ROLLOUTS, Check, Finding, Subject
from lerobot_swr.evaluation.plots import plot_behaviors
from lerobot_swr.evaluation.rollouts import (
    RolloutOptions,
    allowed_episodes,
    recorded_starts,
    run_rollouts,
)
from lerobot_swr.evaluation.scenes import check_scenes, evaluate_scenes, run_in_scenes
from lerobot_swr.trajectories import Trajectories


@dataclass(frozen=True)
class Comparison:
    """A behaviour evaluation and what its pictures show.

    Attributes:
        result: The figures.
        demonstrations: Paths (T, 2) of the reference demonstrations and their labels.
        rollouts: Paths (T, 2) of the rollouts and their labels.
    """

    result: BehaviorResult
    demonstrations: list[tuple[np.ndarray, str]]
    rollouts: list[tuple[np.ndarray, str]]


def compare(
    checkpoint: Checkpoint,
    trajectories: Trajectories,
    env_cfg: EnvConfig,
    rule: BehaviorRule,
    options: RolloutOptions,
    reference_episodes: Sequence[int] | None = None,
) -> Comparison:
    """Roll a policy out and compare it with its demonstrations.

    Args:
        checkpoint: The policy.
        trajectories: The demonstrations.
        env_cfg: The environment.
        rule: Labels an episode from its observations.
        options: How many rollouts, and how; recorded starts are those of the reference episodes.
        reference_episodes: The demonstrations to compare with; None takes all.

    Raises:
        MissingRuleError: If the environment cannot be put into a recorded start.
    """
    task = task_of(env_cfg)
    chosen = range(len(trajectories)) if reference_episodes is None else reference_episodes
    starts = recorded_starts(env_cfg, trajectories, options, chosen)
    demonstrated = [rule(episode) for episode in trajectories.episodes()]
    how = options.n_episodes, options.batch_size, options.seed
    scenes = None
    if options.scenes is None:
        rollouts = run_rollouts(checkpoint, env_cfg, rule, *how, starts=starts)
    else:
        kind = check_scenes(options.scenes, env_cfg)
        found = run_in_scenes(checkpoint, trajectories, env_cfg, rule, kind, *how, reference_episodes)
        rollouts = found.rollouts
        scenes = evaluate_scenes(found, kind, demonstrated, rule, task)
    result = evaluate_behaviors(
        rollouts,
        demonstrated,
        checkpoint.policy.config.style_sampling if checkpoint.has_styles else None,
        reference_episodes,
        allowed_episodes(checkpoint, len(demonstrated)),
        steps_to_end(env_cfg, trajectories),
        env_cfg,
    )
    return Comparison(
        replace(result, scenes=scenes),
        [(task.plot_path(trajectories.episode(i)), demonstrated[i]) for i in chosen],
        [(task.plot_path(rollout.observations), rollout.behavior) for rollout in rollouts],
    )


@Check.register_subclass("behaviors")
@dataclass
class BehaviorsCheck(Check):
    """Compare the behaviours of rollouts with those of the demonstrations."""

    file = "behaviors"
    heeds = ROLLOUTS | {"scenes", "behavior_rule", "dataset.episodes"}

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """See `compare`."""
        env = subject.env
        assert subject.actor is not None
        assert env is not None
        assert subject.rule is not None
        comparison = compare(
            subject.actor,
            subject.trajectories,
            env,
            subject.rule,
            subject.rollouts,
            subject.dataset.episodes,
        )
        result = comparison.result
        heading = (
            f"{subject.title}: L1 {result.l1:.3f} (floor {result.l1_floor:.3f}), "
            f"success {result.success_rate:.2f}"
        )
        return Finding(
            result,
            format_result(result),
            lambda path: plot_behaviors(
                path,
                comparison.demonstrations,
                comparison.rollouts,
                result.reference_histogram,
                result.histogram,
                env,
                heading,
            ),
        )
