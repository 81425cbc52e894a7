"""Builds the cells of the experiments: the training of a policy, and what is measured on it.

What a cell is and how it is called follow from complete configurations, so that whoever asks for the same
thing, in whatever words, gets the same cell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig

from lerobot_swr.evaluation.scenes import SceneKind
from lerobot_swr.policies.backbones.registry import BackboneConfig
from lerobot_swr.reproduction.baselines import BASELINES
from lerobot_swr.reproduction.cells import Cell, Labels
from lerobot_swr.reproduction.demonstrations import Demonstrations, whole_environment
from lerobot_swr.reproduction.settings import ReproductionSettings
from lerobot_swr.reproduction.training import STACKED

EVALUATION_SEED = 1000
BACKBONE = "backbone."  # before the names of a backbone's options
PLAYBACK = "playback"  # with feedback: the baseline without a policy


def training(
    settings: ReproductionSettings,
    demos: Demonstrations,
    policy: str,
    options: Mapping[str, Any] | None = None,
    steps: int | None = None,
    seeds: int | None = None,
) -> Cell:
    """A training cell.

    Args:
        settings: Steps, seeds and options.
        demos: The dataset.
        policy: Type of the policy.
        options: Options beyond the settings'.
        steps: Instead of the settings'.
        seeds: Instead of the settings'.
    """
    recipe: Mapping[str, Any] = {}
    if policy in STACKED:
        given = {**settings.policy_options, **(options or {})}
        batch_size, default_steps, default_seeds = settings.batch_size, settings.steps, settings.seeds
    else:
        baseline = BASELINES[policy]
        recipe, batch_size, given = baseline.options, baseline.batch_size, {}
        default_steps, default_seeds = getattr(settings, baseline.steps), settings.baseline_seeds
    make = PreTrainedConfig.get_choice_class(policy)
    unknown = sorted({key.split(".")[0] for key in given} - {option.name for option in fields(make)})
    if unknown:
        raise ValueError(
            f"policy_options={dict(settings.policy_options)}: {policy!r} has no option {unknown[0]!r}; "
            "choose the policies that have it with --policies=[...]"
        )

    config, usual = _all_options(make, {**recipe, **given}), _all_options(make, recipe)
    differing = {key: config[key] for key in config if key in given and config[key] != usual[key]}
    definition = {
        "fingerprint": demos.fingerprint,
        "policy": policy,
        "options": {**recipe, **differing},
        # Whole, so that a default that changes with the package makes another cell.
        "config": config,
        "batch_size": batch_size,
        "steps": steps or default_steps,
        "seeds": list(range(seeds or default_seeds)),
    }
    return Cell("train", Labels(demos.name, variant_name(policy, differing), "training"), definition)


def _all_options(make: type[PreTrainedConfig], given: Mapping[str, Any]) -> dict[str, Any]:
    """All options of a policy, encoded; those of its backbone are called ``backbone.<option>``."""
    plain = {key: value for key, value in given.items() if not key.startswith(BACKBONE)}
    inner = {key.removeprefix(BACKBONE): value for key, value in given.items() if key.startswith(BACKBONE)}
    if inner:
        plain["backbone"] = draccus.decode(BackboneConfig, inner)
    options = draccus.encode(make(device="cpu", push_to_hub=False, **plain), PreTrainedConfig)
    backbone = options.pop("backbone", {})
    return {**{BACKBONE + key: value for key, value in backbone.items()}, **options}


def variant_name(policy: str, differing: Mapping[str, Any]) -> str:
    """A policy's name with the options that differ from its usual ones."""
    values = {key: f"{v:g}" if isinstance(v, float) else str(v) for key, v in differing.items()}
    return " ".join([policy, *(f"{key.removeprefix(BACKBONE)}={value}" for key, value in values.items())])


def evaluation(
    settings: ReproductionSettings,
    demos: Demonstrations,
    trained: Cell,
    condition: str,
    env: Mapping[str, Any] | None = None,
    protocols: Sequence[str] = ("uniform", "stratified"),
    style_filter: str | None = None,
    one_scene: bool = False,
    scenes: SceneKind | None = None,
) -> Cell:
    """An evaluation cell on a training.

    Of what ``table1`` asks for, in whatever suite, it keeps the paths of the first seed's last rollouts, for
    pictures: a policy as the settings train it, the environment as it is, all styles.

    Args:
        settings: Number of rollouts.
        demos: The dataset.
        trained: The training cell.
        condition: How it is called.
        env: Options of the environment beyond its type and task.
        protocols: Ways of drawing styles; policies without styles are rolled out once.
        style_filter: Only styles of demonstrations that match.
        one_scene: All rollouts of a training seed meet one scene, instead of each its own.
        scenes: ``own``: each rollout meets the scene of its style's demonstration; ``new``: one that nobody
            demonstrated. Either has blind replay beside it.
    """
    policy = trained.definition["policy"]
    has_styles = hasattr(PreTrainedConfig.get_choice_class(policy), "style_sampling")
    rolled_out = _rolled_out(settings, demos, env, protocols if has_styles else ("uniform",))
    as_it_is = rolled_out["env"] == whole_environment(demos.env) and not one_scene and scenes is None
    pictured = style_filter is None and as_it_is
    definition = {
        **rolled_out,
        "style_filter": style_filter,
        "paths": pictured and trained == training(settings, demos, policy),
        **({"one_scene": True} if one_scene else {}),
        **({"scenes": scenes} if scenes is not None else {}),
    }
    return Cell("evaluate", Labels(demos.name, trained.labels.policy, condition), definition, trained)


def playback(
    settings: ReproductionSettings,
    demos: Demonstrations,
    condition: str,
    env: Mapping[str, Any] | None = None,
    protocols: Sequence[str] = ("uniform", "stratified"),
) -> Cell:
    """An evaluation cell of playback with feedback, which needs no training.

    As many rollouts as those of a policy, with the same starts and noise.

    Args:
        settings: Number of rollouts and seeds.
        demos: The dataset.
        condition: How it is called.
        env: Options of the environment beyond its type and task.
        protocols: Ways of drawing demonstrations.
    """
    definition = {
        **_rolled_out(settings, demos, env, protocols),
        "fingerprint": demos.fingerprint,
        "baseline": PLAYBACK,
        "seeds": list(range(settings.seeds)),
        "style_filter": None,
        "paths": False,
    }
    return Cell("evaluate", Labels(demos.name, PLAYBACK, condition), definition)


def _rolled_out(
    settings: ReproductionSettings,
    demos: Demonstrations,
    env: Mapping[str, Any] | None,
    protocols: Sequence[str],
) -> dict[str, Any]:
    """What defines rollouts apart from who acts."""
    stratified = _stratified_rollouts(settings.n_rollouts, len(demos.lengths))
    return {
        "env": whole_environment({**demos.env, **(env or {})}),
        "protocols": {p: stratified if p == "stratified" else settings.n_rollouts for p in protocols},
        "seed": EVALUATION_SEED,
    }


def _stratified_rollouts(n_rollouts: int, n_demonstrations: int) -> int:
    """As many as asked for, or fewer so that every style is used equally often."""
    if n_demonstrations > n_rollouts:
        return n_rollouts
    return n_rollouts - n_rollouts % n_demonstrations
