"""Robustness: the same policy in its environment and in perturbed ones, each style equally often."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lerobot.envs import EnvConfig

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.behavior_evaluation import BehaviorResult, evaluate_behaviors, steps_to_end
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.checks.check import ROLLOUTS, Check, Finding, Subject
from lerobot_swr.evaluation.metrics import Interval
from lerobot_swr.evaluation.rollouts import allowed_episodes, run_rollouts
from lerobot_swr.trajectories import Trajectories


@dataclass(frozen=True)
class RobustnessCell:
    """A policy under one perturbation; the figures are those of `BehaviorResult`.

    Attributes:
        perturbation: Its name.
        env: The options of the environment that it sets.
    """

    perturbation: str
    env: dict[str, Any]
    n_episodes: int
    success_rate: float
    success_interval: Interval
    style_match: float | None
    style_match_interval: Interval | None
    length_error: float | None
    length_error_interval: Interval | None
    l1: float
    l1_floor: float
    l1_floor_band: Interval

    @classmethod
    def of(cls, perturbation: str, env: dict[str, Any], result: BehaviorResult) -> "RobustnessCell":
        """The figures of an evaluation that matter here."""
        return cls(
            perturbation,
            env,
            result.n_episodes,
            result.success_rate,
            result.success_interval,
            result.style_fidelity,
            result.style_fidelity_interval,
            result.length_error,
            result.length_error_interval,
            result.l1,
            result.l1_floor,
            result.l1_floor_band,
        )


@dataclass(frozen=True)
class RobustnessResult:
    """What ``robustness.json`` holds.

    Attributes:
        style_sampling: How styles were drawn; None without styles.
        cells: One per perturbation, the environment as it is first.
    """

    style_sampling: str | None
    cells: list[RobustnessCell]


def perturbed(env_cfg: EnvConfig) -> dict[str, dict[str, Any]]:
    """The perturbations of an environment: name to the options that it sets, none of them first.

    Raises:
        ValueError: If the environment has none.
    """
    options = task_of(env_cfg).perturbations()
    if not options:
        raise ValueError(
            f"env.type={env_cfg.type!r} names no perturbations; perturb it by its own flags and evaluate "
            "without --check.type=robustness"
        )
    return {"as it is": {}, **options}


def run_robustness(
    checkpoint: Checkpoint,
    trajectories: Trajectories,
    env_cfg: EnvConfig,
    rule: BehaviorRule,
    n_episodes: int,
    batch_size: int,
    seed: int,
    only: Sequence[str] | None = None,
    reference_episodes: Sequence[int] | None = None,
    after_each: Callable[[RobustnessResult], None] = lambda result: None,
) -> RobustnessResult:
    """Roll a policy out under every perturbation of its environment.

    Rollout k uses the same seed under every perturbation.

    Args:
        checkpoint: The policy.
        trajectories: Its demonstrations.
        env_cfg: The environment; its own options hold where a perturbation does not set them.
        rule: Labels an episode.
        n_episodes: Rollouts per perturbation.
        batch_size: Largest number of environments that run at once.
        seed: Seeds the drawing of styles and the environments.
        only: Names of the perturbations; None takes all.
        reference_episodes: The demonstrations to compare histograms with; None takes all.
        after_each: Called after each perturbation with all results up to then.

    Raises:
        ValueError: If the environment has no perturbations.
    """
    demonstrated = [rule(episode) for episode in trajectories.episodes()]
    lengths = steps_to_end(env_cfg, trajectories)
    sampling = checkpoint.policy.config.style_sampling if checkpoint.has_styles else None
    drawn = allowed_episodes(checkpoint, len(demonstrated))
    cells: list[RobustnessCell] = []
    for name, options in perturbed(env_cfg).items():
        if only is not None and name not in only:
            continue
        rollouts = run_rollouts(checkpoint, replace(env_cfg, **options), rule, n_episodes, batch_size, seed)
        result = evaluate_behaviors(
            rollouts, demonstrated, sampling, reference_episodes, drawn, lengths, env_cfg
        )
        cells.append(RobustnessCell.of(name, options, result))
        after_each(RobustnessResult(sampling, list(cells)))
    return RobustnessResult(sampling, cells)


def format_robustness(result: RobustnessResult) -> str:
    """A table for the terminal."""
    lines = [
        f"{'perturbation':<18} {'success':>22} {'style match':>22} {'length error':>20} {'L1 (floor)':>14}"
    ]
    for cell in result.cells:
        figures = [
            _with_interval(cell.success_rate, cell.success_interval, 2),
            _with_interval(cell.style_match, cell.style_match_interval, 2),
            _with_interval(cell.length_error, cell.length_error_interval, 1),
        ]
        l1 = f"{cell.l1:.2f} ({cell.l1_floor:.2f})"
        lines.append(f"{cell.perturbation:<18} {figures[0]:>22} {figures[1]:>22} {figures[2]:>20} {l1:>14}")
    n = result.cells[0].n_episodes if result.cells else 0
    lines.append(f"{n} rollouts each; Wilson 95 %, bootstrap 95 % of the median length error in steps")
    return "\n".join(lines)


def _with_interval(value: float | None, interval: Interval | None, digits: int) -> str:
    if value is None or interval is None:
        return "-"
    return f"{value:.{digits}f} {interval:.{digits}f}"


@Check.register_subclass("robustness")
@dataclass
class RobustnessCheck(Check):
    """Roll out under every perturbation of the environment, with each style equally often."""

    file = "robustness"
    heeds = ROLLOUTS - {"recorded_starts"} | {"behavior_rule", "dataset.episodes"}
    style_sampling = "stratified"

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """See `run_robustness`; the results are kept after each perturbation."""
        assert subject.actor is not None
        assert subject.env is not None
        assert subject.rule is not None
        options = subject.rollouts
        result = run_robustness(
            subject.actor,
            subject.trajectories,
            subject.env,
            subject.rule,
            options.n_episodes,
            options.batch_size,
            options.seed,
            reference_episodes=subject.dataset.episodes,
            after_each=keep,
        )
        return Finding(result, format_robustness(result))
