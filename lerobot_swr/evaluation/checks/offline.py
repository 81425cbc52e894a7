"""Offline evaluation: action errors on a dataset's frames, where there is no simulator."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.checks.check import Check, Finding, Subject
from lerobot_swr.evaluation.metrics import BOOTSTRAP_DRAWS, Interval
from lerobot_swr.evaluation.plots import plot_offline
from lerobot_swr.policies.demonstration_frames import dataset_frames
from lerobot_swr.policies.style_policy import StylePolicy
from lerobot_swr.similarity import similarity_by
from lerobot_swr.trajectories import Trajectories

BATCH = 4096
WINDOWS = 64  # frames at once of policies that see pictures and windows of steps
KINDS = {
    "own": "own style",
    "nearest": "style of the nearest other demonstration",
    "random": "style of a random other demonstration",
    "same": "style of another demonstration of its behaviour",
    "other": "style of a demonstration of another behaviour",
    "none": "no style",
}


@dataclass(frozen=True)
class OfflineResult:
    """What ``offline.json`` holds.

    Attributes:
        n_episodes: Episodes evaluated: those whose styles may be drawn, for a style policy.
        n_frames: Their frames.
        action_error: Kind of style (``own``, ``nearest``, ``random``, or ``none`` for a policy without
            styles) to the mean over frames of the squared error of the normalised action, itself a mean over
            dimensions.
        action_error_interval: Its bootstrap 95 % interval over episodes.
        action_error_by_dimension: The same mean for each action dimension, in order.
        action_error_by_behavior: Behaviour of the demonstrations to the mean for each kind of style; null
            where none of its frames has such a style (a behaviour of one demonstration, or the only one).
            None where behaviours are not known.
    """

    n_episodes: int
    n_frames: int
    action_error: dict[str, float]
    action_error_interval: dict[str, Interval]
    action_error_by_dimension: dict[str, list[float]]
    action_error_by_behavior: dict[str, dict[str, float | None]] | None = None


@dataclass(frozen=True)
class FrameErrors:
    """Squared errors of every evaluated frame.

    Attributes:
        episodes: (F,) episode of each frame.
        phase: (F,) place of each frame in its episode, 0 to 1.
        squared: Kind of style to (F, A) squared errors in normalised units; NaN for frames that have no style
            of this kind.
        behaviors: Label of every episode of the dataset, or None.
    """

    episodes: np.ndarray
    phase: np.ndarray
    squared: dict[str, np.ndarray]
    behaviors: Sequence[str] | None = None


def known_behaviors(
    checkpoint: Checkpoint, trajectories: Trajectories, rule: BehaviorRule | None
) -> list[str] | None:
    """The label of every episode: by the rule, else as the checkpoint's table has it; None if unknown."""
    if rule is not None:
        return [rule(episode) for episode in trajectories.episodes()]
    table = checkpoint.policy.styles.table if checkpoint.has_styles else None
    if table is None or "behavior" not in table.columns:
        return None
    return [str(label) for label in table.columns["behavior"][: len(trajectories)]]


def frame_errors(
    checkpoint: Checkpoint,
    trajectories: Trajectories,
    episodes: list[int] | None = None,
    seed: int = 0,
    behaviors: Sequence[str] | None = None,
) -> FrameErrors:
    """Predict every frame's action with each kind of style.

    Args:
        checkpoint: A ``bc``, ``zbc`` or ``wzbc`` policy.
        trajectories: The dataset it was trained on.
        episodes: Only these; None takes all (of those whose styles may be drawn, for a style policy).
        seed: Seed of the random styles, one draw per frame.
        behaviors: Label of every episode, to compare with styles of the same and of other behaviours, too.

    Raises:
        ValueError: For another type of policy, or when fewer than 2 episodes have a style.
    """
    policy = checkpoint.policy
    if not isinstance(policy, StylePolicy):
        raise ValueError(
            f"policy.type={policy.config.type!r}: offline evaluation knows bc, zbc and wzbc; "
            "evaluate this policy in an environment (--env.type=...)"
        )
    chosen = np.arange(len(trajectories)) if episodes is None else np.array(episodes)
    styles: dict[str, np.ndarray | None] = {"none": None}
    if policy.has_styles:
        # Styles added for episodes of other datasets follow those of the training dataset.
        allowed = policy.styles.allowed().cpu().numpy()
        drawable = np.sort(allowed[allowed < len(trajectories)])
        if len(drawable) < 2:
            raise ValueError(
                f"the checkpoint has {len(drawable)} style(s) that may be drawn; offline evaluation compares "
                "an episode's own style with another one and needs at least 2"
            )
        chosen = chosen[np.isin(chosen, drawable)]
        if len(chosen) == 0:
            raise ValueError(
                f"dataset.episodes={episodes}: none of them has a style that may be drawn; these have: "
                f"{drawable.tolist()}"
            )
    frames = np.concatenate(
        [trajectories.starts[i] + np.arange(trajectories.lengths[i]) for i in chosen]
    )  # (F,) rows
    episode_of_frame = np.repeat(chosen, trajectories.lengths[chosen])
    if policy.has_styles:
        styles = _styles_of_frames(policy, trajectories, drawable, episode_of_frame, seed)
        if behaviors is not None:
            styles |= _styles_by_behavior(np.array(behaviors), drawable, episode_of_frame, seed)
    squared = {kind: _squared_errors(checkpoint, trajectories, frames, used) for kind, used in styles.items()}
    place = frames - trajectories.starts[episode_of_frame]
    phase = place / np.maximum(trajectories.lengths[episode_of_frame] - 1, 1)
    return FrameErrors(episode_of_frame, phase, squared, behaviors)


def _styles_of_frames(
    policy: StylePolicy, trajectories: Trajectories, drawable: np.ndarray, own: np.ndarray, seed: int
) -> dict[str, np.ndarray | None]:
    """Kind of style to the (F,) episodes whose styles the frames use."""
    similarity = similarity_by(trajectories, policy.config.manner, Path(trajectories.name))
    nearest = similarity.nearest(drawable, 1, drawable)[0][:, 0].astype(np.int64)
    place = np.searchsorted(drawable, own)
    shift = np.random.default_rng(seed).integers(1, len(drawable), size=len(own))
    return {"own": own, "nearest": nearest[place], "random": drawable[(place + shift) % len(drawable)]}


def _styles_by_behavior(
    behaviors: np.ndarray, drawable: np.ndarray, own: np.ndarray, seed: int
) -> dict[str, np.ndarray | None]:
    """Kinds of style as in `_styles_of_frames`, -1 for frames that have none of this kind."""
    rng = np.random.default_rng([seed, 1])
    same, other = np.full(len(own), -1), np.full(len(own), -1)
    for episode in np.unique(own):
        rows = own == episode
        is_same = behaviors[drawable] == behaviors[episode]
        for styles, choices in (
            (same, drawable[is_same & (drawable != episode)]),
            (other, drawable[~is_same]),
        ):
            if len(choices):
                styles[rows] = rng.choice(choices, rows.sum())
    return {kind: used for kind, used in (("same", same), ("other", other)) if (used >= 0).any()}


@torch.no_grad()
def _squared_errors(
    checkpoint: Checkpoint, trajectories: Trajectories, frames: np.ndarray, styles: np.ndarray | None
) -> np.ndarray:
    policy = checkpoint.policy
    assert isinstance(policy, StylePolicy)
    read, size, present = _reader(checkpoint, trajectories)
    parts = []
    for start in range(0, len(frames), size):
        batch = read(frames[start : start + size])
        style = None
        if styles is not None:
            used = torch.from_numpy(styles[start : start + size].clip(min=0)).to(batch[OBS_STATE].device)
            style = policy.styles.embedding(used)
        with torch.random.fork_rng(devices=[]):  # a policy that draws noise draws the same for every style
            torch.manual_seed(start)
            predicted = policy.predict(batch, style)
        parts.append((predicted - present(batch[ACTION])).square().cpu().numpy())
    errors = np.concatenate(parts)
    if styles is not None:
        errors[styles < 0] = np.nan
    return errors


def _reader(
    checkpoint: Checkpoint, trajectories: Trajectories
) -> tuple[Callable[[np.ndarray], dict[str, Tensor]], int, Callable[[Tensor], Tensor]]:
    """How to read frames by their rows, how many at once, and which of their actions is the present one."""
    config = checkpoint.policy.config
    if not config.traits.is_momentary:
        root, numbers = Path(trajectories.name), trajectories.index
        items = dataset_frames(config, root, checkpoint.preprocessor)
        steps = config.action_delta_indices

        def read_items(rows: np.ndarray) -> dict[str, Tensor]:
            return items.batch((rows if numbers is None else numbers[rows]).tolist())

        return read_items, WINDOWS, lambda actions: actions if steps is None else actions[:, steps.index(0)]

    def read_columns(rows: np.ndarray) -> dict[str, Tensor]:
        keys = [*config.observation_keys, ACTION]
        return checkpoint.preprocessor({k: torch.from_numpy(trajectories.columns[k][rows]) for k in keys})

    return read_columns, BATCH, lambda actions: actions


def summarize(errors: FrameErrors) -> OfflineResult:
    """Means and their bootstrap intervals over episodes."""
    names, place = np.unique(errors.episodes, return_inverse=True)
    draws = np.random.default_rng(0).integers(len(names), size=(BOOTSTRAP_DRAWS, len(names)))
    intervals = {}
    for kind, squared in errors.squared.items():
        known = ~np.isnan(squared[:, 0])
        total = np.bincount(place[known], weights=squared[known].mean(axis=1), minlength=len(names))
        count = np.bincount(place[known], minlength=len(names))  # (E,) frames per episode
        resampled = total[draws].sum(axis=1) / np.maximum(count[draws].sum(axis=1), 1)
        intervals[kind] = Interval(*np.quantile(resampled, [0.025, 0.975]).tolist())
    return OfflineResult(
        n_episodes=len(names),
        n_frames=len(place),
        action_error={kind: float(np.nanmean(squared)) for kind, squared in errors.squared.items()},
        action_error_interval=intervals,
        action_error_by_dimension={
            kind: np.nanmean(squared, axis=0).tolist() for kind, squared in errors.squared.items()
        },
        action_error_by_behavior=None if errors.behaviors is None else _by_behavior(errors),
    )


def _by_behavior(errors: FrameErrors) -> dict[str, dict[str, float | None]]:
    """The mean errors of each behaviour, the most frequent first."""
    label = np.array(errors.behaviors)[errors.episodes]  # (F,)
    result: dict[str, dict[str, float | None]] = {}
    for name, _ in Counter(label.tolist()).most_common():
        rows = label == name
        parts = {kind: squared[rows] for kind, squared in errors.squared.items()}
        result[name] = {
            kind: None if np.isnan(part).all() else float(np.nanmean(part)) for kind, part in parts.items()
        }
    return result


def format_offline(result: OfflineResult) -> str:
    """A table for the terminal."""
    lines = [
        f"{result.n_frames} frames of {result.n_episodes} episodes; mean squared error, normalised actions"
    ]
    for kind, error in result.action_error.items():
        interval = result.action_error_interval[kind]
        lines.append(f"  {KINDS[kind]:<50} {error:.5f}  {interval:.5f}")
    if result.action_error_by_behavior:
        kinds = list(result.action_error)
        lines.append("  " + "  ".join([f"{'behaviour':<24}", *(f"{kind:>8}" for kind in kinds)]))
        for name, means in result.action_error_by_behavior.items():
            cells = ("       -" if means[kind] is None else f"{means[kind]:8.5f}" for kind in kinds)
            lines.append("  " + "  ".join([f"{name or '(none)':<24}", *cells]))
    return "\n".join(lines)


@Check.register_subclass("offline")
@dataclass
class OfflineCheck(Check):
    """Measure action errors on the dataset's frames, without an environment."""

    file = "offline"
    heeds = frozenset({"dataset.episodes", "behavior_rule"})
    actor = "policy"
    needs_env = False
    needs_rule = False

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """See `frame_errors`."""
        assert subject.actor is not None
        behaviors = known_behaviors(subject.actor, subject.trajectories, subject.rule)
        errors = frame_errors(
            subject.actor, subject.trajectories, subject.dataset.episodes, subject.rollouts.seed, behaviors
        )
        result = summarize(errors)
        per_frame = {kind: squared.mean(axis=1) for kind, squared in errors.squared.items()}
        return Finding(
            result,
            format_offline(result),
            lambda path: plot_offline(path, per_frame, errors.phase, KINDS.__getitem__, subject.title),
        )
