"""The similarity-weighted sampler: draws which demonstration's style a frame is relabelled with (algorithm 1)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.similarity import Normalization, check_beta, normalize_distances

PartnerSampling = Literal["uniform", "weighted"]


@dataclass(frozen=True)
class Pairs:
    """Which style each frame of a batch teaches, and how much.

    Attributes:
        styles: (B,) int64, episode j whose style is used; j = i where the frame is not relabelled.
        weights: (B,) weight of the frame's loss: W(τ_i, τ_j), or 1 where it is not relabelled.
        relabelled: (B,) bool, True where j ≠ i: no gradient may flow into z_j there.
    """

    styles: Tensor
    weights: Tensor
    relabelled: Tensor


class SimilarityWeightedSampler:
    """Draws pairs (i, j) for given episodes i, with j ≠ i at probability p.

    ``uniform`` draws j uniformly and weights the loss by W(τ_i, τ_j), as the paper does; ``weighted`` draws
    j ∝ W(τ_i, ·) and weights by the row's mean, which has the same expectation and a lower variance. Draws come
    from torch's global generator, which LeRobot saves and restores with a checkpoint.

    Only *candidates* are drawn: episodes that take part in training. The normalization of ν, too, is over the
    candidates.

    Args:
        distances: (N, N) distances of the episodes.
        beta: Inverse temperature of the weights, >= 0.
        p: Probability of relabelling a frame.
        normalization: How distances become dissimilarities, ``row`` or ``global``.
        partner_sampling: ``uniform`` or ``weighted``.

    Raises:
        ValueError: For a value out of range.
    """

    def __init__(
        self,
        distances: np.ndarray,
        beta: float,
        p: float,
        normalization: Normalization = "row",
        partner_sampling: PartnerSampling = "uniform",
    ):
        check_beta(beta)
        check_probability(p)
        check_partner_sampling(partner_sampling)
        self.distances, self.beta, self.p = distances, beta, p
        self.normalization, self.partner_sampling = normalization, partner_sampling
        self.set_candidates(torch.ones(len(distances), dtype=torch.bool))

    def set_candidates(self, candidates: Tensor) -> None:
        """Restrict the draw to the episodes marked in `candidates`, (N,) bool."""
        self.candidates = candidates.clone()
        device = candidates.device
        chosen = candidates.cpu().numpy()
        self.n_candidates = int(chosen.sum())
        distances = np.where(chosen[:, None] & chosen[None, :], self.distances, 0.0)
        nu = normalize_distances(distances, self.normalization)
        log_weights = torch.from_numpy(-self.beta * nu).to(torch.float32)
        self._log_weights = log_weights.to(device)  # (N, N), log W
        excluded = torch.from_numpy(~chosen)[None, :] | torch.eye(len(nu), dtype=torch.bool)
        self._partner_log_weights = log_weights.masked_fill(excluded, -torch.inf).to(device)
        self._candidate_list = candidates.nonzero().squeeze(1)  # (M,)
        self._rank = candidates.long().cumsum(0) - 1  # (N,), place of a candidate in that list
        # Kish's effective sample size of the demonstrations that teach a style, 1 (its own) to M.
        weights = np.exp(-self.beta * nu[np.ix_(chosen, chosen)])  # (M, M), W(τ_i, τ_j)
        self.effective_demos = float(
            np.mean(weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0)) if self.n_candidates else 0.0
        )

    def draw(self, episodes: Tensor) -> Pairs:
        """Draw a partner for every frame.

        Args:
            episodes: (B,) int64, episode i of each frame; all of them candidates.
        """
        ones = torch.ones(len(episodes), device=episodes.device)
        if self.p == 0 or self.n_candidates < 2:
            return Pairs(episodes, ones, torch.zeros_like(episodes, dtype=torch.bool))
        relabelled = torch.rand(len(episodes), device=episodes.device) < self.p
        if self.partner_sampling == "uniform":
            place = torch.randint(self.n_candidates - 1, episodes.shape, device=episodes.device)
            place = place + (place >= self._rank[episodes])  # skips the frame's own episode
            partners = self._candidate_list[place]
            weights = self._log_weights[episodes, partners].exp()
        else:
            log_weights = self._partner_log_weights[episodes]  # (B, N)
            partners = torch.multinomial(log_weights.softmax(dim=1), 1).squeeze(1)
            weights = log_weights.logsumexp(dim=1).exp() / (self.n_candidates - 1)
        return Pairs(
            torch.where(relabelled, partners, episodes),
            torch.where(relabelled, weights, ones),
            relabelled,
        )


def check_probability(p: float) -> None:
    """Refuse what is no probability.

    Raises:
        ValueError: If `p` is outside [0, 1].
    """
    if not 0 <= p <= 1:
        raise ValueError(f"p={p}: the relabelling probability must lie in [0, 1]; the paper uses 0.8")


def check_partner_sampling(partner_sampling: str) -> None:
    """Refuse unknown ways of drawing partners.

    Raises:
        ValueError: For anything but ``uniform`` and ``weighted``.
    """
    if partner_sampling not in ("uniform", "weighted"):
        raise ValueError(f"partner_sampling={partner_sampling!r}: expected 'uniform' or 'weighted'")
