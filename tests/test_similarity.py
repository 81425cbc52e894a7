"""Dissimilarities, weights and their cache."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_swr import similarity
from lerobot_swr.similarity import (
    CACHE_FOLDER,
    cached_distances,
    dissimilarity_matrix,
    pairwise_distances,
    similarity_weights,
)
from lerobot_swr.trajectories import Trajectories, load_trajectories

KEYS = ["observation.state"]


def oracle_distances(states: list[np.ndarray]) -> np.ndarray:
    """The definition, frame by frame in float64: every episode padded to the longest one's length."""
    longest = max(len(episode) for episode in states)
    distances = np.zeros((len(states), len(states)))
    for i, a in enumerate(states):
        for j, b in enumerate(states):
            for t in range(longest):
                difference = a[min(t, len(a) - 1)].astype(np.float64) - b[min(t, len(b) - 1)]
                distances[i, j] += float(difference @ difference)
    return np.sqrt(distances)


def random_states(seed: int, lengths: list[int], dim: int = 3) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(length, dim)).astype(np.float32) for length in lengths]


episodes = st.lists(
    st.integers(1, 6).flatmap(
        lambda length: arrays(np.float32, (length, 2), elements=st.floats(-100, 100, width=32))
    ),
    min_size=1,
    max_size=6,
)


def test_distances_equal_the_definition_for_episodes_of_different_length():
    """Padding by the last state, against a frame-by-frame float64 oracle."""
    states = random_states(0, [5, 1, 9, 7, 9])
    np.testing.assert_allclose(pairwise_distances(states), oracle_distances(states), rtol=1e-12)


def test_small_distances_between_large_states_keep_their_digits():
    """The Gram trick would lose these; direct differences must not."""
    states = random_states(1, [20] * 3, dim=4)
    states = [states[0] + 1000, states[0] + 1000 + np.float32(2**-10), states[1] + 1000]
    np.testing.assert_allclose(pairwise_distances(states), oracle_distances(states), rtol=1e-9)


def test_blocks_of_time_do_not_change_the_result(monkeypatch):
    """The blocked computation gives what one block gives."""
    states = random_states(2, [30, 11, 23, 4])
    whole = pairwise_distances(states)
    monkeypatch.setattr(similarity, "BLOCK_ELEMENTS", 4 * 3 * 7)
    np.testing.assert_allclose(pairwise_distances(states), whole, rtol=1e-12)


def test_row_normalization_follows_the_paper():
    """ν(i, j) = d(i, j) / max_k d(i, k), hence not symmetric."""
    states = random_states(3, [4, 6, 5])
    distances = oracle_distances(states)
    expected = [[distances[i, j] / max(distances[i]) for j in range(3)] for i in range(3)]
    nu = dissimilarity_matrix(states, "row")
    np.testing.assert_allclose(nu, expected, rtol=1e-12)
    assert not np.allclose(nu, nu.T)


@settings(max_examples=50)
@given(episodes)
def test_dissimilarities_are_bounded_and_zero_on_the_diagonal(states):
    """For any episodes: 0 on the diagonal, in [0, 1], never NaN; symmetric under global normalisation."""
    row, whole = dissimilarity_matrix(states, "row"), dissimilarity_matrix(states, "global")
    for nu in (row, whole):
        assert (np.diag(nu) == 0).all()
        assert ((nu >= 0) & (nu <= 1)).all()
    np.testing.assert_allclose(whole, whole.T)
    varied = row.max(axis=1) > 0
    assert (row.max(axis=1)[varied] == 1).all()


def test_duplicate_episodes_have_distance_zero_and_identical_datasets_no_nan():
    """Equal episodes are at distance exactly 0, also when all are equal or there is only one."""
    a, b = random_states(4, [7, 9])
    distances = pairwise_distances([a, b, a])
    assert distances[0, 2] == 0
    assert distances[0, 1] > 0
    assert (dissimilarity_matrix([a, a, a]) == 0).all()
    assert dissimilarity_matrix([a]).tolist() == [[0.0]]


def test_weights_are_one_without_temperature_and_an_indicator_for_a_large_one():
    """β = 0 treats all demonstrations alike; β → ∞ leaves each to itself."""
    nu = dissimilarity_matrix(random_states(5, [4, 4, 4]))
    assert (similarity_weights(nu, 0.0) == 1).all()
    np.testing.assert_allclose(similarity_weights(nu, 1e6), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(similarity_weights(np.array([0.5]), 10.0), [np.exp(-5.0)])


@pytest.mark.parametrize("beta", [-1.0, float("nan"), float("inf")])
def test_a_bad_temperature_is_named(beta):
    """The error names key and value."""
    with pytest.raises(ValueError, match="beta="):
        similarity_weights(np.zeros(1), beta)


def test_bad_states_are_named():
    """NaN, empty episodes, other dimensions and unknown normalisations are refused by name."""
    good = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"states\[1\] holds NaN"):
        dissimilarity_matrix([good, np.full((2, 2), np.nan)])
    with pytest.raises(ValueError, match=r"states\[1\] has shape \(0, 2\)"):
        dissimilarity_matrix([good, np.zeros((0, 2))])
    with pytest.raises(ValueError, match=r"states\[1\] has shape \(3, 5\)"):
        dissimilarity_matrix([good, np.zeros((3, 5))])
    with pytest.raises(ValueError, match="normalization='column'"):
        dissimilarity_matrix([good], "column")  # type: ignore[arg-type]


# --- cache ---


@pytest.fixture
def trajectories(small_maze_meta: LeRobotDatasetMetadata) -> Trajectories:
    return load_trajectories(small_maze_meta, KEYS)


def test_the_cache_is_used_when_intact(trajectories, tmp_path, monkeypatch):
    """The second call reads the file instead of computing."""
    first = cached_distances(trajectories, KEYS, tmp_path)
    monkeypatch.setattr(similarity, "pairwise_distances", lambda states: pytest.fail("computed again"))
    np.testing.assert_array_equal(cached_distances(trajectories, KEYS, tmp_path), first)


@pytest.mark.parametrize("damage", ["truncated", "empty", "flipped"])
def test_a_damaged_cache_is_computed_anew(trajectories, tmp_path, damage, caplog):
    """A half-written or altered file is not trusted, and is replaced."""
    expected = cached_distances(trajectories, KEYS, tmp_path)
    (file,) = (tmp_path / CACHE_FOLDER).iterdir()
    content = bytearray(file.read_bytes())
    if damage == "flipped":
        content[-3] ^= 0xFF
    file.write_bytes({"truncated": content[: len(content) // 2], "empty": b"", "flipped": content}[damage])
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(cached_distances(trajectories, KEYS, tmp_path), expected)
    assert "computed anew" in caplog.text
    caplog.clear()
    cached_distances(trajectories, KEYS, tmp_path)
    assert not caplog.text


def test_changed_states_meet_another_cache(trajectories, tmp_path):
    """The key is the content, so an edited dataset never meets a stale cache."""
    before = cached_distances(trajectories, KEYS, tmp_path)
    trajectories.columns["observation.state"][0, 0] += 0.5
    assert not np.array_equal(cached_distances(trajectories, KEYS, tmp_path), before)
    assert len(list((tmp_path / CACHE_FOLDER).iterdir())) == 2


def test_a_dataset_that_may_not_be_written_is_left_alone(trajectories, tmp_path, monkeypatch):
    """The cache goes to LeRobot's home where the dataset's folder is read-only."""
    home, dataset = tmp_path / "home", tmp_path / "dataset"
    dataset.mkdir(mode=0o555)
    monkeypatch.setattr(similarity, "HF_LEROBOT_HOME", home)
    cached_distances(trajectories, KEYS, dataset)
    assert list(dataset.iterdir()) == []
    assert len(list((home / CACHE_FOLDER).iterdir())) == 1


def test_several_may_race_for_the_cache(trajectories, tmp_path):
    """Writers at the same time agree and leave one intact file, no temporary ones."""
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: cached_distances(trajectories, KEYS, tmp_path), range(8)))
    for result in results:
        np.testing.assert_array_equal(result, results[0])
    assert [file.suffix for file in (tmp_path / CACHE_FOLDER).iterdir()] == [".safetensors"]
