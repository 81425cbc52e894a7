"""What an episode is compared by: its path, standardised, with or without what its scene explains.

A *scene* is what differs from episode to episode at the start and is not the person's choice. Where starts
differ, paths are also looked at without the part that the first state predicts (a ridge regression), so that
two episodes of the same manner in different scenes are alike.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from sklearn.linear_model import RidgeCV

from lerobot_swr.discovery.paths import beginnings, walk, walk_all
from lerobot_swr.discovery.sources import Episode, Source
from lerobot_swr.scene_variation import robust_spread

POINTS = 50
MOVES = 0.02  # least spread within episodes of a dimension that counts as moving, relative to all frames'
VARIES = 0.2  # least spread of first states in a dimension that is scene, relative to all frames'
KEPT = 0.99  # share of the variance that the main directions hold
MOST_DIRECTIONS = 10
EPISODES_A_TERM = 8  # of a scene's squares and products, which small datasets cannot tell
PENALTIES = np.logspace(-1, 4, 12)


@dataclass(frozen=True)
class Scaling:
    """Units in which all dimensions count alike.

    Attributes:
        source: Where the numbers come from.
        centre: (d,) mean of the states.
        spread: (d,) their standard deviation; 1 for constant dimensions.
        moving: (m,) dimensions that change within episodes; the others tell scenes at most.
        weights: (m,) of these in a path: a feature counts as much as another one, however wide it is.
    """

    source: Source
    centre: np.ndarray
    spread: np.ndarray
    moving: np.ndarray
    weights: np.ndarray

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """(T, d) standardised states.

        Raises:
            ValueError: If the states have other dimensions.
        """
        if states.shape[1] != len(self.centre):
            what = self.source.function or ", ".join(self.source.keys)
            raise ValueError(
                f"the behaviours were found in {len(self.centre)} dimensions of {what}; this episode has "
                f"{states.shape[1]}: give what was recorded like the dataset"
            )
        return (states - self.centre) / self.spread

    def ways(self, standardised: np.ndarray) -> np.ndarray:
        """(T, m) weighted moving dimensions of (T, d) standardised states."""
        return standardised[:, self.moving] * self.weights


@dataclass(frozen=True)
class Paths:
    """N episodes, standardised and resampled.

    Attributes:
        scaling: Their units.
        paths: (N, P, m) of the moving dimensions; P is 1 for vectors.
        firsts: (N, d) first states.
        scene: Dimensions of the first state that differ between episodes as scenes do; none for vectors.
    """

    scaling: Scaling
    paths: np.ndarray
    firsts: np.ndarray
    scene: np.ndarray


@dataclass(frozen=True)
class Embedded:
    """Where an episode lies.

    Attributes:
        place: (k,) along the main directions.
        off: Distance from what these span.
        path: (P·m,) its path.
        usual: (P·m,) the mean path of its scene.
    """

    place: np.ndarray
    off: float
    path: np.ndarray
    usual: np.ndarray


@dataclass(frozen=True)
class Features:
    """A fitted definition: maps an episode to a few numbers.

    Attributes:
        scaling: Units.
        points: P, points of a path; 1 for vectors.
        scene: Dimensions of the first state that are scene; none where it is not looked at.
        slope: (terms, P·m) what a unit of each adds to the path; see `scene_terms`.
        offset: (P·m,) the mean path (of the scene at the centre).
        directions: (k, P·m) orthonormal main directions of what is left.
    """

    scaling: Scaling
    points: int
    scene: np.ndarray
    slope: np.ndarray
    offset: np.ndarray
    directions: np.ndarray

    def embed(self, episode: Episode) -> Embedded:
        """Where an episode lies."""
        states = self.scaling(self.scaling.source.states(episode))
        ways = self.scaling.ways(states)
        path = (ways[:1] if self.points == 1 else walk(ways, self.points)).reshape(-1)
        usual = self.offset + scene_terms(states[:1, self.scene], len(self.slope))[0] @ self.slope
        residual = path - usual
        place = self.directions @ residual
        return Embedded(place, float(np.sqrt(max(residual @ residual - place @ place, 0.0))), path, usual)

    def beside(self, new: Embedded, places: np.ndarray, share: float) -> np.ndarray:
        """(N,) how far a new episode is from the first part, up to a share, of known ones in its scene.

        Args:
            new: The new episode.
            places: (N, k) of the known ones.
            share: Of their way.
        """
        known = (new.usual + places @ self.directions).reshape(len(places), self.points, -1)
        return np.linalg.norm(beginnings(known, share).reshape(len(places), -1) - new.path, axis=1)

    def to_json(self) -> dict[str, Any]:
        """As ``behaviors.json`` holds it."""
        return {
            "keys": list(self.scaling.source.keys),
            "function": self.scaling.source.function,
            "points": self.points,
            "moving": self.scaling.moving.tolist(),
            "scene": self.scene.tolist(),
            "centre": rounded(self.scaling.centre),
            "spread": rounded(self.scaling.spread),
            "weights": rounded(self.scaling.weights),
            **{name: rounded(getattr(self, name)) for name in ("slope", "offset", "directions")},
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Self:
        """Of what `to_json` gave."""
        arrays = {name: np.array(data[name], float) for name in ("centre", "spread", "weights", "offset")}
        width, scene = len(arrays["offset"]), np.array(data["scene"], int)
        scaling = Scaling(
            Source(tuple(data["keys"]), data["function"]),
            arrays["centre"],
            arrays["spread"],
            np.array(data["moving"], int),
            arrays["weights"],
        )
        return cls(
            scaling,
            int(data["points"]),
            scene,
            np.array(data["slope"], float).reshape(-1, width),
            arrays["offset"],
            np.array(data["directions"], float).reshape(-1, width),
        )


def measure_paths(
    source: Source, states: Sequence[np.ndarray], kept: np.ndarray, widths: Sequence[int] = ()
) -> Paths:
    """Standardise and resample episodes.

    Args:
        source: Where they come from.
        states: N arrays (T_i, d).
        kept: (N,) bool, the episodes whose spread counts.
        widths: How many of the d dimensions belong to each feature, in order; empty for one feature.

    Raises:
        ValueError: If nothing moves.
    """
    chosen = [s for s, keep in zip(states, kept, strict=True) if keep]
    frames = np.concatenate(chosen)
    centre, spread = frames.mean(axis=0), frames.std(axis=0)
    constant = spread <= 1e-6 * np.maximum(1.0, np.abs(centre))
    spread = np.where(constant, 1.0, spread)
    vectors = all(len(s) == 1 for s in states)
    within = np.sqrt(np.mean([s.var(axis=0) for s in chosen], axis=0))
    moving = np.flatnonzero(~constant if vectors else ~constant & (within > MOVES * spread))
    if not len(moving):
        raise ValueError(
            f"nothing moves in {source.function or ', '.join(source.keys)}: there are no ways to tell apart"
        )
    scaling = Scaling(source, centre, spread, moving, _weights(moving, widths))
    scaled = [scaling(s) for s in states]
    ways = [scaling.ways(s) for s in scaled]
    paths = np.stack(ways) if vectors else walk_all(ways, POINTS)
    firsts = np.stack([s[0] for s in scaled])
    firsts[:, constant] = 0.0
    varies = np.flatnonzero(robust_spread(firsts[kept]) > VARIES)
    return Paths(scaling, paths, firsts, varies[:0] if vectors else varies)


def _weights(moving: np.ndarray, widths: Sequence[int]) -> np.ndarray:
    """(m,) weights by which the moving dimensions of every feature have the same variance together."""
    if not widths:
        return np.ones(len(moving))
    feature = np.repeat(np.arange(len(widths)), widths)[moving]
    counts = np.bincount(feature, minlength=len(widths))
    return np.sqrt(len(moving) / (np.count_nonzero(counts) * counts[feature]))


def fit_features(paths: Paths, kept: np.ndarray, without_scene: bool) -> tuple[Features, np.ndarray]:
    """Fit what is common to the kept episodes.

    Args:
        paths: N episodes.
        kept: (N,) bool.
        without_scene: Subtract what the first state predicts.

    Returns:
        The definition, and (N, P·m) the paths of all episodes less the mean path (of their scenes).
    """
    flat = paths.paths.reshape(len(paths.paths), -1)
    scene = paths.scene if without_scene else np.array([], int)
    linear, quadratic = len(scene), len(scene) * (len(scene) + 3) // 2
    terms = scene_terms(
        paths.firsts[:, scene], quadratic if EPISODES_A_TERM * quadratic <= kept.sum() else linear
    )
    slope, offset = np.zeros((terms.shape[1], flat.shape[1])), flat[kept].mean(axis=0)
    if len(scene):
        fit = RidgeCV(alphas=PENALTIES).fit(terms[kept], flat[kept])
        slope, offset = fit.coef_.T, fit.intercept_
    residuals = flat - offset - terms @ slope
    directions = main_directions(residuals[kept])
    return Features(paths.scaling, paths.paths.shape[1], scene, slope, offset, directions), residuals


def scene_terms(firsts: np.ndarray, count: int) -> np.ndarray:
    """What the path is regressed on.

    Args:
        firsts: (N, s) scene dimensions of first states.
        count: s for these alone, s (s + 3) / 2 for their squares and products, too.

    Returns:
        (N, count).
    """
    if count == firsts.shape[1]:
        return firsts
    first, second = np.triu_indices(firsts.shape[1])
    return np.concatenate([firsts, firsts[:, first] * firsts[:, second]], axis=1)


def main_directions(residuals: np.ndarray) -> np.ndarray:
    """(k, D) orthonormal directions that hold most of the variance of (N, D) rows."""
    centred = residuals - residuals.mean(axis=0)
    if len(centred) < centred.shape[1]:
        _, values, directions = np.linalg.svd(centred, full_matrices=False)
        variance = values**2
    else:
        variance, vectors = np.linalg.eigh(centred.T @ centred)
        variance, directions = variance[::-1].clip(0), vectors.T[::-1]
    total = variance.sum()
    if total <= 0:
        return directions[:1]
    count = min(MOST_DIRECTIONS, int(np.searchsorted(np.cumsum(variance) / total, KEPT)) + 1)
    return directions[:count]


def rounded(values: np.ndarray) -> list[Any]:
    """Numbers of six significant digits, as nested lists."""
    return np.array([float(f"{v:.6g}") for v in np.ravel(values)]).reshape(np.shape(values)).tolist()
