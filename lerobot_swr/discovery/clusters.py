"""Groups of episodes, and how many of them the data support.

Groups are those of Ward's hierarchical clustering. For every number of groups two questions are asked:

* Are the groups better separated than chance would make them? The mean silhouette s, corrected for the s₀
  that the same clustering finds in data without groups that have the same spread in the same directions
  (normal and uniform, the higher of the two): (s - s₀) / (1 - s₀). This is the idea of the gap statistic.
* Would other episodes have given the same groups? The mean adjusted Rand index with clusterings of 80 %.

The number with the largest product is taken, if both are large enough; otherwise there is one group. Each
group is then looked at by itself, more strictly, since large differences hide small ones.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist, squareform
from sklearn.metrics import adjusted_rand_score, silhouette_score
from sklearn.neighbors import NearestNeighbors

MOST_GROUPS = 50
LOOKED_AT = 1000  # episodes, drawn at random, by which the number of groups is chosen
CLUSTERED = 10_000  # episodes that are clustered; further ones join the group of the nearest of these
REFERENCES = 4  # data sets without groups, of each kind
SUBSAMPLES, SHARE = 8, 0.8
LEAST_SEPARATION, LEAST_STABILITY = 0.1, 0.85
WITHIN_SEPARATION, WITHIN_STABILITY = 0.3, 0.95  # for groups within a group
SMALLEST_PARENT = 10  # episodes of a group that is looked at by itself


@dataclass(frozen=True)
class Support:
    """How well the data support each number of groups.

    Attributes:
        numbers: (M,) numbers of groups.
        separation: (M,) silhouettes corrected for chance.
        stability: (M,) agreement of subsamples.
    """

    numbers: np.ndarray
    separation: np.ndarray
    stability: np.ndarray

    @property
    def score(self) -> np.ndarray:
        """(M,) their product."""
        return self.separation.clip(0) * self.stability.clip(0)

    def best(self, least_separation: float, least_stability: float) -> tuple[int, float]:
        """The supported number with the largest score, and this; (1, 0) if none is supported."""
        good = (self.separation >= least_separation) & (self.stability >= least_stability)
        if not good.any():
            return 1, 0.0
        place = int(np.where(good, self.score, -1.0).argmax())
        return int(self.numbers[place]), float(self.score[place])


def support(points: np.ndarray, rng: np.random.Generator, most: int = MOST_GROUPS) -> Support:
    """Compare numbers of groups.

    Args:
        points: (N, k).
        rng: Draws what is compared with.
        most: The largest number of groups.
    """
    if len(points) > LOOKED_AT:
        points = points[rng.choice(len(points), LOOKED_AT, replace=False)]
    numbers = np.arange(2, min(most, len(points) // 2) + 1)
    if not len(numbers) or not points.std(axis=0).any():
        return Support(numbers[:0], np.zeros(0), np.zeros(0))
    silhouettes, groups = _silhouettes(points, numbers)
    spread = points.std(axis=0)
    draws: list[Callable[[], np.ndarray]] = [
        lambda: rng.standard_normal(points.shape) * spread,
        lambda: rng.uniform(-(3**0.5), 3**0.5, points.shape) * spread,
    ]
    chance = np.max(
        [np.mean([_silhouettes(draw(), numbers)[0] for _ in range(REFERENCES)], axis=0) for draw in draws],
        axis=0,
    )
    agreement = []
    for _ in range(SUBSAMPLES):
        part = rng.choice(len(points), int(SHARE * len(points)), replace=False)
        tree = linkage(points[part], "ward")
        agreement.append(
            [
                adjusted_rand_score(whole[part], fcluster(tree, number, "maxclust"))
                for number, whole in zip(numbers, groups, strict=True)
            ]
        )
    return Support(numbers, (silhouettes - chance) / (1 - chance), np.mean(agreement, axis=0))


def _silhouettes(points: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    condensed = pdist(points)
    tree, distances = linkage(points, "ward"), squareform(condensed)
    groups = [fcluster(tree, number, "maxclust") for number in numbers]
    values = [
        silhouette_score(distances, group, metric="precomputed") if len(np.unique(group)) > 1 else 0.0
        for group in groups
    ]
    return np.array(values), groups


def split(points: np.ndarray, number: int) -> np.ndarray:
    """(N,) group of each of (N, k) points, 0 to `number` - 1."""
    if number == 1 or len(points) < 2:
        return np.zeros(len(points), dtype=int)
    rng = np.random.default_rng(0)
    some: np.ndarray = np.arange(len(points))
    if len(points) > CLUSTERED:
        some = np.sort(rng.choice(len(points), CLUSTERED, replace=False))
    groups = fcluster(linkage(points[some], "ward"), number, "maxclust") - 1
    if len(some) == len(points):
        return groups
    nearest = (
        NearestNeighbors(n_neighbors=1).fit(points[some]).kneighbors(points, return_distance=False)[:, 0]
    )
    return groups[nearest]


def groups_within(
    groups: np.ndarray, main_places: Callable[[np.ndarray], np.ndarray], rng: np.random.Generator
) -> np.ndarray:
    """Split groups that clearly hold several.

    Args:
        groups: (N,) group of each episode.
        main_places: Maps the numbers of some episodes to their (n, k) places along their own main directions.
        rng: Draws what is compared with.

    Returns:
        (N,) groups 0, 1, …
    """
    result, waiting, found = groups.copy(), [np.flatnonzero(groups == g) for g in np.unique(groups)], 0
    while waiting:
        members = waiting.pop()
        parts = np.zeros(len(members), dtype=int)
        if len(members) >= SMALLEST_PARENT:
            places = main_places(members)
            number, _ = support(places, rng, most=len(members) // 3).best(WITHIN_SEPARATION, WITHIN_STABILITY)
            parts = split(places, number)
        if parts.any():
            waiting += [members[parts == part] for part in np.unique(parts)]
        else:
            result[members] = found
            found += 1
    return result
