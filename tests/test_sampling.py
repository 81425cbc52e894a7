"""The similarity-weighted sampler."""

import numpy as np
import pytest
import torch

from lerobot_swr.sampling import NUMBERS_PER_BLOCK, SimilarityWeightedSampler, StepGenerator
from lerobot_swr.similarity import normalize_distances

N = 5
DISTANCES = np.abs(np.subtract.outer(np.array([0.0, 1, 3, 7, 8]), np.array([0.0, 1, 3, 7, 8])))

GENERATOR = torch.Generator()


def draw(sampler, episodes):
    """Pairs from fresh uniform numbers."""
    uniforms = torch.rand(len(episodes), generator=GENERATOR, dtype=torch.float64)
    return sampler.draw(episodes, uniforms.numpy() * (1 - 1e-9))


def make_sampler(**options) -> SimilarityWeightedSampler:
    sampler = SimilarityWeightedSampler(DISTANCES, **{"beta": 2.0, "p": 1.0, **options})
    sampler.set_candidates(torch.ones(N, dtype=torch.bool))
    return sampler


def test_uniform_drawing_relabels_at_its_probability():
    """A relabelled frame has j ≠ i, another keeps j = i and weight 1; the share of the former is p."""
    GENERATOR.manual_seed(0)
    episodes = torch.arange(20_000) % N
    pairs = draw(make_sampler(p=0.3, partner_sampling="uniform"), episodes)
    assert ((pairs.styles != episodes) == pairs.relabelled).all()
    assert (pairs.weights[~pairs.relabelled] == 1).all()
    assert abs(pairs.relabelled.float().mean() - 0.3) < 0.02


@pytest.mark.parametrize("p", [0.3, 0.8, 1.0])
@pytest.mark.parametrize("normalization", ["row", "global"])
def test_both_ways_of_drawing_have_the_expectation_of_algorithm_1(p, normalization):
    """E[weight · f(i, j)] = (1 − p) f(i, i) + p · mean over j ≠ i of W(i, j) f(i, j)."""
    GENERATOR.manual_seed(0)
    values = torch.rand(N, N, generator=GENERATOR)
    weights = np.exp(-2.0 * normalize_distances(DISTANCES, normalization))
    draws = 100_000
    for i in range(N):
        others = [j for j in range(N) if j != i]
        relabelled = np.mean([weights[i, j] * float(values[i, j]) for j in others])
        expected = (1 - p) * float(values[i, i]) + p * relabelled
        for way in ("uniform", "weighted"):
            sampler = make_sampler(p=p, normalization=normalization, partner_sampling=way)
            pairs = draw(sampler, torch.full((draws,), i))
            samples = pairs.weights * values[i, pairs.styles]
            assert abs(samples.mean() - expected) < 5 * samples.std() / np.sqrt(draws) + 1e-6
        # Weighted drawing leaves the loss as the only source of variance: the weight is constant.
        mass = (1 - p) + p * weights[i, others].mean()
        torch.testing.assert_close(pairs.weights, torch.full((draws,), float(mass)))


@pytest.mark.parametrize("normalization", ["row", "global"])
def test_uniform_weights_equal_the_weight_matrix(normalization):
    """Each pair's weight is W(i, j) = exp(−β ν(i, j)), computed here from the distances."""
    GENERATOR.manual_seed(0)
    weights = np.exp(-2.0 * normalize_distances(DISTANCES, normalization))
    episodes = torch.arange(500) % N
    pairs = draw(make_sampler(normalization=normalization, partner_sampling="uniform"), episodes)
    np.testing.assert_allclose(pairs.weights, weights[episodes, pairs.styles], rtol=1e-5)


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_without_temperature_every_weight_is_one(partner_sampling):
    """β = 0 is BC-like: all demonstrations teach all styles alike."""
    pairs = draw(make_sampler(beta=0.0, partner_sampling=partner_sampling), torch.arange(1000) % N)
    torch.testing.assert_close(pairs.weights, torch.ones(1000))


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_only_candidates_are_drawn_and_normalise(partner_sampling):
    """Episodes outside the training data are no partners, and the farthest candidate is at ν = 1."""
    GENERATOR.manual_seed(0)
    sampler = make_sampler(partner_sampling=partner_sampling)
    sampler.set_candidates(torch.tensor([1, 0, 1, 1, 0]))
    pairs = draw(sampler, torch.tensor([0, 2, 3]).repeat(300))
    assert set(pairs.styles.tolist()) == {0, 2, 3}
    assert float(sampler.nu(np.array(0), np.array(3))) == 1.0


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_a_huge_temperature_gives_zero_weights_and_no_nan(partner_sampling):
    """β where exp(−β) underflows leaves relabelled frames with weight 0, not with NaN."""
    pairs = draw(make_sampler(beta=1e6, partner_sampling=partner_sampling), torch.arange(50) % N)
    assert (pairs.weights == 0).all()


def test_a_single_candidate_keeps_its_frames():
    """With nobody else to teach, frames keep their own style."""
    sampler = make_sampler()
    sampler.set_candidates(torch.tensor([0, 1, 0, 0, 0]))
    pairs = draw(sampler, torch.tensor([1, 1]))
    assert pairs.styles.tolist() == [1, 1]
    assert not pairs.relabelled.any()


def test_effective_demos_run_from_one_to_all():
    """All demonstrations teach a style at β = 0, its own alone at β → ∞."""
    assert make_sampler(beta=0.0).effective_demos == pytest.approx(N)
    assert make_sampler(beta=1e6).effective_demos == pytest.approx(1)


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
