"""Behaviours are found without labels, in whatever order, speed and number they come."""

import os
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score
from ways import STATE, dataset, one_way, three_ways, way

from lerobot_swr.discovery.discover import OUTLIER, Discovery, discover, named
from lerobot_swr.discovery.paths import walk
from lerobot_swr.discovery.report import compared_by, no_groups
from lerobot_swr.discovery.sources import Source
from lerobot_swr.trajectories import Trajectories

REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", "../shared"))


@pytest.fixture(scope="module")
def found() -> tuple[Discovery, list[np.ndarray], list[str]]:
    """The behaviours of three ways, their episodes and labels."""
    episodes, labels = three_ways()
    return discover(dataset(episodes), Source((STATE,))), episodes, labels


def test_ways_are_found_and_counted(found):
    """Three ways are three behaviours, whatever the speed and the pauses."""
    discovery, _, labels = found
    assert len(discovery.names) == 3
    assert adjusted_rand_score(labels, discovery.labels) == 1
    assert not discovery.reasons


def test_the_most_frequent_behaviour_is_the_first(found):
    """Behaviours are numbered by their size, and a typical episode is one of its behaviour's."""
    discovery, _, _ = found
    sizes = [discovery.labels.count(name) for name in discovery.names]
    assert sizes == sorted(sizes, reverse=True)
    assert all(discovery.groups[episode] == k for k, episode in enumerate(discovery.medoids))


def test_the_scene_is_no_behaviour():
    """Where an object lies at random, the way around it is found, not the place of the object."""
    rng = np.random.default_rng(2)
    episodes, scenes, labels = [], [], []
    for _ in range(60):
        thing, side = np.array([0.5, 0.5]) + rng.uniform(-0.3, 0.3, 2), rng.choice([-1, 1])
        episodes.append(way(thing + 0.15 * side * np.array([1.0, -1.0]), rng))
        scenes.append(np.tile(thing, (len(episodes[-1]), 1)))
        labels.append(side)
    key = "observation.environment_state"
    discovery = discover(dataset(episodes, **{key: scenes}), Source((STATE, key)))
    assert len(discovery.features.scene)
    assert len(discovery.names) == 2
    assert adjusted_rand_score(labels, discovery.labels) > 0.9


def test_where_one_begins_is_a_behaviour_if_that_shows_clearly():
    """Starts on one of two sides are two ways; the report says that the scene was left in."""
    rng = np.random.default_rng(4)
    sides = rng.choice([-1.0, 1.0], 30)
    starts = [np.array([0.2, -0.2]) * side + 0.01 * rng.standard_normal(2) for side in sides]
    episodes = [way(np.array([0.5, 0.5]) + 0.02 * rng.standard_normal(2), rng, start) for start in starts]
    discovery = discover(dataset(episodes), Source((STATE,)))
    assert adjusted_rand_score(sides, discovery.labels) == 1
    assert compared_by(discovery).endswith(
        "the scene at the start included, since that shows clearly better groups"
    )


def test_another_task_is_not_called_a_part_of_this_one():
    """A path that goes elsewhere is far from any, although its beginning is like the others'."""
    episodes, _ = three_ways(40, seed=3)
    elsewhere = way(np.array([-0.6, -0.5]), np.random.default_rng(0))
    elsewhere -= np.linspace(0, 1, len(elsewhere))[:, None] * np.array([2.0, 1.2])
    reason = discover(dataset([*episodes, elsewhere]), Source((STATE,))).reasons[40]
    assert reason.startswith("path far from any")


def test_spoiled_episodes_are_outliers_with_a_reason():
    """A cut, a reversed, a frozen and a noisy episode and another task fit nowhere; the good ones do."""
    episodes, labels = three_ways(60, seed=3)
    rng = np.random.default_rng(0)
    circle = np.linspace(0, 6 * np.pi, 80)
    spoiled = {
        "cut": episodes[0][: len(episodes[0]) // 2],
        "reversed": episodes[1][::-1],
        "frozen": np.repeat(episodes[2][:1], 70, axis=0),
        "noise": episodes[3] + 0.2 * rng.standard_normal(episodes[3].shape),
        "path": 0.5 + 0.8 * np.stack([np.sin(circle), np.cos(circle)], axis=1),
    }
    discovery = discover(dataset([*episodes[5:], *spoiled.values()]), Source((STATE,)))
    assert sorted(discovery.reasons) == list(range(55, 60))
    for episode, word in zip(range(55, 60), spoiled, strict=True):
        assert discovery.reasons[episode].startswith(word), discovery.reasons[episode]
    assert discovery.labels[55:] == [OUTLIER] * 5
    assert adjusted_rand_score(labels[5:], discovery.labels[:55]) == 1


def test_every_episode_gets_a_behaviour_if_no_outliers_are_wanted():
    """Without a look for outliers even a frozen episode has a label."""
    episodes, _ = three_ways(30, seed=4)
    episodes[7] = np.repeat(episodes[7][:1], 50, axis=0)
    discovery = discover(dataset(episodes), Source((STATE,)), num_behaviors=3, find_outliers=False)
    assert OUTLIER not in discovery.labels
    assert len(discovery.names) == 3


def test_the_number_of_behaviours_can_be_given():
    """K behaviours are made if K are asked for."""
    episodes, _ = three_ways(30, seed=5)
    two = discover(dataset(episodes), Source((STATE,)), num_behaviors=2)
    assert len(two.names) == 2
    assert not no_groups(two)


def test_parts_of_one_cloud_are_told():
    """Behaviours that were asked for where there is one way are said to be no groups."""
    parts = discover(dataset(one_way(30)), Source((STATE,)), num_behaviors=3)
    assert len(parts.names) == 3
    assert no_groups(parts).startswith("The data show no 3 groups: these behaviours are parts of one cloud")


def last_state(episode) -> np.ndarray:
    """Where an episode ends."""
    return episode[STATE][-1]


def turned(episode) -> np.ndarray:
    """(T, 2) along and across the diagonal."""
    return episode[STATE] @ np.array([[1.0, 1.0], [1.0, -1.0]])


@pytest.mark.parametrize(("function", "count"), [(turned, 3), (last_state, 1)])
def test_own_features(function, count):
    """A path or a vector of one's own is compared instead of the states."""
    episodes, labels = three_ways(40, seed=6)
    source = Source((), f"{__name__}:{function.__name__}")
    discovery = discover(dataset(episodes), source)
    assert len(discovery.names) == count
    assert (adjusted_rand_score(labels, discovery.labels) == 1) == (count == 3)


def bad_feature(episode) -> np.ndarray:
    """No array of numbers of one or two dimensions."""
    return np.full((2, 2, 2), np.nan)


def test_a_wrong_feature_is_named():
    """What a function returns wrongly is told with the function and the episode."""
    episodes, _ = three_ways(10)
    with pytest.raises(ValueError, match=r"episode 0: features='.*bad_feature' returns .*\(2, 2, 2\)"):
        discover(dataset(episodes), Source((), f"{__name__}:bad_feature"))


def test_too_few_episodes_are_refused():
    """Three episodes are no dataset with behaviours."""
    with pytest.raises(ValueError, match="3 episodes"):
        discover(dataset(three_ways(3)[0]), Source((STATE,)))


def test_names_can_be_given(found):
    """Names replace the numbers; one too few, or the name of outliers, is refused."""
    discovery, _, _ = found
    renamed = named(discovery, ["a", "b", "c"])
    assert set(renamed.labels) == {"a", "b", "c"}
    with pytest.raises(ValueError, match="2 names for 3"):
        named(discovery, ["a", "b"])
    with pytest.raises(ValueError, match="outlier"):
        named(discovery, ["a", "b", OUTLIER])


def test_pace_does_not_change_a_path():
    """A path with a pause, walked at an even pace, is that without one."""
    line = np.linspace(0, 1, 60)[:, None] * np.array([[1.0, 2.0]])
    paused = np.insert(line, 30, np.repeat(line[30:31], 60, axis=0), axis=0)
    assert np.abs(walk(line, 50) - walk(paused, 50)).max() < 0.1
    assert np.abs(walk(line, 50) - walk(line[::2], 50)).max() < 0.05


def test_waiting_is_no_way():
    """An episode that waits before it begins and after its end has the path of one that does not."""
    line = np.linspace(0, 1, 60)[:, None] * np.array([[1.0, 2.0]])
    waits = np.concatenate([np.repeat(line[:1], 80, axis=0), line, np.repeat(line[-1:], 200, axis=0)])
    assert np.abs(walk(line, 50) - walk(waits, 50)).max() < 0.05
    still = np.repeat(line[:1], 50, axis=0)
    assert np.array_equal(walk(still, 50), still)


def test_human_orders_of_inserting_are_found():
    """In D3IL's human recordings of inserting the six orders of the boxes are found."""
    file = REFERENCE / "human_demos" / "d3il_inserting_120.npz"
    if not file.is_file():
        pytest.skip(f"{file} is absent")
    archive = np.load(file)
    lengths = np.bincount(archive["episode_index"])
    discovery = discover(Trajectories(lengths, {STATE: archive["states"]}, 28, "inserting"), Source((STATE,)))
    assert abs(len(discovery.names) - 6) <= 2
    assert adjusted_rand_score(archive["behavior"], discovery.labels) >= 0.8
