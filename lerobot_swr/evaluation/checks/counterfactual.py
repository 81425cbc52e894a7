"""Counterfactual check: from the same start, does each style lead to its demonstration's behaviour?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.envs import EnvConfig
from lerobot.utils.constants import OBS_STATE
from matplotlib.figure import Figure

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.checks.check import Check, Finding, Subject
from lerobot_swr.evaluation.metrics import Interval, histogram, style_fidelity, success_interval
from lerobot_swr.evaluation.plots import save_figure
from lerobot_swr.evaluation.rollouts import Rollout, run_rollouts
from lerobot_swr.styles.request import StyleRequest
from lerobot_swr.trajectories import Trajectories


@dataclass(frozen=True)
class CounterfactualResult:
    """What ``counterfactual.json`` holds.

    Attributes:
        n_episodes: Number of rollouts.
        control_accuracy: Share of rollouts that show the behaviour that was requested.
        control_interval: Its Wilson 95 % interval, as if rollouts were independent.
        accuracy_by_behavior: The same share for each requested behaviour.
        confusion: Requested behaviour to shown behaviour to number of rollouts.
        distance: Mean `path_distance` of a rollout to the demonstration whose style it used.
        distance_to_others: Mean distance of a rollout to all other demonstrations, for scale.
        nearest_is_requested: Share of rollouts whose nearest demonstration of all is the requested one.
        episodes: One record per rollout.
    """

    n_episodes: int
    control_accuracy: float
    control_interval: Interval
    accuracy_by_behavior: dict[str, float]
    confusion: dict[str, dict[str, int]]
    distance: float
    distance_to_others: float
    nearest_is_requested: float
    episodes: list[dict[str, Any]]


def plan_requests(
    allowed: Sequence[int], demonstrated: Sequence[str], per_behavior: int, seed: int
) -> list[tuple[int, int]]:
    """Which style to use from which start.

    From every start each behaviour is requested once; a behaviour's styles take turns, in random order.

    Args:
        allowed: Episodes whose styles may be used.
        demonstrated: The label of every episode.
        per_behavior: Number of starts, that is of rollouts per behaviour.
        seed: Seed of the order.

    Returns:
        (start, episode) of every rollout, sorted by start.
    """
    rng = np.random.default_rng(seed)
    labels = list(histogram([demonstrated[i] for i in allowed]))
    styles = {la: rng.permutation([i for i in allowed if demonstrated[i] == la]).tolist() for la in labels}
    return [(k, styles[label][k % len(styles[label])]) for k in range(per_behavior) for label in labels]


def path_distance(states: np.ndarray, other: np.ndarray) -> float:
    """Distance of two state sequences, in the states' units.

    Both are padded to a common length by repeating their last state, as ν does; the distance is the root mean
    square over time of the Euclidean distance.

    Args:
        states: (T, d).
        other: (T', d).
    """
    length = max(len(states), len(other))
    padded = [np.concatenate([s, np.repeat(s[-1:], length - len(s), axis=0)]) for s in (states, other)]
    return float(np.sqrt(np.square(padded[0] - padded[1]).sum(axis=1).mean()))


def run_counterfactual(
    checkpoint: Checkpoint,
    trajectories: Trajectories,
    env_cfg: EnvConfig,
    rule: BehaviorRule,
    per_behavior: int,
    batch_size: int,
    seed: int,
) -> tuple[CounterfactualResult, list[Rollout]]:
    """Request every demonstrated behaviour from the same starts.

    Of a policy that draws by scene, one of a behaviour's styles is requested by scene.

    Args:
        checkpoint: A style policy; only styles that its flags allow are requested.
        trajectories: Its training dataset.
        env_cfg: The environment; start k has the same seed for all requests.
        rule: Labels an episode.
        per_behavior: Rollouts per behaviour.
        batch_size: Largest number of environments that run at once.
        seed: Start k has the environment seed ``seed + k``.

    Raises:
        ValueError: If the policy has no styles.
    """
    if not checkpoint.has_styles:
        raise ValueError(
            f"counterfactual: a {checkpoint.policy.config.type!r} policy has no styles to request"
        )
    styles: Any = checkpoint.policy.styles
    demonstrated = [rule(episode) for episode in trajectories.episodes()]
    allowed = [i for i in styles.allowed().tolist() if i < len(demonstrated)]
    plan = plan_requests(allowed, demonstrated, per_behavior, seed)
    request = StyleRequest([episode for _, episode in plan])
    if styles.drawing.sampling == "scene":  # of the behaviour's styles the one that suits the scene
        shown_by = {la: [i for i in allowed if demonstrated[i] == la] for la in set(demonstrated)}
        request = StyleRequest(choices=[shown_by[demonstrated[episode]] for _, episode in plan])
    with styles.requested(request):
        rollouts = run_rollouts(
            checkpoint, env_cfg, rule, len(plan), batch_size, seed, [seed + start for start, _ in plan]
        )
    demonstrations = trajectories.states([OBS_STATE])
    return evaluate_counterfactual(
        rollouts, [start for start, _ in plan], demonstrated, demonstrations
    ), rollouts


def evaluate_counterfactual(
    rollouts: Sequence[Rollout],
    starts: Sequence[int],
    demonstrated: Sequence[str],
    demonstrations: Sequence[np.ndarray],
) -> CounterfactualResult:
    """Compare each rollout with the demonstration whose style it used.

    Args:
        rollouts: Each with its `style_episode`.
        starts: The start of each.
        demonstrated: The label of every demonstration.
        demonstrations: N arrays (T_i, d), their states.
    """
    chosen = [rollout.style_episode for rollout in rollouts if rollout.style_episode is not None]
    requested = [demonstrated[i] for i in chosen]
    shown = [rollout.behavior for rollout in rollouts]
    confusion: dict[str, dict[str, int]] = {}
    for wanted, got in zip(requested, shown, strict=True):
        row = confusion.setdefault(wanted, {})
        row[got] = row.get(got, 0) + 1
    distances = np.array(
        [[path_distance(r.observations[OBS_STATE], d) for d in demonstrations] for r in rollouts]
    )  # (R, N)
    own = distances[np.arange(len(chosen)), chosen]
    others = (distances.sum(axis=1) - own) / max(len(demonstrations) - 1, 1)
    nearest = distances.argmin(axis=1)
    return CounterfactualResult(
        n_episodes=len(rollouts),
        control_accuracy=style_fidelity(shown, requested),
        control_interval=success_interval([a == b for a, b in zip(shown, requested, strict=True)]),
        accuracy_by_behavior={la: row.get(la, 0) / sum(row.values()) for la, row in confusion.items()},
        confusion=confusion,
        distance=float(own.mean()),
        distance_to_others=float(others.mean()),
        nearest_is_requested=float((nearest == np.array(chosen)).mean()),
        episodes=[
            {
                "start": start,
                "style_episode": rollout.style_episode,
                "requested": wanted,
                "shown": rollout.behavior,
                "success": rollout.success,
                "length": rollout.length,
                "distance": float(distance),
            }
            for start, rollout, wanted, distance in zip(starts, rollouts, requested, own, strict=True)
        ],
    )


def format_counterfactual(result: CounterfactualResult) -> str:
    """The confusion matrix and the figures, for the terminal."""
    labels = list(result.confusion)
    strangers = sorted({shown for row in result.confusion.values() for shown in row} - set(labels))
    shown = labels + strangers
    width = max(6, *(len(label) for label in shown))
    corner = "requested / shown"
    lines = ["  ".join([f"{corner:<17}", *(f"{label or '(none)':>{width}}" for label in shown), "accuracy"])]
    for label, row in result.confusion.items():
        counts = (str(row.get(other, ".")).rjust(width) for other in shown)
        lines.append("  ".join([f"{label:<17}", *counts, f"{result.accuracy_by_behavior[label]:8.3f}"]))
    interval, lowest = result.control_interval, min(result.accuracy_by_behavior.values())
    lines += [
        f"control accuracy {result.control_accuracy:.3f}  {interval:.3f} "
        f"Wilson 95 %, {result.n_episodes} rollouts; lowest of a behaviour {lowest:.3f}",
        f"distance to the requested demonstration {result.distance:.4f}, to the others "
        f"{result.distance_to_others:.4f} (RMS over time, units of the state)",
        f"the requested demonstration is the nearest of all in {result.nearest_is_requested:.3f} of them",
    ]
    strays = {e["style_episode"]: e for e in result.episodes if e["requested"] != e["shown"]}
    if strays:
        named = (f"{i} ({e['requested']} -> {e['shown'] or '(none)'})" for i, e in sorted(strays.items()))
        lines.append(f"styles that led elsewhere: {', '.join(named)}; leave them out with")
        lines.append(f'--policy.style_filter="episode not in {sorted(strays)}"')
    return "\n".join(lines)


def plot_counterfactual(path: Path, result: CounterfactualResult, title: str) -> None:
    """The confusion matrix, requested × shown, as shares of each row.

    Args:
        path: Where to write the picture.
        result: The check.
        title: Heading.
    """
    labels = list(result.confusion)
    strangers = sorted({shown for row in result.confusion.values() for shown in row} - set(labels))
    columns = labels + strangers
    counts = np.array([[row.get(shown, 0) for shown in columns] for row in result.confusion.values()])
    shares = counts / counts.sum(axis=1, keepdims=True)
    figure = Figure(figsize=(2.4 + 0.48 * len(columns), 1.9 + 0.4 * len(labels)), layout="constrained")
    axes = figure.subplots()
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(counts):
        color = "white" if shares[i, j] > 0.5 else "black"
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", color=color, fontsize=9)
    axes.set_xticks(range(len(columns)), [label or "(none)" for label in columns], rotation=90)
    axes.set_yticks(range(len(labels)), labels)
    axes.set(xlabel="shown behaviour", ylabel="requested behaviour")
    axes.set_title(title, fontsize=10)
    save_figure(figure, path)


@Check.register_subclass("counterfactual")
@dataclass
class CounterfactualCheck(Check):
    """Request every demonstrated behaviour from the same starts."""

    # Starts, the same for all behaviours: so many rollouts per behaviour.
    starts: int = 40

    file = "counterfactual"
    heeds = frozenset({"batch_size", "behavior_rule"})

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the number of starts."""
        if self.starts < 1:
            raise ValueError(f"check.starts={self.starts}: expected at least 1")

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """See `run_counterfactual`."""
        checkpoint, env, rule = subject.actor, subject.env, subject.rule
        assert checkpoint is not None
        assert env is not None
        assert rule is not None
        size, seed = subject.rollouts.batch_size, subject.rollouts.seed
        result, _ = run_counterfactual(checkpoint, subject.trajectories, env, rule, self.starts, size, seed)
        heading = f"{subject.title}: control accuracy {result.control_accuracy:.3f}"
        return Finding(
            result,
            format_counterfactual(result),
            lambda path: plot_counterfactual(path, result, heading),
        )
