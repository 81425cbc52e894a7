"""Many episodes, for which no matrix is held: distances, farthest and nearest, and their cache."""

import logging
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from lerobot_swr.similarity import cache, measure, neighbours, similarity_of, sketch
from lerobot_swr.similarity.cache import CACHE_FOLDER
from lerobot_swr.similarity.neighbours import survey
from lerobot_swr.similarity.sketch import make_sketch
from lerobot_swr.similarity.vectors import EpisodeVectors
from lerobot_swr.trajectories import Trajectories

KEYS = ["observation.state"]
T, D = 20, 3


def smooth(n: int, spread: float, rng: np.random.Generator) -> np.ndarray:
    """(n, T, D) sums of a few sines, around 5 ways."""
    waves = np.sin(np.pi * np.outer(np.arange(1, 5), np.linspace(0, 1, T)))
    ways = rng.normal(size=(5, 4, D))[rng.integers(5, size=n)]
    return np.einsum("nkd,kt->ntd", ways + spread * rng.normal(size=(n, 4, D)), waves)


def kinds(n: int) -> dict[str, np.ndarray]:
    """Datasets on which shortcuts would go wrong: name to (n, T, D) float32."""
    rng = np.random.default_rng(0)
    near = smooth(n, 0.3, rng)
    repeated = near[rng.integers(n // 3, size=n)]
    made = {
        "few directions": near + 1e-3 * rng.normal(size=near.shape),
        "noise, where no few numbers tell anything": rng.normal(size=near.shape),
        "large states, small differences": 1000 + near,
        "clusters much closer than they are apart": 100 * np.sign(near) + smooth(n, 0.01, rng),
        "duplicates": repeated,
        "one outlier": np.concatenate([near[:-1], near[-1:] * 1e4]),
        "all equal": np.repeat(near[:1], n, axis=0),
    }
    return {name: states.astype(np.float32) for name, states in made.items()}


KINDS = kinds(600)


def oracle(padded: np.ndarray) -> np.ndarray:
    """(N, N) float64 distances of (N, ...) padded episodes."""
    flat = padded.reshape(len(padded), -1).astype(np.float64)
    return cdist(flat, flat)


def oracle_nearest(apart: np.ndarray, rows, k, candidates) -> np.ndarray:
    """(R, k) by a full stable sort."""
    found = []
    for row in rows:
        others = [j for j in candidates if j != row]
        found.append([others[place] for place in np.argsort(apart[row, others], kind="stable")[:k]])
    return np.array(found)


def as_trajectories(states: list[np.ndarray]) -> Trajectories:
    return Trajectories(
        np.array([len(s) for s in states]), {KEYS[0]: np.concatenate(states)}, fps=10, name="made up"
    )


@pytest.mark.parametrize("kind", KINDS)
def test_farthest_and_nearest_are_the_definitions(kind, tmp_path):
    """Against a dense float64 matrix and a full sort, among all episodes and among some."""
    states = KINDS[kind]
    apart = oracle(states)
    similarity = similarity_of(as_trajectories(list(states)), KEYS, tmp_path, dense_up_to=0)
    everyone, some = np.arange(len(states)), np.arange(0, len(states), 3)
    for rows, candidates in ((everyone, everyone), (everyone, some), (some[:7] + 1, some)):
        np.testing.assert_allclose(
            similarity.farthest(candidates), apart[:, candidates].max(axis=1), rtol=1e-6
        )
        found, distances = similarity.nearest(rows, 10, candidates)
        expected = oracle_nearest(apart, rows, 10, candidates)
        # Distances of the two computations differ by rounding, so equally distant episodes may swap places.
        wanted = np.take_along_axis(apart[rows], expected, axis=1)
        np.testing.assert_allclose(np.take_along_axis(apart[rows], found, axis=1), wanted, rtol=2e-6)
        np.testing.assert_allclose(distances, wanted, rtol=2e-6)
        assert (found != rows[:, None]).all()
        assert all(len(set(row)) == 10 for row in found.tolist())
        if kind == "duplicates":
            np.testing.assert_array_equal(found[wanted == 0], expected[wanted == 0])  # ties by number


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_hold_for_every_pair(kind):
    """No squared distance is below its lower bound or above its upper one, whatever the sketch leaves out."""
    states = KINDS[kind]
    vectors = EpisodeVectors(states.reshape(-1, D), np.full(len(states), T))
    squared = oracle(states) ** 2
    for width in (1, 6, None):
        padded = vectors.padded(np.arange(len(states)))
        mean = padded.mean(axis=0)
        directions = None
        if width is not None:
            directions = torch.from_numpy(sketch._principal_directions(padded[:50] - mean)[:, :width].copy())
        made = sketch._sketch(vectors, mean, directions)
        everyone = torch.arange(len(states))
        left, right = made.bounds(everyone, everyone)
        lower = (left @ right.T).double().numpy()
        r, n = made.residuals.double().numpy(), made.norms.double().numpy()
        upper = lower + 4 * np.outer(r, r) + 2 * made.rounding * (n[:, None] + n)
        assert (lower <= squared + 1e-12).all()
        assert (squared <= upper + 1e-12).all()


def test_few_numbers_are_taken_where_they_do_and_all_where_they_do_not():
    """Smooth paths of 4 waves in 3 dimensions need 12 numbers of 60; noise needs its 60."""
    widths = {}
    for kind in ("few directions", "noise, where no few numbers tell anything"):
        vectors = EpisodeVectors(KINDS[kind].reshape(-1, D), np.full(600, T))
        widths[kind] = make_sketch(vectors, 10).coordinates.shape[1]
    assert list(widths.values()) == [12, 60]


def test_where_bounds_tell_too_many_apart_what_is_missed_lies_within_their_width(monkeypatch):
    """Two coordinates, few measurements: no result is worse than the exact one by more than is promised."""
    monkeypatch.setattr(neighbours, "FARTHEST", 3)
    monkeypatch.setattr(neighbours, "SPARE", 1)
    states = KINDS["few directions"]
    vectors = EpisodeVectors(states.reshape(-1, D), np.full(len(states), T))
    padded, everyone = vectors.padded(np.arange(len(states))), np.arange(len(states))
    directions = torch.from_numpy(sketch._principal_directions(padded - padded.mean(axis=0))[:, :2].copy())
    made = sketch._sketch(vectors, padded.mean(axis=0), directions)
    found = survey(vectors, made, everyone, everyone, 10)
    apart = oracle(states)
    r, n = made.residuals.numpy(), made.norms.numpy()
    width = 4 * r * r.max() + 2 * made.rounding * (n + n.max())
    farthest = apart.max(axis=1)
    assert (found.farthest < farthest * (1 - 1e-6)).any()  # so something was missed
    assert (found.farthest**2 >= farthest**2 - width - 1e-6).all()
    np.fill_diagonal(apart, np.inf)
    kth = np.sort(apart, axis=1)[:, 9]
    assert (found.distances[:, -1] > kth * (1 + 1e-6)).any()
    assert (found.distances[:, -1] ** 2 <= kth**2 + width + 1e-6).all()
    measured = np.take_along_axis(apart, found.nearest, axis=1)
    np.testing.assert_allclose(found.distances, measured, rtol=1e-6)  # whom it names it has measured


@pytest.mark.parametrize("lengths", [[7] * 40, [1, 30, 2, 2, 9] * 8, [3] * 39 + [500]])
def test_pairs_are_measured_without_padding_them_all(lengths, monkeypatch):
    """Episodes of any lengths, in blocks of any size: the distances of the padded sequences."""
    rng = np.random.default_rng(1)
    states = [rng.normal(size=(n, D)).astype(np.float32) for n in lengths]
    longest = max(lengths)
    padded = np.stack([np.concatenate([s, np.repeat(s[-1:], longest - len(s), axis=0)]) for s in states])
    apart = oracle(padded)
    vectors = EpisodeVectors(np.concatenate(states), np.array(lengths))
    np.testing.assert_array_equal(vectors.padded(np.array([4, 0])), padded.reshape(40, -1)[[4, 0]])
    i, j = np.arange(40)[:, None], np.arange(40)
    for block in (neighbours.BLOCK_NUMBERS, 50):
        monkeypatch.setattr("lerobot_swr.similarity.vectors.BLOCK_ELEMENTS", block)
        np.testing.assert_allclose(vectors.distance(i, j), apart, rtol=1e-6)
        np.testing.assert_allclose(vectors.distance(np.array(3), j), apart[3], rtol=1e-6)
        assert vectors.distance(np.array(3), np.array(5)) == pytest.approx(apart[3, 5], rel=1e-6)


def test_tiny_distances_of_large_states_keep_their_digits(tmp_path):
    """A thousandth apart at a thousand: nearest and their distances are right, which products would lose."""
    rng = np.random.default_rng(2)
    base = 1000 + rng.normal(size=(1, T, D))
    states = (base + 1e-3 * np.arange(300)[:, None, None] ** 1.1).astype(np.float32)
    similarity = similarity_of(as_trajectories(list(states)), KEYS, tmp_path, dense_up_to=0)
    apart, everyone = oracle(states), np.arange(300)
    found, distances = similarity.nearest(everyone, 5, everyone)
    np.testing.assert_array_equal(found, oracle_nearest(apart, everyone, 5, everyone))
    np.testing.assert_allclose(distances, np.take_along_axis(apart, found, axis=1), rtol=2e-6)


def test_blocks_and_threads_do_not_change_the_result(monkeypatch, tmp_path):
    """Rows in blocks of a few, by one thread or by three."""
    trajectories, everyone = as_trajectories(list(KINDS["few directions"])), np.arange(600)
    whole = similarity_of(trajectories, KEYS, tmp_path / "none", dense_up_to=0)
    monkeypatch.setattr(measure, "cached_survey", lambda root, key, shape, compute: compute())
    expected = whole.nearest(everyone, 10, everyone)
    monkeypatch.setattr(neighbours, "BLOCK_NUMBERS", 600 * 7)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    found = similarity_of(trajectories, KEYS, tmp_path / "none", dense_up_to=0).nearest(
        everyone, 10, everyone
    )
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])


# --- The cache ---


@pytest.fixture
def trajectories() -> Trajectories:
    return as_trajectories(list(KINDS["few directions"][:40].copy()))


def everything(trajectories: Trajectories, root) -> list[np.ndarray]:
    """What a new process finds out about a dataset."""
    similarity, everyone = similarity_of(trajectories, KEYS, root, dense_up_to=0), np.arange(40)
    return [similarity.farthest(everyone), *similarity.nearest(everyone, 5, everyone)]


def assert_equal(found, expected) -> None:
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_cache_is_used_when_intact(trajectories, tmp_path, monkeypatch):
    """The second call reads the file, of O(N k) numbers, instead of computing."""
    first = everything(trajectories, tmp_path)
    (file,) = (tmp_path / CACHE_FOLDER).iterdir()
    assert file.stat().st_size < 40 * (39 * (4 + 4) + 8) + 1000
    monkeypatch.setattr(measure, "survey", lambda *_: pytest.fail("computed again"))
    assert_equal(everything(trajectories, tmp_path), first)


@pytest.mark.parametrize("damage", ["truncated", "empty", "flipped"])
def test_a_damaged_cache_is_computed_anew(trajectories, tmp_path, damage, caplog):
    """A half-written or altered file is not trusted, and is replaced."""
    expected = everything(trajectories, tmp_path)
    (file,) = (tmp_path / CACHE_FOLDER).iterdir()
    content = bytearray(file.read_bytes())
    if damage == "flipped":
        content[-3] ^= 0xFF
    file.write_bytes({"truncated": content[: len(content) // 2], "empty": b"", "flipped": content}[damage])
    with caplog.at_level(logging.WARNING):
        assert_equal(everything(trajectories, tmp_path), expected)
    assert "computed anew" in caplog.text
    caplog.clear()
    everything(trajectories, tmp_path)
    assert not caplog.text


def test_changed_states_and_other_candidates_meet_another_cache(trajectories, tmp_path):
    """The key is the content and the question, so an edited dataset never meets a stale cache."""
    before = everything(trajectories, tmp_path)
    similarity_of(trajectories, KEYS, tmp_path, dense_up_to=0).farthest(np.arange(0, 40, 2))
    assert len(list((tmp_path / CACHE_FOLDER).iterdir())) == 2
    trajectories.columns[KEYS[0]][0, 0] += 0.5
    assert not np.array_equal(everything(trajectories, tmp_path)[0], before[0])
    assert len(list((tmp_path / CACHE_FOLDER).iterdir())) == 3


def test_a_dataset_that_may_not_be_written_is_left_alone(trajectories, tmp_path, monkeypatch):
    """The cache goes to LeRobot's home where the dataset's folder is read-only."""
    home, dataset = tmp_path / "home", tmp_path / "dataset"
    dataset.mkdir(mode=0o555)
    monkeypatch.setattr(cache, "HF_LEROBOT_HOME", home)
    everything(trajectories, dataset)
    assert list(dataset.iterdir()) == []
    assert len(list((home / CACHE_FOLDER).iterdir())) == 1


def test_several_may_race_for_the_cache(trajectories, tmp_path):
    """Writers at the same time agree and leave one intact file, no temporary ones."""
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: everything(trajectories, tmp_path), range(8)))
    for result in results:
        assert_equal(result, results[0])
    assert [file.suffix for file in (tmp_path / CACHE_FOLDER).iterdir()] == [".safetensors"]
