"""Blends of styles: what a policy does between two demonstrations' styles, and how often it succeeds."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.envs import EnvConfig
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.checks.check import Check, Finding, Subject
from lerobot_swr.evaluation.plots import save_figure
from lerobot_swr.evaluation.rollouts import Rollout, run_rollouts
from lerobot_swr.styles.request import StyleRequest

SHARES = tuple(np.linspace(0, 1, 9).tolist())
SAME, DIFFERENT = "same behaviour", "different behaviours"


@dataclass(frozen=True)
class BlendResult:
    """What ``blend.json`` holds.

    Attributes:
        shares: Shares of the second style, 0 to 1.
        n_pairs: Kind of pair (of demonstrations with the same behaviour, or with different ones) to how many.
        success_rate: Kind of pair to the share of successes for each share.
        end_behavior_rate: Kind of pair to the share of rollouts that show one of their ends' behaviours.
        episodes: One record per rollout.
    """

    shares: list[float]
    n_pairs: dict[str, int]
    success_rate: dict[str, list[float]]
    end_behavior_rate: dict[str, list[float]]
    episodes: list[dict[str, Any]]


def draw_pairs(
    allowed: Sequence[int], demonstrated: Sequence[str], n_pairs: int, seed: int
) -> dict[str, list[tuple[int, int]]]:
    """Random pairs of episodes with the same and with different behaviours; at most `n_pairs` of each."""
    rng = np.random.default_rng(seed)
    every = [(i, j) for i in allowed for j in allowed if i < j]
    order = rng.permutation(len(every))
    pairs: dict[str, list[tuple[int, int]]] = {SAME: [], DIFFERENT: []}
    for k in order:
        i, j = every[k]
        kind = pairs[SAME if demonstrated[i] == demonstrated[j] else DIFFERENT]
        if len(kind) < n_pairs:
            kind.append((i, j))
    return {kind: chosen for kind, chosen in pairs.items() if chosen}


def run_blends(
    checkpoint: Checkpoint,
    env_cfg: EnvConfig,
    rule: BehaviorRule,
    demonstrated: Sequence[str],
    n_pairs: int,
    batch_size: int,
    seed: int,
) -> tuple[BlendResult, list[Rollout]]:
    """Roll out blends of pairs of styles, all from the same start.

    Args:
        checkpoint: A style policy.
        env_cfg: The environment; every rollout has the same seed.
        rule: Labels an episode.
        demonstrated: The label of every demonstration of the training dataset.
        n_pairs: Number of pairs of each kind.
        batch_size: Largest number of environments that run at once.
        seed: Seeds the pairs and the environment.

    Returns:
        The result, and the rollouts in the order of its records.

    Raises:
        ValueError: If the policy has fewer than 2 styles.
    """
    policy: Any = checkpoint.policy
    allowed = (
        [i for i in policy.styles.allowed().tolist() if i < len(demonstrated)]
        if checkpoint.has_styles
        else []
    )
    if len(allowed) < 2:
        raise ValueError("blend: a policy with at least 2 styles to draw is needed")
    pairs = draw_pairs(allowed, demonstrated, n_pairs, seed)
    plan = [(kind, i, j, share) for kind, some in pairs.items() for i, j in some for share in SHARES]
    weight = policy.styles.embedding.weight.detach()
    blends = torch.stack([torch.lerp(weight[i], weight[j], share) for _, i, j, share in plan])
    with policy.styles.requested(StyleRequest(vectors=blends)):
        rollouts = run_rollouts(checkpoint, env_cfg, rule, len(plan), batch_size, seed, [seed] * len(plan))
    records = [
        {
            "pair": kind,
            "episodes": [i, j],
            "share": share,
            "behavior": rollout.behavior,
            "ends": [demonstrated[i], demonstrated[j]],
            "success": rollout.success,
        }
        for (kind, i, j, share), rollout in zip(plan, rollouts, strict=True)
    ]

    def rate(kind: str, holds: Any) -> list[float]:
        return [
            float(np.mean([holds(r) for r in records if r["pair"] == kind and r["share"] == share]))
            for share in SHARES
        ]

    result = BlendResult(
        shares=list(SHARES),
        n_pairs={kind: len(some) for kind, some in pairs.items()},
        success_rate={kind: rate(kind, lambda r: r["success"]) for kind in pairs},
        end_behavior_rate={kind: rate(kind, lambda r: r["behavior"] in r["ends"]) for kind in pairs},
        episodes=records,
    )
    return result, rollouts


def format_blends(result: BlendResult) -> str:
    """Success along the blend, for the terminal."""
    lines = [f"{'share of the second style':<42}" + "".join(f"{share:7.3f}" for share in result.shares)]
    for kind, n in result.n_pairs.items():
        for what, rates in (
            ("success", result.success_rate),
            ("behaviour of an end", result.end_behavior_rate),
        ):
            name = f"{n} pairs, {kind}: {what}"
            lines.append(f"{name:<42}" + "".join(f"{value:7.3f}" for value in rates[kind]))
    return "\n".join(lines)


def plot_blends(
    path: Path,
    result: BlendResult,
    paths: Sequence[np.ndarray],
    env_cfg: EnvConfig,
    title: str,
    examples: int = 2,
) -> None:
    """Blends of the first pairs of each kind in the scene, and how often blends succeed.

    Args:
        path: Where to write the picture.
        result: The check.
        paths: Path (T, 2) of every rollout.
        env_cfg: Its task draws the scene.
        title: Heading.
        examples: Pairs of each kind to draw.
    """
    kinds = list(result.n_pairs)
    figure = Figure(figsize=(4.2 * len(kinds) + 4.6, 8.4), layout="constrained")
    grid = figure.subplots(examples, len(kinds) + 1, squeeze=False)
    colors = colormaps["viridis"]
    for column, kind in enumerate(kinds):
        mine = [k for k, record in enumerate(result.episodes) if record["pair"] == kind]
        for row in range(examples):
            axes = grid[row, column]
            axes.set(xticks=[], yticks=[], aspect="equal")
            chosen = mine[row * len(result.shares) : (row + 1) * len(result.shares)]
            if not chosen:
                axes.set_axis_off()
                continue
            task_of(env_cfg).draw_scene(axes)
            for k in chosen:
                record = result.episodes[k]
                style = "-" if record["success"] else ":"
                axes.plot(*paths[k].T, style, color=colors(record["share"]), linewidth=1.8)
            i, j = result.episodes[chosen[0]]["episodes"]
            ends = result.episodes[chosen[0]]["ends"]
            axes.set_title(f"{kind}: {i} ({ends[0]}) to {j} ({ends[1]})", fontsize=10)
    for row, (name, rates) in enumerate(
        (("success rate", result.success_rate), ("shows the behaviour of an end", result.end_behavior_rate))
    ):
        axes = grid[row, -1]
        for kind in kinds:
            axes.plot(result.shares, rates[kind], "o-", label=f"{result.n_pairs[kind]} pairs, {kind}")
        axes.set(xlabel="share of the second style", ylabel=name, ylim=(-0.03, 1.03))
        axes.legend(loc="lower left")
    for row in range(2, examples):
        grid[row, -1].set_axis_off()
    scale = ScalarMappable(cmap=colors)
    scale.set_clim(0, 1)
    figure.colorbar(
        scale, ax=grid[:, :-1], shrink=0.5, label="share of the second style (dotted: no success)"
    )
    figure.suptitle(title)
    save_figure(figure, path)


@Check.register_subclass("blend")
@dataclass
class BlendCheck(Check):
    """Roll out blends of two styles, with the same behaviour and with different ones."""

    # Pairs of styles of each kind.
    pairs: int = 40

    file = "blend"
    heeds = frozenset({"batch_size", "behavior_rule"})
    actor = "policy"

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the number of pairs."""
        if self.pairs < 1:
            raise ValueError(f"check.pairs={self.pairs}: expected at least 1")

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """See `run_blends`."""
        checkpoint, env, rule = subject.actor, subject.env, subject.rule
        assert checkpoint is not None
        assert env is not None
        assert rule is not None
        demonstrated = [rule(episode) for episode in subject.trajectories.episodes()]
        size, seed = subject.rollouts.batch_size, subject.rollouts.seed
        result, rollouts = run_blends(checkpoint, env, rule, demonstrated, self.pairs, size, seed)
        task = task_of(env)
        paths = [task.plot_path(rollout.observations) for rollout in rollouts]
        heading = f"{subject.title}: blends of two styles"
        return Finding(
            result,
            format_blends(result),
            lambda path: plot_blends(path, result, paths, env, heading),
        )
