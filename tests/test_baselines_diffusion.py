"""The diffusion processes of the baselines, against closed forms and distributions known exactly."""

import numpy as np
import pytest
import torch
from scipy import stats

from lerobot_swr.policies.baselines.diffusion import Bounds, Ddpm, Karras

SHARE, WIDTH = 0.3, 0.1  # the known distribution: N(-1, WIDTH²) with this share, else N(1, WIDTH²)
FREE = Bounds(torch.tensor([-torch.inf]), torch.tensor([torch.inf]))


def expected_clean(noised, scale, sigma):
    """E[x | scale x + sigma noise] of the known distribution, by Bayes' rule."""
    noised, scale, sigma = noised[..., None], scale[..., None], sigma[..., None]  # last axis: the modes
    variance = (scale * WIDTH) ** 2 + sigma**2
    means = torch.tensor([-1.0, 1.0])
    off = noised - scale * means
    log_share = torch.tensor([SHARE, 1 - SHARE]).log() - off**2 / (2 * variance)
    conditional = means + scale * WIDTH**2 / variance * off
    return (log_share.softmax(dim=-1) * conditional).sum(dim=-1)


def ddpm_oracle(process):
    """A network that predicts exactly E[ε | noised action]."""

    def network(noised, level):
        alpha = process.scheduler.alphas_cumprod[level][:, None, None]
        clean = expected_clean(noised, alpha.sqrt(), (1 - alpha).sqrt())
        return (noised - alpha.sqrt() * clean) / (1 - alpha).sqrt()

    return network


def karras_oracle(process):
    """A network whose denoiser c_skip x + c_out F(c_in x) is exactly E[x | noised action]."""

    def network(inputs, sigma):
        sigma = sigma[:, None, None]
        total = (sigma**2 + process.sigma_data**2).sqrt()
        noised = inputs * total
        clean = expected_clean(noised, torch.ones_like(sigma), sigma)
        return (clean - process.sigma_data**2 / total**2 * noised) / (sigma * process.sigma_data / total)

    return network


@pytest.mark.parametrize(
    ("process", "oracle", "tolerance"),
    [
        (Ddpm(200), ddpm_oracle, 0.02),
        (Ddpm(8), ddpm_oracle, 0.05),  # as published; so few steps are not exact
        (Karras(300, sigma_data=0.5, sigma_min=0.02, sigma_max=6), karras_oracle, 0.02),
    ],
    ids=["ddpm, 200 steps", "ddpm, 8 steps", "karras, 300 steps"],
)
def test_an_exact_network_recovers_a_distribution_with_two_modes(process, oracle, tolerance):
    """Shares, places and widths of the modes."""
    torch.manual_seed(0)
    start = process.prior(torch.empty(10_000, 1, 1))
    drawn = process.denoise(oracle(process), start, FREE).flatten()
    left, right = drawn[drawn < 0], drawn[drawn > 0]
    assert len(left) / len(drawn) == pytest.approx(SHARE, abs=tolerance)
    for mode, mean in ((left, -1), (right, 1)):
        assert mode.mean().item() == pytest.approx(mean, abs=tolerance)
        assert mode.std().item() == pytest.approx(WIDTH, abs=tolerance)


def test_the_cosine_schedule_is_the_published_one():
    """ᾱ against Nichol and Dhariwal's formula, β clipped at .999."""
    times = np.arange(9) / 8
    bars = np.cos((times + 0.008) / 1.008 * np.pi / 2) ** 2
    betas = np.minimum(1 - bars[1:] / bars[:-1], 0.999)
    np.testing.assert_allclose(Ddpm(8).scheduler.alphas_cumprod, np.cumprod(1 - betas), rtol=1e-4)


def test_ddpm_noise_and_target_make_up_the_input():
    """x = √ᾱ a + √(1 − ᾱ) ε, every level as often."""
    torch.manual_seed(0)
    process, actions = Ddpm(8), torch.randn(8000, 3, 2)
    noised = process.noised(actions)
    alpha = process.scheduler.alphas_cumprod[noised.level][:, None, None]
    torch.testing.assert_close(noised.inputs, alpha.sqrt() * actions + (1 - alpha).sqrt() * noised.target)
    assert stats.chisquare(np.bincount(noised.level.numpy(), minlength=8)).pvalue > 1e-3
    assert stats.kstest(noised.target.flatten().numpy(), "norm").pvalue > 1e-3


def test_ddpm_denoising_is_the_posterior_with_a_clipped_estimate():
    """Step by step against the formulas of Ho et al. (2020), with the same noise."""
    process = Ddpm(8)
    bounds = Bounds(torch.tensor([-0.5, -1.0]), torch.tensor([0.7, 0.4]))
    start = torch.randn(5, 3, 2, generator=torch.Generator().manual_seed(1))
    drawn = process.denoise(
        lambda x, level: torch.sin(3 * x + level[:, None, None]),
        start,
        bounds,
        torch.Generator().manual_seed(2),
    )

    noise = torch.Generator().manual_seed(2)
    bars = process.scheduler.alphas_cumprod.double()
    x = start.double()
    for t in reversed(range(8)):
        before = bars[t - 1] if t else torch.tensor(1.0)
        beta = 1 - bars[t] / before
        clean = (x - (1 - bars[t]).sqrt() * torch.sin(3 * x + t)) / bars[t].sqrt()
        clean = torch.minimum(torch.maximum(clean, bounds.low), bounds.high)
        x = (before.sqrt() * beta * clean + (1 - beta).sqrt() * (1 - before) * x) / (1 - bars[t])
        if t:
            spread = (beta * (1 - before) / (1 - bars[t])).sqrt()
            x = x + spread * torch.randn(start.shape, generator=noise)
    torch.testing.assert_close(drawn, x.float(), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("sigma_data", [0.5, 1.3])
def test_one_karras_step_is_the_preconditioned_denoiser(sigma_data):
    """c_skip x + c_out F(c_in x, σ), coefficients by table 1 of Karras et al. (2022)."""
    sigma = 0.8
    process = Karras(1, sigma_data, sigma_min=0.1, sigma_max=sigma)
    x = torch.randn(6, 5, 2, generator=torch.Generator().manual_seed(0))
    levels = []

    def network(inputs, level):
        levels.append(level)
        return torch.sin(inputs)

    drawn = process.denoise(network, x.clone(), FREE)
    total = sigma**2 + sigma_data**2
    expected = sigma_data**2 / total * x + sigma * sigma_data / total**0.5 * torch.sin(x / total**0.5)
    torch.testing.assert_close(drawn, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(levels, [torch.full((6,), sigma)])


def test_karras_denoising_is_euler_ancestral_over_even_noise_levels():
    """Step by step against the sampler of Karras et al. as k-diffusion defines it, with the same noise."""
    process = Karras(4, sigma_data=0.5, sigma_min=0.1, sigma_max=1.0)
    bounds = Bounds(torch.tensor([-0.5]), torch.tensor([0.5]))
    start = torch.randn(5, 3, 1, generator=torch.Generator().manual_seed(1))
    drawn = process.denoise(
        lambda x, level: torch.sin(x) * level[:, None, None], start, bounds, torch.Generator().manual_seed(2)
    )

    noise = torch.Generator().manual_seed(2)
    x = start.double()
    for sigma, following in ((1.0, 0.7), (0.7, 0.4), (0.4, 0.1), (0.1, 0.0)):
        total = sigma**2 + 0.25
        clean = 0.25 / total * x + sigma * 0.5 / total**0.5 * torch.sin(x / total**0.5) * sigma
        up = (following**2 * (sigma**2 - following**2) / sigma**2) ** 0.5
        down = (following**2 - up**2) ** 0.5
        x = x + (x - clean) / sigma * (down - sigma)
        x = x + up * torch.randn(start.shape, generator=noise)
    torch.testing.assert_close(drawn, x.float().clamp(-0.5, 0.5), rtol=1e-3, atol=1e-4)


def test_karras_targets_invert_the_preconditioning():
    """c_skip x + c_out target is the clean action; σ is log-logistic between its bounds."""
    torch.manual_seed(0)
    process, actions = Karras(8, 0.5, sigma_min=0.1, sigma_max=1.0), torch.randn(8000, 3, 2)
    noised = process.noised(actions)
    sigma = noised.level[:, None, None]
    total = sigma**2 + 0.25
    x = noised.inputs * total.sqrt()
    torch.testing.assert_close(
        0.25 / total * x + sigma * 0.5 / total.sqrt() * noised.target, actions, rtol=1e-3, atol=1e-4
    )
    assert stats.kstest(((x - actions) / sigma).flatten().numpy(), "norm").pvalue > 1e-3
    density = stats.fisk(c=2, scale=0.5)  # log-logistic: log σ is logistic around log 0.5, with scale 1/2
    low, high = density.cdf([0.1, 1.0])
    assert stats.kstest(noised.level.numpy(), lambda s: (density.cdf(s) - low) / (high - low)).pvalue > 1e-3


@pytest.mark.parametrize("process", [Ddpm(8), Karras(8, 0.5, 0.1, 1.0)], ids=["ddpm", "karras"])
def test_results_stay_within_the_bounds(process):
    """Whatever the network says."""
    bounds = Bounds(torch.tensor([-0.5, -1.0]), torch.tensor([0.7, 0.4]))
    drawn = process.denoise(lambda x, level: 10 * x, process.prior(torch.empty(50, 3, 2)), bounds)
    assert (drawn >= bounds.low).all()
    assert (drawn <= bounds.high).all()
