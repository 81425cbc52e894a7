"""How much scenes differ: what of the first observation differs from demonstration to demonstration.

A scene is what differs at the start and is not the demonstrator's choice: poses of objects, the goal, the
start. Sensors' noise differs, too; a scene is still there in the next frame.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

SMALLEST_SHARE = 0.05  # of a dimension's standard deviation: what differs less at the start says no scene
LARGE_SHARE = 0.3  # from which on scenes are said to vary
MOST_FRAMES = 200_000  # that give the standard deviations of all
SPOILED = 0.05  # of the demonstrations, which may begin anywhere
NOISE = 2.0  # how many times its change to the next frame a difference between starts must be

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SceneVariation:
    """How each dimension of the observation varies at the start.

    Attributes:
        shares: (d,) spread of the first frames over the standard deviation of all frames; 0 where that is
            noise, or little, or nothing.
        names: d names of the dimensions.
    """

    shares: np.ndarray
    names: tuple[str, ...]

    @property
    def vary(self) -> bool:
        """Whether scenes differ so much that a policy has to look at them."""
        return bool((self.shares >= LARGE_SHARE).any())

    def describe(self) -> str:
        """A sentence."""
        large = np.flatnonzero(self.shares >= LARGE_SHARE)
        if not len(large):
            return "Scenes vary little: demonstrations begin nearly alike, as far as their numbers tell."
        named = [self.names[k] for k in large[:6]] + (["..."] if len(large) > 6 else [])
        return (
            f"Scenes vary: at the start {len(large)} of {len(self.shares)} dimensions of the observation "
            f"({', '.join(named)}) differ between demonstrations, by {self.shares[large].mean():.2f} of "
            "their standard deviation."
        )


def robust_spread(values: np.ndarray) -> np.ndarray:
    """(d,) standard deviation of (N, d) values without the few that are farthest from the median.

    One demonstration that was recorded backwards does not make a fixed start a varying one.
    """
    count = len(values)
    left_out = min(int(np.ceil(SPOILED * count)), (count - 1) // 2)
    nearest = np.argsort(np.abs(values - np.median(values, axis=0)), axis=0, kind="stable")
    return np.take_along_axis(values, nearest[: count - left_out], axis=0).std(axis=0)


def scene_variation(
    frames: np.ndarray, lengths: np.ndarray, names: Sequence[str] | None = None
) -> SceneVariation:
    """Measure how scenes vary.

    Args:
        frames: (F, d) observations, episodes one after the other.
        lengths: (N,) frames per episode.
        names: Of the d dimensions; by default their numbers.
    """
    starts = np.cumsum(lengths) - lengths
    first = frames[starts].astype(np.float64)
    second = frames[starts + np.minimum(1, lengths - 1)].astype(np.float64)
    some = frames[:: -(-len(frames) // MOST_FRAMES)]  # no second copy of very many
    spread, overall = robust_spread(first), some.std(axis=0, dtype=np.float64)
    changes = second - first
    change = robust_spread(np.concatenate([changes, -changes]))  # about 0
    shares = np.divide(spread, overall, out=np.zeros_like(spread), where=overall > 0)
    rounding = 1e-6 * np.abs(first).max(axis=0, initial=0)
    shares[(shares < SMALLEST_SHARE) | (spread < NOISE * change) | (spread <= rounding)] = 0
    return SceneVariation(shares, tuple(names) if names is not None else tuple(map(str, range(len(shares)))))
