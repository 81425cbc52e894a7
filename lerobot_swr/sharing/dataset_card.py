"""The card of a dataset: how many demonstrations, what they show, what it holds, how to train on it."""

from collections import Counter
from typing import Any

import numpy as np
from huggingface_hub import DatasetCard, DatasetCardData
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.evaluation.metrics import success_interval
from lerobot_swr.sharing.folders import TAG
from lerobot_swr.sharing.markdown import code, escaped, table
from lerobot_swr.sharing.pictures import draw_groups
from lerobot_swr.sharing.policy_card import INSTALL, MAX_BEHAVIORS
from lerobot_swr.styles.filters import Value
from lerobot_swr.styles.map import demonstration_paths
from lerobot_swr.trajectories import Trajectories

PICTURE = "demonstrations.png"


def dataset_card(
    meta: LeRobotDatasetMetadata,
    trajectories: Trajectories,
    rule: BehaviorRule | None,
    repo_id: str,
    license_: str | None = None,
) -> tuple[DatasetCard, bytes]:
    """The card, and the picture (PNG) that it shows.

    Args:
        meta: The dataset's metadata.
        trajectories: Its states and actions.
        rule: Labels a demonstration; None where no rule is known.
        repo_id: Its name on the Hub.
        license_: The Hub's name of its license; None says nothing of it.
    """
    data = DatasetCardData(
        license=license_,
        task_categories=["robotics"],
        tags=["LeRobot", TAG],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    labels: list[Value] = [] if rule is None else [rule(episode) for episode in trajectories.episodes()]
    name, values = ("behavior", labels) if labels else ("length", trajectories.lengths.tolist())
    paths = demonstration_paths(trajectories, list(range(len(trajectories))))
    picture = draw_groups(paths, values, name, "demonstrations")
    lengths = trajectories.lengths
    facts: list[tuple[str, Any]] = [
        ("episodes", meta.total_episodes),
        ("frames", meta.total_frames),
        ("frames per second", meta.fps),
        ("length of an episode", f"{lengths.min()} to {lengths.max()} frames, median {np.median(lengths):g}"),
        ("robot", meta.robot_type or "not named"),
        ("format", meta.info.codebase_version),
    ]
    lines = [
        f"# {escaped(repo_id.rpartition('/')[2])}",
        "",
        "Demonstrations for [LeRobot](https://github.com/huggingface/lerobot).",
        "",
        *table(("", ""), facts),
        "",
        "## What the demonstrations show",
        "",
        f"![The demonstrations]({PICTURE})",
        "",
        *_behaviors(labels),
        *table(("task",), [(task,) for task in dict.fromkeys(trajectories.tasks or [])]),
        "",
        "## Features",
        "",
        *table(
            ("feature", "type", "shape", "names"),
            [
                (key, ft["dtype"], list(ft["shape"]), "" if not ft.get("names") else ft["names"])
                for key, ft in meta.features.items()
            ],
        ),
        "",
        "## Use",
        "",
        *code(
            INSTALL,
            f"lerobot-train --policy.type=wzbc --policy.push_to_hub=false --dataset.repo_id={repo_id}",
        ),
    ]
    return DatasetCard(f"---\n{data.to_yaml()}\n---\n\n" + "\n".join(lines) + "\n"), picture


def _behaviors(labels: list[Value]) -> list[str]:
    """Behaviours with shares and, since demonstrations are a sample, Wilson's 95 % intervals."""
    if not labels:
        return []
    total = len(labels)
    rows = []
    for label, n in Counter(map(str, labels)).most_common(MAX_BEHAVIORS):
        interval = success_interval([True] * n + [False] * (total - n))
        rows.append((label or "(none)", n, f"{n / total:.1%} {interval:.1%}"))
    return [*table(("behaviour", "demonstrations", "share, 95 % interval"), rows), ""]
