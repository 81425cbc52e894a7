"""Groups of episodes, and how many of them the data support.

Groups are those of Ward's hierarchical clustering. For every number of groups two questions are asked:

* Are the groups better separated than chance would make them? The mean silhouette s, corrected for the s₀
  that the same clustering finds in data without groups that have the same spread in the same directions
  (normal and uniform, the higher of the two): (s - s₀) / (1 - s₀). This is the idea of the gap statistic.
  It has to be large, and large compared with what it varies by in data without groups.
* Would other episodes have given the same groups? The mean adjusted Rand index with clusterings of 80 %.

The fewest groups whose product of the two is the largest, up to a part of its standard error, are taken, if
both are large enough; otherwise there is one group. Each group is then looked at by itself, more strictly,
since large differences hide small ones.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist, squareform
from sklearn.metrics import adjusted_rand_score, silhouette_samples
from sklearn.neighbors import NearestNeighbors

MOST_GROUPS = 50
FEWEST_EACH = 3  # episodes of a group, on average
LOOKED_AT = 1000  # episodes, drawn at random, by which the number of groups is chosen
CLUSTERED = 10_000  # episodes that are clustered; further ones join the group of the nearest of these
DRAWS = (4, 24)  # least and most data sets without groups, of each kind, and subsamples, ...
DRAWN = 2500  # ... as many as hold so many episodes together
SHARE = 0.8  # of the episodes, in a subsample
LEAST_SEPARATION, LEAST_STABILITY = 0.1, 0.85
WITHIN_SEPARATION, WITHIN_STABILITY = 0.3, 0.95  # for groups within a group
CLEAR = 0.25  # separation from which on groups are clear
BEYOND_CHANCE = 1.5, 5.0  # standard deviations beyond chance, of groups that are clear, and of others
WITHIN_ERROR = 0.5  # standard errors by which the score of fewer groups may be lower than the largest one
SMALLEST_PARENT = 10  # episodes of a group that is looked at by itself


@dataclass(frozen=True)
class Support:
    """How well the data support each number of groups.

    Attributes:
        numbers: (M,) numbers of groups.
        silhouettes: (M, N) of each episode, corrected for chance.
        chance: (M,) standard deviation of the mean silhouette in data without groups, in the same units.
        stability: (M,) agreement of subsamples.
    """

    numbers: np.ndarray
    silhouettes: np.ndarray
    chance: np.ndarray
    stability: np.ndarray

    @property
    def separation(self) -> np.ndarray:
        """(M,) mean silhouettes."""
        return self.silhouettes.mean(axis=1)

    @property
    def score(self) -> np.ndarray:
        """(M,) separation times stability."""
        return self.separation.clip(0) * self.stability.clip(0)

    def supported(self, least_separation: float, least_stability: float) -> np.ndarray:
        """(M,) bool, numbers of groups that are separated, beyond chance, and stable."""
        far = np.where(self.separation >= CLEAR, *BEYOND_CHANCE)
        return (
            (self.separation >= least_separation)
            & (self.separation >= far * self.chance)
            & (self.stability >= least_stability)
        )

    def best(self, least_separation: float, least_stability: float) -> tuple[int, float]:
        """The fewest supported groups of about the largest score, and this; (1, 0) if none is supported."""
        good = self.supported(least_separation, least_stability)
        if not good.any():
            return 1, 0.0
        largest = int(np.where(good, self.score, -1.0).argmax())
        differences = self.silhouettes[largest] - self.silhouettes  # (M, N)
        errors = differences.std(axis=1) / np.sqrt(differences.shape[1])
        enough = self.score >= self.score[largest] - WITHIN_ERROR * errors
        place = int(np.flatnonzero(good & enough)[0])
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
    numbers, count = np.arange(2, min(most, len(points) // FEWEST_EACH) + 1), len(points)
    if not len(numbers) or not points.std(axis=0).any():
        return Support(numbers[:0], np.zeros((0, count)), np.zeros(0), np.zeros(0))
    silhouettes, groups = _silhouettes(points, numbers)
    spread, draws = points.std(axis=0), int(np.clip(DRAWN // count, *DRAWS))
    kinds: list[Callable[[], np.ndarray]] = [
        lambda: rng.standard_normal(points.shape) * spread,
        lambda: rng.uniform(-(3**0.5), 3**0.5, points.shape) * spread,
    ]
    by_chance = np.array(  # (2, draws, M)
        [[_silhouettes(draw(), numbers)[0].mean(axis=1) for _ in range(draws)] for draw in kinds]
    )
    kind, number = by_chance.mean(axis=1).argmax(axis=0), np.arange(len(numbers))
    mean = by_chance.mean(axis=1)[kind, number]
    agreement = []
    for _ in range(draws):
        part = rng.choice(count, int(SHARE * count), replace=False)
        parts = _cuts(linkage(points[part], "ward"), numbers)
        agreement.append(
            [adjusted_rand_score(whole[part], own) for whole, own in zip(groups, parts, strict=True)]
        )
    return Support(
        numbers,
        (silhouettes - mean[:, None]) / (1 - mean[:, None]),
        by_chance.std(axis=1, ddof=1)[kind, number] / (1 - mean),
        np.mean(agreement, axis=0),
    )


def _cuts(tree: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """(M, N) groups 0, 1, … of a tree, for each number of groups."""
    return np.stack([fcluster(tree, number, "maxclust") - 1 for number in numbers])


def _silhouettes(points: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, N) silhouette of each point for each number of groups, and (M, N) its group."""
    condensed = pdist(points)
    groups, distances = _cuts(linkage(condensed, "ward"), numbers), squareform(condensed)
    values = np.zeros(groups.shape)
    for m, group in enumerate(groups):
        if 0 < group.max() < len(points) - 1:
            values[m] = silhouette_samples(distances, group, metric="precomputed")
    return values, groups


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
            number, _ = support(places, rng).best(WITHIN_SEPARATION, WITHIN_STABILITY)
            parts = split(places, number)
        if parts.any():
            waiting += [members[parts == part] for part in np.unique(parts)]
        else:
            result[members] = found
            found += 1
    return result
