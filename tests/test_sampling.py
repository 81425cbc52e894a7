"""The similarity-weighted sampler."""

import numpy as np
import pytest
import torch

from lerobot_swr.random_streams import NUMBERS_PER_BLOCK, StepGenerator
from lerobot_swr.sampling import LARGEST_FACTOR, PartnerSampler
from lerobot_swr.similarity.measure import DenseSimilarity

N = 5
DISTANCES = np.abs(np.subtract.outer(np.array([0.0, 1, 3, 7, 8]), np.array([0.0, 1, 3, 7, 8])))

GENERATOR = torch.Generator()


def draw(sampler, episodes):
    """Pairs from fresh uniform numbers."""
    uniforms = torch.rand(len(episodes), generator=GENERATOR, dtype=torch.float64)
    return sampler.draw(episodes, uniforms.numpy() * (1 - 1e-9))


def make_sampler(distances=DISTANCES, candidates=None, **options) -> PartnerSampler:
    candidates = np.arange(len(distances)) if candidates is None else np.array(candidates)
    options = {"beta": 2.0, "p": 1.0, "partner_sampling": "uniform", **options}
    return PartnerSampler(DenseSimilarity(distances), candidates, **options)


def exact_shares(distances, beta, p, normalization="row") -> np.ndarray:
    """Algorithm 1: (N, N) 1 - p for j = i, and p W(i, j) / (N - 1) for j ≠ i."""
    n = len(distances)
    largest = distances.max(axis=1, keepdims=True) if normalization == "row" else distances.max()
    shares = p * np.exp(-beta * distances / largest) / (n - 1)
    shares[np.eye(n, dtype=bool)] = 1 - p
    return shares


def shares_of(sampler, n, grid=40_000) -> np.ndarray:
    """(n, n) what the sampler gives each pair on average: all uniform numbers, at equal steps."""
    numbers = (np.arange(grid) + 0.5) / grid
    found = np.zeros((n, n))
    for i in range(n):
        pairs = sampler.draw(torch.full((grid,), i), numbers)
        np.add.at(found[i], pairs.episodes.numpy(), pairs.weights.double().numpy() / grid)
    return found


def test_uniform_drawing_relabels_at_its_probability():
    """A relabelled frame has j ≠ i, another keeps j = i and weight 1; the share of the former is p."""
    GENERATOR.manual_seed(0)
    episodes = torch.arange(20_000) % N
    pairs = draw(make_sampler(p=0.3), episodes)
    assert ((pairs.episodes != episodes) == pairs.relabelled).all()
    assert (pairs.weights[~pairs.relabelled] == 1).all()
    assert abs(pairs.relabelled.float().mean() - 0.3) < 0.02


@pytest.mark.parametrize("p", [0.3, 0.8, 1.0])
@pytest.mark.parametrize("normalization", ["row", "global"])
def test_both_ways_of_drawing_have_the_expectation_of_algorithm_1(p, normalization):
    """E[weight · 1(i, j)] is the pair's share, over all uniform numbers, for every pair."""
    expected = exact_shares(DISTANCES, 2.0, p, normalization)
    for way in ("uniform", "weighted"):
        sampler = make_sampler(p=p, normalization=normalization, partner_sampling=way)
        np.testing.assert_allclose(shares_of(sampler, N), expected, atol=1e-4)
    # Weighted drawing leaves the loss as the only source of variance: the weight is constant.
    pairs = draw(sampler, torch.arange(N).repeat(200))
    np.testing.assert_allclose(pairs.weights, np.tile(expected.sum(axis=1), 200), rtol=1e-6)


@pytest.mark.parametrize("normalization", ["row", "global"])
def test_uniform_weights_equal_the_weight_matrix(normalization):
    """Each relabelled pair's weight is W(i, j) = exp(−β ν(i, j)), computed here from the distances."""
    GENERATOR.manual_seed(0)
    episodes = torch.arange(500) % N
    pairs = draw(make_sampler(normalization=normalization), episodes)
    weights = exact_shares(DISTANCES, 2.0, 1.0, normalization) * (N - 1)  # W, at p = 1, of pairs j ≠ i
    np.testing.assert_allclose(pairs.weights, weights[episodes, pairs.episodes], rtol=1e-5)


# --- More episodes than partners ---


def clustered(n: int) -> np.ndarray:
    """(n, n) distances of points in three clumps of a plane, some of which coincide."""
    rng = np.random.default_rng(0)
    points = rng.integers(3, size=(n, 1)) * np.array([3.0, 1.0]) + rng.normal(size=(n, 2)).round(1)
    return np.linalg.norm(points[:, None] - points, axis=2)


@pytest.mark.parametrize("beta", [0.0, 3.0, 30.0])
@pytest.mark.parametrize("p", [0.8, 1.0])
@pytest.mark.parametrize("partners", [1, 6, 28, 29, 60])
def test_a_few_partners_and_the_rest_have_the_same_expectation(beta, p, partners):
    """Every pair's share over all uniform numbers, whether its partner is among the nearest or not."""
    distances = clustered(30)
    sampler = make_sampler(distances, beta=beta, p=p, partner_sampling="weighted", partners=partners)
    expected = exact_shares(distances, beta, p)
    np.testing.assert_allclose(shares_of(sampler, 30), expected, atol=3e-4 * expected.sum(axis=1).max())


def test_the_expectation_holds_in_random_draws():
    """The mean of weight times a value of the pair, within its standard error; 100 episodes, 8 partners."""
    GENERATOR.manual_seed(0)
    distances, rng = clustered(100), np.random.default_rng(1)
    values, episodes = rng.normal(size=(100, 100)), torch.from_numpy(rng.integers(100, size=200_000))
    sampler = make_sampler(distances, beta=4.0, p=0.8, partner_sampling="weighted", partners=8)
    pairs = draw(sampler, episodes)
    found = pairs.weights.numpy() * values[episodes, pairs.episodes]
    expected = (exact_shares(distances, 4.0, 0.8) * values).sum(axis=1)[episodes]
    apart = found - expected
    assert abs(apart.mean()) < 4 * apart.std() / np.sqrt(len(apart))
    nearest = np.argsort(distances + 1e9 * np.eye(100), axis=1, kind="stable")[:, :8]
    is_near = (nearest[episodes] == pairs.episodes.numpy()[:, None]).any(axis=1)
    assert 0.05 < is_near[pairs.relabelled].mean() < 0.95  # both ways of finding a partner took part


def test_no_frame_of_the_rest_weighs_much_more_than_others():
    """Also where similar episodes are too rare among the rest to have been noticed."""
    n, partners = 2000, 5
    distances = np.full((n, n), 10.0)
    distances[:10, :10] = 1.0  # four episodes more than partners, among two thousand
    np.fill_diagonal(distances, 0)
    sampler = make_sampler(distances, beta=10.0, p=1.0, partner_sampling="weighted", partners=partners)
    numbers = np.linspace(0, 1 - 1e-9, 200_001)
    pairs = sampler.draw(torch.zeros(len(numbers), dtype=torch.int64), numbers)
    within = pairs.weights[pairs.episodes < 10]
    assert within.max() > 1.5 * within.min()  # the rare ones stand for more than their share
    assert within.max() <= LARGEST_FACTOR * within.min() * (1 + 1e-5)
    assert set(range(1, 10)) <= set(pairs.episodes.tolist())


def test_what_a_sampler_holds_grows_with_the_partners_not_with_the_square_of_the_episodes():
    """Its largest array is of about episodes times partners numbers."""
    distances = clustered(600)
    sampler = make_sampler(distances, partner_sampling="weighted", partners=10)
    sizes = [value.size for value in vars(sampler).values() if isinstance(value, np.ndarray)]
    assert max(sizes) == 600 * 12


# --- Which episodes take part ---


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_without_temperature_every_weight_is_one(partner_sampling):
    """β = 0 is BC-like: all demonstrations teach all styles alike, partners or not."""
    for partners in (2, 256):
        sampler = make_sampler(beta=0.0, partner_sampling=partner_sampling, partners=partners)
        torch.testing.assert_close(draw(sampler, torch.arange(1000) % N).weights, torch.ones(1000))


@pytest.mark.parametrize("partners", [1, 256])
@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_only_candidates_are_drawn_and_normalise(partner_sampling, partners):
    """Episodes outside the training data are no partners, and the farthest candidate is at ν = 1."""
    GENERATOR.manual_seed(0)
    sampler = make_sampler(candidates=[0, 2, 3], partner_sampling=partner_sampling, partners=partners)
    pairs = draw(sampler, torch.tensor([0, 2, 3]).repeat(300))
    assert set(pairs.episodes.tolist()) == {0, 2, 3}
    assert float(sampler.nu(np.array(0), np.array(3))) == 1.0


def test_frames_of_other_episodes_are_refused():
    """They have no style to teach; the message names them."""
    with pytest.raises(ValueError, match=r"episodes \[1, 4\] are not among the 3"):
        draw(make_sampler(candidates=[0, 2, 3]), torch.tensor([0, 4, 1]))


@pytest.mark.parametrize("partners", [2, 256])
@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_a_huge_temperature_gives_zero_weights_and_no_nan(partner_sampling, partners):
    """β where exp(−β) underflows leaves relabelled frames with weight 0, not with NaN."""
    sampler = make_sampler(beta=1e6, partner_sampling=partner_sampling, partners=partners)
    assert (draw(sampler, torch.arange(50) % N).weights == 0).all()


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_a_single_candidate_keeps_its_frames(partner_sampling):
    """With nobody else to teach, frames keep their own style."""
    pairs = draw(make_sampler(candidates=[1], partner_sampling=partner_sampling), torch.tensor([1, 1]))
    assert pairs.episodes.tolist() == [1, 1]
    assert not pairs.relabelled.any()


def test_effective_demos_run_from_one_to_all():
    """All demonstrations teach a style at β = 0, its own alone at β → ∞; between, Kish's formula."""
    assert make_sampler(beta=0.0).effective_demos == pytest.approx(N)
    assert make_sampler(beta=1e6).effective_demos == pytest.approx(1)
    w = exact_shares(DISTANCES, 2.0, 1.0) * (N - 1) + np.eye(N)
    expected = (w.sum(axis=0) ** 2 / (w**2).sum(axis=0)).mean()
    assert make_sampler(beta=2.0).effective_demos == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"p": 1.5}, "p=1.5"),
        ({"p": -0.1}, "p=-0.1"),
        ({"beta": -1}, "beta=-1"),
        ({"partner_sampling": "nearest"}, "partner_sampling='nearest'"),
        ({"normalization": "none"}, "normalization='none'"),
    ],
)
def test_bad_options_are_named(options, message):
    """The error names key and value."""
    with pytest.raises(ValueError, match=message):
        make_sampler(**options)


# --- Random numbers ---


def test_random_numbers_are_a_function_of_the_step():
    """Drawn one by one, together or from the middle: the same; of bounded memory, for large batches too."""
    torch.manual_seed(3)
    count = NUMBERS_PER_BLOCK // 3
    one, many = StepGenerator(), StepGenerator()
    singly = np.concatenate([one.uniforms(1, count) for _ in range(8)])
    np.testing.assert_array_equal(many.uniforms(8, count), singly)
    np.testing.assert_array_equal(one.uniforms_at(5, 2, count), singly[5 * count : 7 * count])
    assert len(np.unique(singly)) == len(singly)
    assert one.uniforms(1, 5 * NUMBERS_PER_BLOCK).shape == (5 * NUMBERS_PER_BLOCK,)
    assert one._drawn[1].size == 5 * NUMBERS_PER_BLOCK  # those of one step alone


def test_a_resumed_generator_goes_on():
    """Seed and step are in the checkpoint."""
    one, resumed = StepGenerator(), StepGenerator()
    one.uniforms(7, 16)
    resumed.load_state_dict(one.state_dict())
    np.testing.assert_array_equal(resumed.uniforms(3, 16), one.uniforms(3, 16))
