"""How many groups: as many as there are, not more, and whatever the seed."""

import numpy as np
import pytest
from ways import STATE, dataset, one_way, three_ways, way

from lerobot_swr.discovery.clusters import split, support
from lerobot_swr.discovery.discover import discover
from lerobot_swr.discovery.sources import Source

ENV_STATE = "observation.environment_state"


@pytest.mark.parametrize("count", [12, 20, 50])
def test_one_way_is_one_behaviour(count: int):
    """Spread-out starts and noise do not make several behaviours of one, in small datasets either."""
    assert len(discover(dataset(one_way(count, seed=1)), Source((STATE,))).names) == 1


@pytest.mark.parametrize("seed", range(3))
def test_one_way_along_a_line_is_one_behaviour(seed: int):
    """States of one dimension, at paces of all kinds, are one way."""
    rng = np.random.default_rng(seed)
    line = np.linspace(0, 1, 60)
    powers = rng.uniform(0.8, 1.2, 30)
    episodes = [(line**power + 0.01 * rng.standard_normal(60))[:, None] for power in powers]
    assert len(discover(dataset(episodes), Source((STATE,))).names) == 1


@pytest.mark.parametrize("seed", [1, 2])
def test_one_way_around_things_that_lie_at_random_is_one_behaviour(seed: int):
    """Places of objects and goals, in themselves or in the paths, make no behaviours."""
    rng = np.random.default_rng(seed)
    things, goals = 0.5 + rng.uniform(-0.2, 0.2, (50, 2)), rng.uniform(-0.2, 0.2, 50)
    episodes, scenes = [], []
    for thing, goal in zip(things, goals, strict=True):
        path = way(thing + np.array([0.15, 0.1]) + 0.02 * rng.standard_normal(2), rng)
        episodes.append(path + np.linspace(0, 1, len(path))[:, None] * np.array([[0.0, goal]]))
        scenes.append(np.tile([*thing, goal], (len(path), 1)))
    data = dataset(episodes, **{ENV_STATE: scenes})
    assert len(discover(data, Source((STATE, ENV_STATE))).names) == 1


def test_the_number_does_not_depend_on_the_seed():
    """Whatever is drawn for the comparison with chance, three ways are three and one is one."""
    ways, one = dataset(three_ways(20, seed=1)[0]), dataset(one_way(20))
    for seed in range(3):
        assert len(discover(ways, Source((STATE,)), seed=seed).names) == 3
        assert len(discover(one, Source((STATE,)), seed=seed).names) == 1


def test_support_finds_the_number_of_clouds():
    """Clouds of points are counted; a single one, normal or uniform, is not split."""
    rng = np.random.default_rng(0)
    centres = rng.uniform(-10, 10, (5, 3))
    points = np.concatenate([centre + rng.standard_normal((20, 3)) for centre in centres])
    assert support(points, rng).best(0.05, 0.85)[0] == 5
    assert len(np.unique(split(points, 5))) == 5
    assert support(points, rng).supported(0.05, 0.85)[3]
    for cloud in (rng.standard_normal((80, 3)), rng.uniform(size=(80, 3))):
        assert support(cloud, rng).best(0.05, 0.85)[0] == 1
