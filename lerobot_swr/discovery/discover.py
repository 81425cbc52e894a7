"""From the episodes of a dataset to its behaviours."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_swr.discovery.clusters import (
    LEAST_SEPARATION,
    LEAST_STABILITY,
    MOST_GROUPS,
    WITHIN_SEPARATION,
    WITHIN_STABILITY,
    groups_within,
    split,
    support,
)
from lerobot_swr.discovery.features import (
    Features,
    Paths,
    Source,
    fit_features,
    main_directions,
    measure_paths,
)
from lerobot_swr.discovery.outliers import Manner, describe_manner, nearest_distance, reasons, suspicious
from lerobot_swr.trajectories import Trajectories

OUTLIER = "outlier"
LEAST_EPISODES = 4  # of a dataset in which behaviours are looked for
ROUNDS = 2  # the spread of everything is measured anew without the outliers
CLEARLY = 1.5  # times the score without the scene from which on the scene is left in
ROUNDING = 1.01  # of what is saved: known episodes are within reach, however far off the main directions
REACH = 2.0  # a new episode belongs to a behaviour up to this many times the largest distance within it


@dataclass(frozen=True)
class Discovery:
    """The behaviours of N episodes.

    Attributes:
        features: What they are compared by.
        groups: (N,) behaviour of each episode, 0 (the most frequent) to K - 1, or -1 for outliers.
        names: K names; behaviours of the same name are one.
        medoids: K typical episodes.
        reasons: Outlier to why it fits nowhere.
        places: (N, k) along the main directions of `features`.
        reach: (K,) largest distance at which a new episode still belongs to a behaviour.
        separation: Silhouette of the behaviours, corrected for chance; 0 for one.
        stability: Agreement of clusterings of 80 % of the episodes; 1 for one.
        supported: Whether the data show these groups; False for a given number of parts of one cloud.
        flat: (N, 2) places on a map.
        paths: What the episodes' paths look like.
    """

    features: Features
    groups: np.ndarray
    names: tuple[str, ...]
    medoids: tuple[int, ...]
    reasons: dict[int, str]
    places: np.ndarray
    reach: np.ndarray
    separation: float
    stability: float
    supported: bool
    flat: np.ndarray
    paths: Paths

    @property
    def labels(self) -> list[str]:
        """N labels."""
        return [self.names[g] if g >= 0 else OUTLIER for g in self.groups]


def discover(
    trajectories: Trajectories,
    source: Source,
    num_behaviors: int | None = None,
    min_episodes: int = 2,
    find_outliers: bool = True,
    seed: int = 0,
) -> Discovery:
    """Find the behaviours of a dataset.

    Args:
        trajectories: N episodes.
        source: What they are compared by.
        num_behaviors: K; None lets the data choose.
        min_episodes: Fewer than these are no behaviour but outliers.
        find_outliers: Look for episodes that fit nowhere; otherwise every one gets a behaviour.
        seed: Draws what the number of behaviours is judged by.

    Raises:
        ValueError: For too few episodes, or features that cannot be computed.
    """
    if len(trajectories) < LEAST_EPISODES:
        raise ValueError(
            f"dataset {trajectories.name} has {len(trajectories)} episodes; behaviours are told apart from "
            f"{LEAST_EPISODES} on"
        )
    if num_behaviors is not None and num_behaviors > len(trajectories):
        raise ValueError(f"num_behaviors={num_behaviors}: the dataset has {len(trajectories)} episodes only")
    rng = np.random.default_rng(seed)
    states = _states(trajectories, source)
    widths = [] if source.function else [trajectories.columns[key].shape[1] for key in source.keys]
    kept = np.ones(len(states), dtype=bool)
    for _ in range(ROUNDS if find_outliers else 0):
        paths = measure_paths(source, states, kept, widths)
        _, residuals = fit_features(paths, kept, len(paths.scene) > 0)
        kept = ~suspicious(paths.paths, residuals, _manner(paths, states), kept)
    paths = measure_paths(source, states, kept, widths)
    view = _best_view(paths, kept, num_behaviors, rng)
    if find_outliers:
        apart = suspicious(paths.paths, view.residuals, _manner(paths, states), kept)
        view = replace(view, groups=np.where(apart[kept], -1, view.groups))
        kept &= ~apart
    return _named(view, paths, _manner(paths, states), kept, min_episodes if find_outliers else 1)


def named(discovery: Discovery, names: Sequence[str]) -> Discovery:
    """The same behaviours under other names.

    Raises:
        ValueError: If there are more or fewer names than behaviours, or one is empty or means outliers.
    """
    if len(names) != len(discovery.names):
        raise ValueError(f"names={list(names)}: {len(names)} names for {len(discovery.names)} behaviours")
    for name in names:
        if not str(name).strip() or name == OUTLIER:
            raise ValueError(f"names: {name!r} is no name of a behaviour")
    return replace(discovery, names=tuple(map(str, names)))


@dataclass(frozen=True)
class _View:
    """One way of comparing the kept episodes, and the groups that it shows; -1 for none."""

    features: Features
    residuals: np.ndarray
    members: np.ndarray  # the episodes that were clustered
    groups: np.ndarray  # of the members
    score: float
    separation: float
    stability: float
    supported: bool


def _states(trajectories: Trajectories, source: Source) -> list[np.ndarray]:
    """N arrays (T, d) of the same d, or (1, d) for vectors."""
    states = []
    for i, episode in enumerate(trajectories.episodes()):
        try:
            states.append(source.states(episode))
        except ValueError as error:
            raise ValueError(f"episode {i}: {error}") from error
        if states[-1].shape[1] != states[0].shape[1]:
            raise ValueError(
                f"features={source.function!r}: {states[-1].shape[1]} numbers for episode {i}, "
                f"{states[0].shape[1]} for episode 0"
            )
    return states


def _manner(paths: Paths, states: Sequence[np.ndarray]) -> Manner | None:
    if paths.paths.shape[1] == 1:
        return None
    return describe_manner([paths.scaling.ways(paths.scaling(s)) for s in states], paths.paths)


def _best_view(paths: Paths, kept: np.ndarray, number: int | None, rng: np.random.Generator) -> _View:
    """Without the scene, or with it where that shows clearly better groups."""
    best = _view(paths, kept, number, rng, len(paths.scene) > 0)
    if len(paths.scene):
        whole = _view(paths, kept, number, rng, without_scene=False)
        clear = whole.separation >= WITHIN_SEPARATION and whole.stability >= WITHIN_STABILITY
        if clear and whole.score > CLEARLY * best.score:
            best = whole
    if number is not None or not best.groups.any():
        return best

    def main_places(rows: np.ndarray) -> np.ndarray:
        own = best.residuals[best.members[rows]]
        return (own - own.mean(axis=0)) @ main_directions(own).T

    return replace(best, groups=groups_within(best.groups, main_places, rng))


def _view(
    paths: Paths, kept: np.ndarray, number: int | None, rng: np.random.Generator, without_scene: bool
) -> _View:
    members = np.flatnonzero(kept)
    features, residuals = fit_features(paths, kept, without_scene)
    places = residuals[members] @ features.directions.T
    backing = support(places, rng, most=max(MOST_GROUPS, number or 0))
    found, _ = backing.best(LEAST_SEPARATION, LEAST_STABILITY)
    count = min(number or found, len(members))
    separation, stability, supported = 0.0, 1.0, count == 1
    for place in np.flatnonzero(backing.numbers == count):
        separation, stability = float(backing.separation[place]), float(backing.stability[place])
        supported = bool(backing.supported(LEAST_SEPARATION, LEAST_STABILITY)[place])
    score = max(separation, 0.0) * stability
    return _View(features, residuals, members, split(places, count), score, separation, stability, supported)


def _named(view: _View, paths: Paths, manner: Manner | None, kept: np.ndarray, least: int) -> Discovery:
    """Number the behaviours by their size, find typical episodes and give the reasons of the outliers."""
    count = len(kept)
    groups: np.ndarray = np.full(count, -1)
    groups[view.members] = view.groups
    numbers, sizes = np.unique(groups[groups >= 0], return_counts=True)
    if not (sizes >= least).any():
        least = int(sizes.max(initial=1))  # then the largest are behaviours
    behaviours = numbers[np.argsort(-sizes, kind="stable")]
    behaviours = behaviours[np.sort(-sizes, kind="stable") <= -least]
    order = {int(group): k for k, group in enumerate(behaviours)}
    small = {
        int(group): int(size) for group, size in zip(numbers, sizes, strict=True) if int(group) not in order
    }
    few = {i: small[int(groups[i])] for i in range(count) if int(groups[i]) in small}
    groups = np.array([order.get(int(group), -1) for group in groups])
    fits = groups >= 0
    outliers = np.flatnonzero(~fits).tolist()
    told = reasons(outliers, paths.paths, view.residuals, manner, fits)
    told |= {i: f"alone on its way ({few[i]} of a kind): {told[i]}" for i in outliers if i in few}
    places = view.residuals @ view.features.directions.T
    medoids, reach = [], []
    usual = float(np.median(nearest_distance(view.residuals, fits)[fits]))
    for k in range(len(behaviours)):
        members = np.flatnonzero(groups == k)
        middle = np.median(view.residuals[members], axis=0)
        medoids.append(int(members[np.linalg.norm(view.residuals[members] - middle, axis=1).argmin()]))
        within = nearest_distance(view.residuals[members], np.ones(len(members), bool))
        off = np.linalg.norm(view.residuals[members] - places[members] @ view.features.directions, axis=1)
        reach.append(max(REACH * max(float(within.max()), usual), ROUNDING * float(off.max())))
    return Discovery(
        view.features,
        groups,
        tuple(f"behavior {k + 1}" for k in range(len(behaviours))),
        tuple(medoids),
        told,
        places,
        np.array(reach),
        view.separation if len(behaviours) > 1 else 0.0,
        view.stability if len(behaviours) > 1 else 1.0,
        view.supported or len(behaviours) == 1,
        _map(places, fits),
        paths,
    )


def _map(places: np.ndarray, fits: np.ndarray) -> np.ndarray:
    """(N, 2) places along the two directions of largest variance."""
    flat = np.zeros((len(places), 2))
    own = (places - places[fits].mean(axis=0))[:, :2]
    flat[:, : own.shape[1]] = own
    return flat
