"""The paper's experiments as lists of cells: what is compared is fixed here, before any training."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.scenes import SceneKind
from lerobot_swr.reproduction.baselines import known_policies
from lerobot_swr.reproduction.cells import Cell, Labels
from lerobot_swr.reproduction.demonstrations import (
    HUMAN_DATASETS,
    Demonstrations,
    environment,
    whole_environment,
)
from lerobot_swr.reproduction.experiments import evaluation, playback, training
from lerobot_swr.reproduction.settings import ReproductionSettings
from lerobot_swr.reproduction.training import STACKED

TABLE1_DATASETS = (
    "medium_maze-one_side",
    "medium_maze-only_forward",
    "d3il_avoiding",
    "d3il_unbalanced_avoiding",
    "d3il_aligning",
    "d3il_unbalanced_aligning",
)
# Beyond the paper's only_forward, two datasets whose demonstrations of one behaviour cover more of the maze.
ROBUSTNESS_DATASETS = ("medium_maze-only_forward", "medium_maze-one_side", "medium_maze-spread_out")
CONTRACTING_DATASETS = (
    "medium_maze-only_forward",
    "medium_maze-spread_out",
    "d3il_avoiding",
    "d3il_aligning",
)
CONTROL_DATASETS = ("medium_maze-only_fast",)
FIGURES_DATASETS = ("medium_maze-only_forward",)
SCENES_DATASETS = ("scenes_maze-two_ways", "scenes_large_maze-six_ways")
DATASETS = {
    "table1": TABLE1_DATASETS,
    "robustness": ROBUSTNESS_DATASETS,
    "contracting": CONTRACTING_DATASETS,
    "control": CONTROL_DATASETS,
    "scenes": SCENES_DATASETS,
    "figures": FIGURES_DATASETS,
}
# In the suites where the folder of the human recordings is given.
HUMAN_AVOIDING, HUMAN_UNBALANCED_AVOIDING = HUMAN_DATASETS
WITH_RECORDINGS = {
    "table1": (HUMAN_AVOIDING, HUMAN_UNBALANCED_AVOIDING),
    "robustness": (HUMAN_AVOIDING,),
    "contracting": (HUMAN_AVOIDING,),
}

Conditions = dict[str, tuple[dict[str, Any], tuple[str, ...]]]
"""Name to the options of the environment and the ways of drawing styles."""

UNPERTURBED = "deterministic"
ONE_SCENE = "one scene"
SCENE_CONDITIONS: dict[SceneKind, str] = {"own": "own scenes", "new": "new scenes"}
BOTH_PROTOCOLS = ("uniform", "stratified")

# --- Robustness (the paper's Table 2) ---
CONDITIONS: dict[str, dict[str, Any]] = {
    UNPERTURBED: {},
    "pseudo-random start": {"start": "pseudo_random", "start_radius": 0.10},
    "random start": {"start": "random"},
    "transition noise": {"transition_noise": 1.0},
}
START_RADII = (0.05, 0.10, 0.15, 0.20)
NOISE_LEVELS = (0.5, 1.0, 1.5, 2.0)
# WZBC with other beta and p: see docs/reproduction.md on why the paper's values teach so little here.
ROBUST_WZBC: tuple[dict[str, Any], ...] = ({"p": 0.95}, {"beta": 3.0})
ROBUST_WZBC_DATASETS = ("medium_maze-spread_out",)

# --- Contracting styles: beyond the paper, docs/contracting.md ---
STICKY_WALLS: dict[str, dict[str, Any]] = {
    "sticky walls": {"sticky_walls": True},
    "sticky walls, noise 1": {"sticky_walls": True, "transition_noise": 1.0},
}
# Not wzbc with demos: other demonstrations teach its styles as it is.
CORRECTIVE = (("zbc", "noise"), ("zbc", "demos"), ("wzbc", "noise"))

# --- Control ---
LENGTH_BAND = (70, 80)

# --- Scenes: beyond the paper, docs/scenes.md ---
SCENES_POLICIES = ("bc", "act", "diffusion", "beso", "zbc", "wzbc")
# As published, and so that other demonstrations teach a style, too, in their scenes.
SCENES_WZBC: tuple[dict[str, Any], ...] = ({}, {"beta": 2.0})
# ZBC, and WZBC with corrective labels, with styles made of a similarity of manner; by type and task of the
# environment: what tells how it is done, wherever things lie.
SCENES_CORRECTIVE: dict[str, Any] = {"corrective": "noise", "corrective_scale": 0.05}
MANNERS: dict[tuple[str, str], dict[str, Any]] = {
    ("maze2d", "scenes"): {"similarity_features": "lerobot_swr.envs.maze2d.manner:scenes", "style_dim": 1},
    ("maze2d", "scenes_large"): {
        "similarity_features": "lerobot_swr.envs.maze2d.manner:scenes_large",
        "style_dim": 2,
    },
    ("d3il", "aligning"): {"similarity_frame": "box", "style_dim": 4},
}

# --- Figures ---
REFERENCES = 3
RHO_BETAS = (0.0, 3.0, 10.0, 100.0)
SWEEP_BETAS = (0.0, 3.0, 10.0, 30.0, 100.0)
SWEEP_PS = (0.2, 0.5, 0.8, 0.99)
PAPER_BETA, PAPER_P = 10.0, 0.8


def suite_datasets(suite: str, settings: ReproductionSettings) -> tuple[str, ...]:
    """The datasets of a suite; those of human recordings come first, where their folder is given."""
    human = WITH_RECORDINGS.get(suite, ()) if settings.from_d3il is not None else ()
    return (*human, *DATASETS[suite])


def suite_cells(suite: str, settings: ReproductionSettings, datasets: Sequence[Demonstrations]) -> list[Cell]:
    """The cells of a suite on some datasets, those that depend on a training after it."""
    build = {
        "table1": _table1,
        "robustness": _robustness,
        "contracting": _contracting,
        "control": _control,
        "scenes": _scenes,
        "figures": _figures,
    }
    cells = [cell for demos in datasets for cell in build[suite](settings, demos)]
    return list(dict.fromkeys(cell for one in cells for cell in (one.needs, one) if cell is not None))


def _table1(settings: ReproductionSettings, demos: Demonstrations) -> Iterable[Cell]:
    for policy in settings.choose_policies(known_policies()):
        trained = training(settings, demos, policy)
        yield evaluation(settings, demos, trained, UNPERTURBED)
        if task_of(environment(demos.env)).draws_scenes:
            # What the paper presumably does: its BC succeeds in all rollouts of a seed or in almost none.
            yield evaluation(settings, demos, trained, ONE_SCENE, protocols=("uniform",), one_scene=True)


def _robustness(settings: ReproductionSettings, demos: Demonstrations) -> Iterable[Cell]:
    conditions = _maze_conditions() if demos.env["type"] == "maze2d" else perturbations(demos)
    trained = [training(settings, demos, policy) for policy in settings.choose_policies(STACKED)]
    variants = ROBUST_WZBC if demos.name in ROBUST_WZBC_DATASETS else ()
    if "wzbc" in settings.choose_policies(STACKED):
        trained += [training(settings, demos, "wzbc", options) for options in variants]
    for one in dict.fromkeys(trained):
        for name, (env, protocols) in conditions.items():
            yield evaluation(settings, demos, one, name, env, protocols)
    values = [{"beta": PAPER_BETA, "p": PAPER_P, **options} for options in ({}, *variants)]
    yield _similarity(demos, (), [(v["beta"], v["p"]) for v in values])


def _maze_conditions() -> Conditions:
    """The paper's conditions, drawn both ways, and the other points of the curves."""
    curves: dict[str, dict[str, Any]] = {
        **{f"start radius {r:g}": {"start": "pseudo_random", "start_radius": r} for r in START_RADII},
        **{f"noise {level:g}": {"transition_noise": level} for level in NOISE_LEVELS},
    }
    conditions = {name: (env, BOTH_PROTOCOLS) for name, env in CONDITIONS.items()}
    known = list(CONDITIONS.values())
    return {**conditions, **_stratified({name: env for name, env in curves.items() if env not in known})}


def _stratified(conditions: Mapping[str, dict[str, Any]]) -> Conditions:
    return {name: (env, ("stratified",)) for name, env in conditions.items()}


def perturbations(demos: Demonstrations) -> Conditions:
    """The conditions of the suite ``contracting``, the environment as it is first.

    Raises:
        ValueError: If the dataset's environment has none.
    """
    if demos.env["type"] == "maze2d":
        return {**_maze_conditions(), **_stratified(STICKY_WALLS)}
    offered = task_of(environment(demos.env)).perturbations()
    if not offered:
        raise ValueError(f"datasets: {demos.name!r}: its environment names no perturbations")
    return {UNPERTURBED: ({}, BOTH_PROTOCOLS), **_stratified(offered)}


def _contracting(settings: ReproductionSettings, demos: Demonstrations) -> Iterable[Cell]:
    chosen = settings.choose_policies(("zbc", "wzbc"))
    if not chosen:
        return
    trained = [training(settings, demos, policy) for policy in chosen]
    for policy, kind in CORRECTIVE:
        if policy in chosen:
            trained.append(training(settings, demos, policy, {"corrective": kind}))
    for one in dict.fromkeys(trained):
        for name, (env, protocols) in perturbations(demos).items():
            yield evaluation(settings, demos, one, name, env, protocols)
    for name, (env, protocols) in perturbations(demos).items():
        yield playback(settings, demos, name, env, protocols)


def _control(settings: ReproductionSettings, demos: Demonstrations) -> Iterable[Cell]:
    low, high = LENGTH_BAND
    if not any(low <= length <= high for length in demos.lengths):
        raise ValueError(
            f"datasets: {demos.name!r} has no demonstration of {low} to {high} frames, which control needs"
        )
    for policy in settings.choose_policies(STACKED):
        trained = training(settings, demos, policy)
        yield evaluation(settings, demos, trained, UNPERTURBED)
        if policy != "bc":
            yield evaluation(
                settings,
                demos,
                trained,
                "controlled",
                protocols=("uniform",),
                style_filter=f"{low} <= length and length <= {high}",
            )


def _scenes(settings: ReproductionSettings, demos: Demonstrations) -> Iterable[Cell]:
    if not task_of(environment(demos.env)).draws_scenes:
        raise ValueError(f"datasets: {demos.name!r}: every episode of its environment has the same scene")
    known = [policy for policy in SCENES_POLICIES if policy in known_policies()]
    manner = MANNERS.get((demos.env["type"], demos.env["task"]))
    embedded: list[dict[str, Any]] = [] if manner is None else [{"style_init": "similarity", **manner}]
    corrected = [{**options, **SCENES_CORRECTIVE} for options in embedded]
    variants = {"wzbc": [*SCENES_WZBC, *corrected], "zbc": [{}, *embedded]}
    for policy in settings.choose_policies(tuple(known)):
        for options in variants.get(policy, [{}]):
            trained = training(settings, demos, policy, options)
            for kind, condition in SCENE_CONDITIONS.items():
                protocols = ("stratified", "scene") if kind == "new" else ("stratified",)
                yield evaluation(settings, demos, trained, condition, protocols=protocols, scenes=kind)


def _figures(settings: ReproductionSettings, demos: Demonstrations) -> Iterable[Cell]:
    yield _similarity(demos, RHO_BETAS, [(beta, PAPER_P) for beta in SWEEP_BETAS])
    for policy in settings.choose_policies(("zbc", "wzbc")):
        trained = training(settings, demos, policy)
        definition = {"env": whole_environment(demos.env)}
        yield Cell("styles", Labels(demos.name, policy, "styles"), definition, trained)
    if "wzbc" not in settings.choose_policies(STACKED):
        return
    sweep = [{"beta": beta, "p": PAPER_P} for beta in SWEEP_BETAS]
    sweep += [{"beta": PAPER_BETA, "p": p} for p in SWEEP_PS if p != PAPER_P]
    for options in sweep:
        trained = training(
            settings, demos, "wzbc", options, steps=settings.sweep_steps, seeds=settings.sweep_seeds
        )
        yield evaluation(settings, demos, trained, UNPERTURBED)


def _similarity(
    demos: Demonstrations, betas: Sequence[float], teaching: Sequence[tuple[float, float]]
) -> Cell:
    definition = {
        "fingerprint": demos.fingerprint,
        "env": whole_environment(demos.env),
        "references": REFERENCES,
        "betas": list(betas),
        "teaching": [list(pair) for pair in teaching],
    }
    return Cell("similarity", Labels(demos.name, "", "similarity" if betas else "teaching"), definition)
