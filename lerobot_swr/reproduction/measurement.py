"""Computes an evaluation cell: rollouts of every training seed, by each way of drawing styles."""

import json
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.task import Task, task_of
from lerobot_swr.evaluation.checkpoint import (
    Checkpoint,
    DatasetSource,
    in_simulation,
    load_checkpoint,
    load_demonstrations,
    load_reference,
)
from lerobot_swr.evaluation.playback import playback_checkpoint
from lerobot_swr.evaluation.rollouts import Rollout, run_rollouts
from lerobot_swr.evaluation.scenes import SceneRollouts, run_in_scenes, scene_matches
from lerobot_swr.reproduction.cells import Cell, Store
from lerobot_swr.reproduction.demonstrations import environment, short_path
from lerobot_swr.reproduction.settings import MAX_ROLLOUTS
from lerobot_swr.reproduction.training import checkpoint_folder
from lerobot_swr.styles.drawing import check_style_sampling
from lerobot_swr.whole_files import write_whole

BATCH_SIZE = 100  # environments that run at once


def measure(cell: Cell, store: Store, dataset: Path) -> dict[str, Any]:
    """Roll out every seed of the cell's training, or of a baseline that needs none.

    The rollouts of each seed and way of drawing are kept as soon as they are made, so that an interrupted
    cell goes on with the next ones.

    Args:
        cell: An evaluation cell.
        store: Where the checkpoints are, and the parts go.
        dataset: Folder of the dataset.

    Returns:
        The result: ``rollouts[seed][protocol]`` with one list per figure, ``allowed`` (the episodes whose
        styles could be drawn; None: all or no styles) and ``paths`` of the first seed's last rollouts.
    """
    seeds = (cell.needs or cell).definition["seeds"]
    result: dict[str, Any] = {"rollouts": {}, "allowed": None, "paths": []}
    for seed in seeds:
        result["rollouts"][str(seed)] = {}
        for protocol in cell.definition["protocols"]:
            path = store.work_folder(cell) / "parts" / f"seed_{seed}-{protocol}.json"
            if not path.is_file():
                write_whole(path, json.dumps(_part(cell, store, dataset, seed, protocol)))
            part = json.loads(path.read_text())
            result["rollouts"][str(seed)][protocol] = part["rollouts"]
            result["allowed"] = part["allowed"]
            if seed == seeds[0]:
                result["paths"] = part["paths"]
    return result


def _part(cell: Cell, store: Store, dataset: Path, seed: int, protocol: str) -> dict[str, Any]:
    definition, source = cell.definition, DatasetSource(root=dataset)
    if cell.needs is None:
        trajectories = load_demonstrations(source.metadata())
        checkpoint = playback_checkpoint(trajectories, check_style_sampling(protocol))
    else:
        folder = checkpoint_folder(cell.needs, store, seed)
        checkpoint = load_policy(folder, protocol, definition["style_filter"])
        # refuses another dataset than the training's
        trajectories = in_simulation(load_reference(source, checkpoint))
    env_cfg = environment(definition["env"])
    task = task_of(env_cfg)
    rule = task.behavior_rule()
    demonstrated = [rule(episode) for episode in trajectories.episodes()]
    count = definition["protocols"][protocol]
    env_seed = environment_seed(definition["seed"], seed)
    env_seeds = [env_seed] * count if definition.get("one_scene") else None
    kind = definition.get("scenes")
    found = None
    if kind is None:
        rollouts = run_rollouts(checkpoint, env_cfg, rule, count, BATCH_SIZE, env_seed, env_seeds)
    else:
        found = run_in_scenes(checkpoint, trajectories, env_cfg, rule, kind, count, BATCH_SIZE, env_seed)
        rollouts = found.rollouts
    columns = _columns(rollouts, demonstrated, task)
    if found is not None:
        columns |= _scene_columns(found, demonstrated, rule, task)
    filtered = definition["style_filter"] is not None
    drawn = rollouts if definition["paths"] else []
    return {
        "rollouts": columns,
        "allowed": checkpoint.policy.styles.allowed().tolist() if filtered else None,
        "paths": [short_path(task.plot_path(rollout.observations)) for rollout in drawn],
    }


def environment_seed(first: int, training_seed: int) -> int:
    """Seed of a training seed's first rollout, the next ones count on from it.

    Rollout k of a training seed meets the same start and noise whatever the policy; no two training seeds
    share a start or noise.
    """
    return first + training_seed * MAX_ROLLOUTS


def load_policy(folder: Path, style_sampling: str | None, style_filter: str | None) -> Checkpoint:
    """A checkpoint that draws its styles in the given way, if it has styles.

    Args:
        folder: Its ``pretrained_model``.
        style_sampling: ``uniform`` or ``stratified``; None keeps the checkpoint's.
        style_filter: Only styles of demonstrations that match; None allows all.
    """
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    if hasattr(config, "style_sampling"):
        config.style_sampling = style_sampling or config.style_sampling
        config.style_filter = style_filter  # type: ignore[attr-defined]
    return load_checkpoint(config)


def _columns(rollouts: list[Rollout], demonstrated: list[str], task: Task) -> dict[str, list]:
    def match(rollout: Rollout) -> int | None:
        """Whether it shows what its style's demonstration does, as far as that lies ahead of its start."""
        if rollout.style_episode is None:
            return None
        expected = task.expected_behavior(demonstrated[rollout.style_episode], rollout.observations)
        return int(rollout.behavior == expected)

    return {
        "behavior": [rollout.behavior for rollout in rollouts],
        "success": [int(rollout.success) for rollout in rollouts],
        "length": [rollout.length for rollout in rollouts],
        "style": [rollout.style_episode for rollout in rollouts],
        "match": [match(rollout) for rollout in rollouts],
    }


def _scene_columns(
    found: SceneRollouts, demonstrated: list[str], rule: BehaviorRule, task: Task
) -> dict[str, list]:
    """Matches of policies without styles, too (by chance), and of blind replay."""
    matches, replayed = scene_matches(found, demonstrated, rule, task)
    return {
        "match": list(map(int, matches)),
        "replay_success": [int(replay.success) for replay in found.replays],
        "replay_match": list(map(int, replayed)),
    }
