"""Dissimilarities and weights by their definition, and who answers for few episodes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lerobot_swr.similarity import Dissimilarity, distances, similarity_of, similarity_weights
from lerobot_swr.similarity.distances import pairwise_distances
from lerobot_swr.similarity.measure import DenseSimilarity
from lerobot_swr.trajectories import Trajectories


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


def nu_matrix(states: list[np.ndarray], normalization: str = "row") -> np.ndarray:
    """ν of all pairs, as callers ask for it."""
    everyone = np.arange(len(states))
    similarity = DenseSimilarity(pairwise_distances(states))
    return Dissimilarity(similarity, everyone, normalization).nu(everyone[:, None], everyone)


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
    monkeypatch.setattr(distances, "BLOCK_ELEMENTS", 4 * 3 * 7)
    np.testing.assert_allclose(pairwise_distances(states), whole, rtol=1e-12)


def test_row_normalization_follows_the_paper():
    """ν(i, j) = d(i, j) / max_k d(i, k), hence not symmetric."""
    states = random_states(3, [4, 6, 5])
    apart = oracle_distances(states)
    expected = [[apart[i, j] / max(apart[i]) for j in range(3)] for i in range(3)]
    nu = nu_matrix(states)
    np.testing.assert_allclose(nu, expected, rtol=1e-12)
    assert not np.allclose(nu, nu.T)


@settings(max_examples=50)
@given(episodes)
def test_dissimilarities_are_bounded_and_zero_on_the_diagonal(states):
    """For any episodes: 0 on the diagonal, in [0, 1], never NaN; symmetric under global normalisation."""
    row, whole = nu_matrix(states), nu_matrix(states, "global")
    for nu in (row, whole):
        assert (np.diag(nu) == 0).all()
        assert ((nu >= 0) & (nu <= 1)).all()
    np.testing.assert_allclose(whole, whole.T)
    varied = row.max(axis=1) > 0
    assert (row.max(axis=1)[varied] == 1).all()


def test_duplicate_episodes_have_distance_zero_and_identical_datasets_no_nan():
    """Equal episodes are at distance exactly 0, also when all are equal or there is only one."""
    a, b = random_states(4, [7, 9])
    apart = pairwise_distances([a, b, a])
    assert apart[0, 2] == 0
    assert apart[0, 1] > 0
    assert (nu_matrix([a, a, a]) == 0).all()
    assert nu_matrix([a]).tolist() == [[0.0]]


def test_only_candidates_normalise():
    """The farthest candidate is at ν = 1, whoever is farther; globally the farthest pair of candidates."""
    line = DenseSimilarity(np.abs(np.subtract.outer([0.0, 1, 3, 7], [0.0, 1, 3, 7])))
    some = np.array([0, 1, 2])
    assert Dissimilarity(line, some).nu(np.array([0, 1]), np.array([2, 2])).tolist() == [1.0, 1.0]
    assert Dissimilarity(line, some, "global").nu(np.array([0, 1]), np.array([2, 2])).tolist() == [1, 2 / 3]


def test_weights_are_one_without_temperature_and_an_indicator_for_a_large_one():
    """β = 0 treats all demonstrations alike; β → ∞ leaves each to itself."""
    nu = nu_matrix(random_states(5, [4, 4, 4]))
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
        pairwise_distances([good, np.full((2, 2), np.nan)])
    with pytest.raises(ValueError, match=r"states\[1\] has shape \(0, 2\)"):
        pairwise_distances([good, np.zeros((0, 2))])
    with pytest.raises(ValueError, match=r"states\[1\] has shape \(3, 5\)"):
        pairwise_distances([good, np.zeros((3, 5))])
    with pytest.raises(ValueError, match="normalization='column'"):
        nu_matrix([good], "column")


# --- Few episodes ---


def test_the_nearest_come_by_distance_then_by_number_and_never_are_the_episode_itself():
    """Ties and duplicates on a line; among all, among some, and of an episode that is no candidate."""
    places = np.array([0.0, 2, 1, -1, 0])
    similarity = DenseSimilarity(np.abs(np.subtract.outer(places, places)))
    everyone = np.arange(5)
    found, apart = similarity.nearest(everyone, 3, everyone)
    assert found.tolist() == [[4, 2, 3], [2, 0, 4], [0, 1, 4], [0, 4, 2], [0, 2, 3]]
    assert apart.tolist() == [[0, 1, 1], [1, 2, 2], [1, 1, 1], [1, 1, 2], [0, 1, 1]]
    found, _ = similarity.nearest(np.array([0, 3]), 9, np.array([1, 2, 4]))
    assert found.tolist() == [[4, 2, 1], [4, 2, 1]]
    found, _ = similarity.nearest(np.array([2, 0]), 9, np.array([1, 2, 4]))
    assert found.tolist() == [[1, 4], [4, 2]]  # as many as each of them has
    assert similarity.farthest(np.array([1, 2])).tolist() == [2, 1, 1, 3, 2]
    assert similarity.nearest(np.array([1]), 2, np.array([1]))[0].shape == (1, 0)


def test_features_are_compared_side_by_side(tmp_path):
    """Distances over two features are the root of the sum of the squares over each."""
    states, other = random_states(6, [4, 6, 5]), random_states(7, [4, 6, 5], dim=2)
    columns = {"a": np.concatenate(states), "b": np.concatenate(other)}
    trajectories = Trajectories(np.array([4, 6, 5]), columns, 10, "made up")
    i, j = np.arange(3)[:, None], np.arange(3)
    expected = np.hypot(oracle_distances(states), oracle_distances(other))
    np.testing.assert_allclose(similarity_of(trajectories, ["a", "b"], tmp_path).distance(i, j), expected)
    assert list(tmp_path.iterdir()) == []  # computed in a moment, so not kept
