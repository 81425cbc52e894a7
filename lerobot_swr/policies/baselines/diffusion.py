"""Diffusion processes: how actions are noised in training and denoised at inference.

Both offer the same three methods, so a policy does not care which one it uses. Shapes: B windows of K
actions of A dimensions, normalised.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lerobot_swr.policies.baselines import dependencies

Generators = torch.Generator | list[torch.Generator] | None
"""Source of noise: one for all rows, one per row, or torch's global one."""
Network = Callable[[Tensor, Tensor], Tensor]
"""Noised actions (B, K, A) and noise levels (B,) to a prediction (B, K, A)."""

LOG_LOGISTIC_SCALE = 0.5  # of BESO's density of log σ, around log σ_data


@dataclass(frozen=True)
class Bounds:
    """Range of the demonstrations' actions, normalised.

    Attributes:
        low: (A,).
        high: (A,).
    """

    low: Tensor
    high: Tensor

    def clip(self, actions: Tensor) -> Tensor:
        """(..., A) within the bounds."""
        return actions.clamp(self.low, self.high)


@dataclass(frozen=True)
class Noised:
    """A training example.

    Attributes:
        inputs: (B, K, A), what the network sees of the noised actions.
        level: (B,), the noise level that it is told.
        target: (B, K, A), what it should predict.
    """

    inputs: Tensor
    level: Tensor
    target: Tensor


class Ddpm:
    """DDPM with a cosine schedule and ε-prediction (Ho et al. 2020; Nichol and Dhariwal 2021).

    A noise level is the number of a step, 0 to steps − 1.

    Args:
        steps: Number of steps, in training and at inference.
    """

    def __init__(self, steps: int):
        # "sample": the network predicts noise, but the scheduler is given the clipped action behind it.
        self.scheduler = dependencies.DDPMScheduler(
            steps, beta_schedule="squaredcos_cap_v2", prediction_type="sample", clip_sample=False
        )

    def noised(self, actions: Tensor) -> Noised:
        """Noise every row to a random level, with torch's global generator."""
        steps = self.scheduler.config.num_train_timesteps
        level = torch.randint(steps, actions.shape[:1], device=actions.device)
        noise = torch.randn_like(actions)
        return Noised(self.scheduler.add_noise(actions, noise, level), level, noise)

    def prior(self, like: Tensor, generator: Generators = None) -> Tensor:
        """Where denoising starts: noise of the shape of `like`, (B, K, A)."""
        return dependencies.randn_tensor(like.shape, generator, like.device, like.dtype)

    def denoise(
        self, network: Network, actions: Tensor, bounds: Bounds, generator: Generators = None
    ) -> Tensor:
        """Denoise (B, K, A); the estimate of the clean actions is clipped at every step, as in D3IL."""
        for step in self.scheduler.timesteps:
            alpha = self.scheduler.alphas_cumprod[step].item()
            noise = network(actions, step.to(actions.device).expand(len(actions)))
            clean = (actions - math.sqrt(1 - alpha) * noise) / math.sqrt(alpha)
            actions = self.scheduler.step(bounds.clip(clean), step, actions, generator=generator).prev_sample
        return bounds.clip(actions)


class Karras:
    """Score matching over continuous noise levels with the preconditioning of Karras et al. (2022).

    A noise level is the noise's standard deviation σ. With the network F, the denoiser is D(x, σ) = c_skip x
    + c_out F(c_in x, σ). In units of σ_data it is what diffusers calls v-prediction, of −F.

    Args:
        steps: Number of Euler ancestral steps at inference, over evenly spaced σ.
        sigma_data: σ_data.
        sigma_min: Least σ.
        sigma_max: Largest σ.
    """

    def __init__(self, steps: int, sigma_data: float, sigma_min: float, sigma_max: float):
        self.sigma_data, self.sigma_min, self.sigma_max = sigma_data, sigma_min, sigma_max
        self.sigmas = torch.linspace(sigma_max, sigma_min, steps, dtype=torch.float64)
        # The scheduler knows noise levels as a variance-preserving process: alpha = 1 / (1 + (σ / σ_data)²).
        alphas = 1 / (1 + (self.sigmas.flip(0) / sigma_data).square())
        betas = 1 - alphas / torch.cat([alphas.new_ones(1), alphas[:-1]])
        self.scheduler = dependencies.EulerAncestralDiscreteScheduler(
            steps, trained_betas=betas.tolist(), prediction_type="v_prediction"
        )

    def scalings(self, sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """c_skip, c_out and c_in of σ (Karras et al. 2022, table 1)."""
        variance = sigma.square() + self.sigma_data**2
        return self.sigma_data**2 / variance, sigma * self.sigma_data / variance.sqrt(), 1 / variance.sqrt()

    def noised(self, actions: Tensor) -> Noised:
        """Noise every row to a random σ, log-logistic between its bounds, with torch's global generator."""
        center = math.log(self.sigma_data)
        low, high = (
            1 / (1 + math.exp(-(math.log(sigma) - center) / LOG_LOGISTIC_SCALE))
            for sigma in (self.sigma_min, self.sigma_max)
        )
        share = low + (high - low) * torch.rand(len(actions), dtype=torch.float64, device=actions.device)
        sigma = torch.exp(center + LOG_LOGISTIC_SCALE * torch.logit(share)).to(actions.dtype)
        noised = actions + sigma[:, None, None] * torch.randn_like(actions)
        c_skip, c_out, c_in = self.scalings(sigma[:, None, None])
        return Noised(c_in * noised, sigma, (actions - c_skip * noised) / c_out)

    def prior(self, like: Tensor, generator: Generators = None) -> Tensor:
        """Where denoising starts: noise of the shape of `like`, (B, K, A), and of size σ_max."""
        noise = dependencies.randn_tensor(like.shape, generator, like.device, like.dtype)
        return self.sigma_max * noise

    def denoise(
        self, network: Network, actions: Tensor, bounds: Bounds, generator: Generators = None
    ) -> Tensor:
        """Denoise (B, K, A) from σ_max on; only the result is clipped, as in D3IL."""
        self.scheduler.set_timesteps(len(self.sigmas))
        scaled = actions / self.sigma_data
        for step, sigma in zip(self.scheduler.timesteps, self.sigmas.to(actions), strict=True):
            inputs = self.scheduler.scale_model_input(scaled, step)
            predicted = network(inputs, sigma.expand(len(actions)))
            scaled = self.scheduler.step(-predicted, step, scaled, generator=generator).prev_sample
        return bounds.clip(scaled * self.sigma_data)
