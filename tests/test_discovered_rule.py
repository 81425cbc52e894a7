"""The rule that was found labels rollouts, which wait at their end or end a little early."""

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score
from ways import STATE, dataset, three_ways

from lerobot_swr.discovery.discover import OUTLIER, discover
from lerobot_swr.discovery.rule import DiscoveredRule
from lerobot_swr.discovery.sources import Source


@pytest.fixture(scope="module")
def rule() -> DiscoveredRule:
    """Of three ways."""
    found = discover(dataset(three_ways(60)[0]), Source((STATE,)))
    return DiscoveredRule(found.features, found.names, found.groups, found.places, found.reach)


@pytest.fixture(scope="module")
def rollouts() -> tuple[list[np.ndarray], list[str]]:
    """New episodes of the same ways, and their labels."""
    return three_ways(40, seed=9)


def waits(path: np.ndarray, frames: int) -> np.ndarray:
    """The path with its last state once more for some frames."""
    return np.concatenate([path, np.repeat(path[-1:], frames, axis=0)])


@pytest.mark.parametrize(
    "change",
    [
        lambda path: path,
        lambda path: waits(path, 50),
        lambda path: waits(path, 200),
        lambda path: path[: int(0.95 * len(path))],
        lambda path: path[: int(0.9 * len(path))],
    ],
    ids=["whole", "waits 50 frames", "waits 200 frames", "ends at 95 %", "ends at 90 %"],
)
def test_rollouts_of_a_way_belong_to_it(rule, rollouts, change: Callable[[np.ndarray], np.ndarray]):
    """Whether they go on standing after the task is done, or stop a little before a demonstration would."""
    paths, labels = rollouts
    told = [rule({STATE: change(path)}) for path in paths]
    assert told.count(OUTLIER) <= 2
    fits = np.array(told) != OUTLIER
    assert adjusted_rand_score(np.array(labels)[fits], np.array(told)[fits]) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda path: path[: len(path) // 2],
        lambda path: waits(path[: len(path) // 2], 200),
        lambda path: path[::-1],
    ],
    ids=["half", "stuck half way", "backwards"],
)
def test_rollouts_that_fail_are_outliers(rule, rollouts, change: Callable[[np.ndarray], np.ndarray]):
    """Half of a way is none, whether the rollout ends there or stands still."""
    told = [rule({STATE: change(path)}) for path in rollouts[0]]
    assert told.count(OUTLIER) >= 0.95 * len(told)
