"""The similarity-weighted sampler: draws whose style a frame teaches (algorithm 1)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_swr.similarity import Normalization, check_beta, check_normalization

PartnerSampling = Literal["uniform", "weighted"]

MAX_INSPECTED_STYLES = 64


@dataclass(frozen=True)
class Pairs:
    """Which style each frame of a batch teaches, and how much.

    Attributes:
        styles: (B,) int64, episode j whose style is used; j = i where the frame is not relabelled.
        weights: (B,) weight of the frame's loss.
        relabelled: (B,) bool, True where j ≠ i: no gradient may flow into z_j there.
    """

    styles: Tensor
    weights: Tensor
    relabelled: Tensor


class SimilarityWeightedSampler:
    """Draws pairs (i, j) for given episodes i, so that on average a style j learns as algorithm 1 has it.

    ``uniform`` is the paper's way: j ≠ i uniformly at probability p, weighted by W(τ_i, τ_j), else j = i.
    Where demonstrations differ, W is almost 0 and so a share p of the batch teaches almost nothing.
    ``weighted`` draws the pair by its share in the same expectation, 1 - p for j = i and p W(τ_i, τ_j) / (M
    - 1) for each of the M - 1 others, and weights every frame by the sum of these shares: no frame is wasted.

    Only *candidates* are drawn: episodes that take part in training; there are none until `set_candidates`.
    The normalization of ν, too, is over the candidates. ν and W are computed for the drawn pairs alone.

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
        check_normalization(normalization)
        self.beta, self.p = beta, p
        self.normalization, self.partner_sampling = normalization, partner_sampling
        self._distances = torch.from_numpy(distances).to(torch.float32)  # (N, N)
        self.candidates = torch.zeros(len(distances), dtype=torch.bool)
        self._largest = torch.zeros(len(distances))  # (N,) largest distance to a candidate
        self._effective_demos: float | None = None

    def set_candidates(self, candidates: Tensor) -> None:
        """Restrict the draw to the episodes marked in `candidates`, (N,), non-zero where marked."""
        marked = candidates.bool()
        if torch.equal(marked, self.candidates):
            return
        self._distances = self._distances.to(marked.device)
        self.candidates = marked.clone()
        self._candidate_list = marked.nonzero().squeeze(1)  # (M,)
        self._place = marked.long().cumsum(0) - 1  # (N,) place of a candidate in that list
        among = self._distances[:, self._candidate_list]  # (N, M)
        self._largest = among.amax(dim=1)
        if self.normalization == "global":
            self._largest = self._largest[self._candidate_list].amax().expand(len(marked))
        self._effective_demos = None

    def nu(self, i: Tensor, j: Tensor) -> Tensor:
        """ν(τ_i, τ_j) of pairs of episodes, (B,) each or broadcastable to each other."""
        largest = self._largest[i]
        return torch.where(largest > 0, self._distances[i, j] / largest, 0.0)

    def draw(self, episodes: Tensor, uniforms: Tensor) -> Pairs:
        """Draw a partner for every frame.

        Args:
            episodes: (B,) int64, episode i of each frame; all of them candidates.
            uniforms: (B,) independent numbers, uniform in [0, 1); each decides one frame's partner.
        """
        others = len(self._candidate_list) - 1
        if self.p == 0 or others < 1:
            ones = torch.ones(len(episodes), device=episodes.device)
            return Pairs(episodes, ones, torch.zeros_like(episodes, dtype=torch.bool))
        if self.partner_sampling == "uniform":
            relabelled = uniforms < self.p
            place = (uniforms * (others / self.p)).long().clamp_(max=others - 1)
            place += place >= self._place[episodes]  # skips the frame's own episode
            styles = torch.where(relabelled, self._candidate_list[place], episodes)
            weights = torch.exp(-self.beta * self.nu(episodes, styles))
            return Pairs(styles, weights, relabelled)
        # (B, M), each pair's share in the expectation: 1 - p for j = i, p W(i, j) / (M - 1) for j ≠ i
        shares = torch.exp(-self.beta * self.nu(episodes[:, None], self._candidate_list)) * (self.p / others)
        shares.scatter_(1, self._place[episodes][:, None], 1 - self.p)
        cumulative = shares.double().cumsum(dim=1)
        # Inverse distribution function; below 1, so that rounding never leads past the last share.
        threshold = uniforms.double().clamp(max=1 - 1e-9)[:, None] * cumulative[:, -1:]
        place = torch.searchsorted(cumulative, threshold, right=True).squeeze(1).clamp_(max=others)
        styles = self._candidate_list[place]
        return Pairs(styles, cumulative[:, -1].float(), styles != episodes)

    @property
    def effective_demos(self) -> float:
        """Kish's effective number of demonstrations that teach a style, from 1 (its own alone) to M.

        (Σ_i W_ij)² / Σ_i W_ij², averaged over styles j; over an even selection of them where there are many.
        """
        if self._effective_demos is None:
            self._effective_demos = self._count_effective_demos()
        return self._effective_demos

    def _count_effective_demos(self) -> float:
        stride = -(-len(self._candidate_list) // MAX_INSPECTED_STYLES)
        styles = self._candidate_list[::stride]
        weights = torch.exp(-self.beta * self.nu(self._candidate_list[:, None], styles))  # (M, styles)
        return float((weights.sum(dim=0).square() / weights.square().sum(dim=0)).mean())


class StepGenerator(nn.Module):
    """A fresh random generator for every training step, a pure function of seed, process and step.

    Seed and step are buffers, so they travel with a checkpoint and a resumed run draws what the uninterrupted
    one would have drawn. (Torch's global generator, although LeRobot restores it, does not give that: making
    a data loader's iterator draws from it, once more in a resumed run than in one that goes on.)

    Args:
        stream: Generators of different streams are independent of each other.
    """

    def __init__(self, stream: int = 0) -> None:
        super().__init__()
        self._stream = (stream,) if stream else ()
        self.seed: Tensor
        self.step: Tensor
        self.register_buffer("seed", torch.tensor(torch.initial_seed() % 2**63))
        self.register_buffer("step", torch.tensor(0))

    def next(self) -> torch.Generator:
        """The generator of the next step, on the CPU."""
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        process = torch.distributed.get_rank() if distributed else 0
        entropy = np.random.SeedSequence((int(self.seed), process, int(self.step), *self._stream))
        self.step += 1
        return torch.Generator().manual_seed(int(entropy.generate_state(1, np.uint32)[0]))

    def uniforms(self, steps: int, count: int) -> Tensor:
        """(steps * count,) numbers in [0, 1), `count` from the generator of each of the next steps."""
        drawn = [torch.rand(count, generator=self.next(), dtype=torch.float64) for _ in range(steps)]
        return torch.cat(drawn)


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
