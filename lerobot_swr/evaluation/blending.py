"""Blends of styles: what a policy does between two demonstrations' styles, and how often it succeeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.envs import EnvConfig

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.evaluation.checkpoint import Checkpoint
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
