"""Behaviours are found without labels, in whatever order, speed and number they come."""

import os
from pathlib import Path

import numpy as np
import pytest
from sklearn.metrics import adjusted_rand_score

from lerobot_swr.discovery.clusters import split, support
from lerobot_swr.discovery.discover import OUTLIER, Discovery, discover, named
from lerobot_swr.discovery.paths import walk
from lerobot_swr.discovery.sources import Source
from lerobot_swr.trajectories import Trajectories

STATE = "observation.state"
REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", "../shared"))


def way(via: np.ndarray, rng: np.random.Generator, start: np.ndarray | None = None) -> np.ndarray:
    """(T, 2) from a start by way of a point to (1, 1), at a varying pace, with a pause."""
    frames = int(rng.integers(50, 120))
    corners = np.stack([np.zeros(2) if start is None else start, via, np.ones(2)])
    pace = np.exp(0.4 * rng.standard_normal(frames)).cumsum()
    place = (pace - pace[0]) / (pace[-1] - pace[0])
    place = np.insert(place, frames // 2, np.full(rng.integers(0, 15), place[frames // 2]))
    path = np.stack([np.interp(place, [0, 0.5, 1], corners[:, k]) for k in range(2)], axis=1)
    return path + 0.002 * rng.standard_normal(path.shape)


def dataset(episodes: list[np.ndarray], **more: list[np.ndarray]) -> Trajectories:
    """Episodes (T_i, d) as a dataset."""
    columns = {STATE: np.concatenate(episodes).astype(np.float32)}
    columns |= {key: np.concatenate(values).astype(np.float32) for key, values in more.items()}
    return Trajectories(np.array([len(e) for e in episodes]), columns, 10, "memory")


def three_ways(count: int = 40, seed: int = 0) -> tuple[list[np.ndarray], list[str]]:
    """Episodes over the left, the middle and the right, of unequal shares, and their labels."""
    rng = np.random.default_rng(seed)
    points = {"left": np.array([0.1, 0.9]), "middle": np.array([0.5, 0.5]), "right": np.array([0.9, 0.1])}
    labels = rng.choice(list(points), count, p=[0.5, 0.3, 0.2]).tolist()
    return [way(points[label] + 0.03 * rng.standard_normal(2), rng) for label in labels], labels


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


def test_one_way_is_one_behaviour():
    """Spread-out starts and noise do not make several behaviours of one."""
    rng = np.random.default_rng(1)
    episodes = [
        way(np.array([0.5, 0.6]) + 0.1 * rng.standard_normal(2), rng, rng.uniform(-0.2, 0.2, 2))
        for _ in range(50)
    ]
    assert len(discover(dataset(episodes), Source((STATE,))).names) == 1


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
    assert len(discover(dataset(episodes), Source((STATE,)), num_behaviors=2).names) == 2


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


def test_support_finds_the_number_of_clouds():
    """Clouds of points are counted; a single one, normal or uniform, is not split."""
    rng = np.random.default_rng(0)
    centres = rng.uniform(-10, 10, (5, 3))
    points = np.concatenate([centre + rng.standard_normal((20, 3)) for centre in centres])
    assert support(points, rng).best(0.05, 0.85)[0] == 5
    assert len(np.unique(split(points, 5))) == 5
    for cloud in (rng.standard_normal((80, 3)), rng.uniform(size=(80, 3))):
        assert support(cloud, rng).best(0.05, 0.85)[0] == 1


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
