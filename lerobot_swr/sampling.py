"""The similarity-weighted sampler: draws whose style a frame teaches (algorithm 1)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_swr.similarity import Normalization, check_beta, check_normalization

PartnerSampling = Literal["uniform", "weighted"]

MAX_INSPECTED_STYLES = 64
NUMBERS_PER_BLOCK = 2**14  # random numbers that are drawn together: many cost little more than a few


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
        self._distances = distances
        self._candidates = b""  # what `set_candidates` was given; equal bytes are the quickest comparison
        self._marked = np.zeros(len(distances), dtype=bool)
        self._candidate_list = np.flatnonzero(self._marked)
        self._row_largest = np.zeros(len(distances))  # (N,) largest distance to a candidate
        self._largest = self._row_largest  # (N,) what a row of distances is divided by
        self._effective_demos: float | None = None

    def set_candidates(self, candidates: Tensor) -> None:
        """Restrict the draw to the episodes marked in `candidates`, (N,), non-zero where marked."""
        given = candidates.cpu().numpy()
        content = given.tobytes()
        if content == self._candidates:
            return
        known, marked = self._marked, given != 0
        self._candidates, self._marked = content, marked
        self._candidate_list = np.flatnonzero(marked)  # (M,)
        self._place = marked.cumsum() - 1  # (N,) place of a candidate in that list
        if (known & ~marked).any():
            known, self._row_largest = np.zeros_like(known), np.zeros(len(known))
        joined = np.flatnonzero(marked & ~known)  # few at a time, while episodes are seen for the first time
        self._row_largest = np.maximum(self._row_largest, self._distances[:, joined].max(axis=1, initial=0))
        self._largest = self._row_largest
        if self.normalization == "global":
            self._largest = np.full(len(marked), self._row_largest[self._candidate_list].max())
        # Shares of the pairs, cumulative over partners: rows are filled when they are needed.
        self._shares = np.empty((len(marked), len(self._candidate_list)))  # (N, M)
        self._mass = np.empty(len(marked))  # (N,) their sum
        self._has_shares = np.zeros(len(marked), dtype=bool)
        self._all_filled = False
        self._effective_demos = None

    def nu(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """ν(τ_i, τ_j) of pairs of episodes, (B,) each or broadcastable to each other."""
        largest = self._largest[i]
        return np.divide(self._distances[i, j], largest, where=largest > 0, out=np.zeros(np.shape(i * j)))

    def draw(self, episodes: Tensor, uniforms: np.ndarray) -> Pairs:
        """Draw a partner for every frame.

        Args:
            episodes: (B,) int64, episode i of each frame; all of them candidates.
            uniforms: (B,) independent numbers, uniform in [0, 1); each decides one frame's partner.
        """
        # NumPy: on a CPU, torch's overhead for so few numbers would be noticeable in every step.
        own = episodes.cpu().numpy()
        if self.p == 0 or len(self._candidate_list) < 2:
            styles, weights, relabelled = own, np.ones(len(own)), np.zeros(len(own), dtype=bool)
        elif self.partner_sampling == "uniform":
            styles, weights, relabelled = self._draw_uniform(own, uniforms)
        else:
            styles, weights, relabelled = self._draw_weighted(own, uniforms)
        device = episodes.device
        return Pairs(
            torch.from_numpy(styles).to(device),
            torch.from_numpy(weights.astype(np.float32)).to(device),
            torch.from_numpy(relabelled).to(device),
        )

    def _draw_uniform(
        self, own: np.ndarray, numbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        others = len(self._candidate_list) - 1
        relabelled = numbers < self.p
        place = np.minimum((numbers * (others / self.p)).astype(np.int64), others - 1)
        place += place >= self._place[own]  # skips the frame's own episode
        styles = np.where(relabelled, self._candidate_list[place], own)
        return styles, np.exp(-self.beta * self.nu(own, styles)), relabelled

    def _draw_weighted(
        self, own: np.ndarray, numbers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if not self._all_filled:
            self._fill_shares(own)
        mass = self._mass[own]
        # Inverse distribution function: how many cumulative shares lie at or below the number.
        place = (self._shares[own] <= (numbers * mass)[:, None]).sum(axis=1)
        styles = self._candidate_list.take(place, mode="clip")
        return styles, mass, styles != own

    def _fill_shares(self, episodes: np.ndarray) -> None:
        """Pairs (i, j) of `episodes`: 1 - p for j = i, p W(i, j) / (M - 1) for j ≠ i, summed up over j."""
        episodes = np.unique(episodes[~self._has_shares[episodes]])
        others = len(self._candidate_list) - 1
        shares = np.exp(-self.beta * self.nu(episodes[:, None], self._candidate_list)) * (self.p / others)
        shares[np.arange(len(episodes)), self._place[episodes]] = 1 - self.p
        self._shares[episodes] = shares.cumsum(axis=1)
        self._mass[episodes] = self._shares[episodes, -1]
        self._has_shares[episodes] = True
        self._all_filled = bool(self._has_shares[self._candidate_list].all())

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
        weights = np.exp(-self.beta * self.nu(self._candidate_list[:, None], styles))  # (M, styles)
        return float((weights.sum(axis=0) ** 2 / (weights**2).sum(axis=0)).mean())


class StepGenerator(nn.Module):
    """Random numbers of every training step, a pure function of seed, process and step.

    Seed and step are buffers, so they travel with a checkpoint and a resumed run draws what the uninterrupted
    one would have drawn. (Torch's global generator, although LeRobot restores it, does not give that: making
    a data loader's iterator draws from it, once more in a resumed run than in one that goes on.)

    Args:
        stream: Generators of different streams are independent of each other.
    """

    def __init__(self, stream: int = 0) -> None:
        super().__init__()
        self._stream = stream
        self._drawn: tuple[tuple[int, ...], np.ndarray] | None = None  # the last block
        self.seed: Tensor
        self.step: Tensor
        self.register_buffer("seed", torch.tensor(torch.initial_seed() % 2**63))
        self.register_buffer("step", torch.tensor(0))

    def next(self) -> torch.Generator:
        """A generator for the next step, on the CPU."""
        entropy = self._entropy(int(self.step))
        self.step.add_(1)
        seed = np.random.SeedSequence(entropy).generate_state(1, np.uint32)[0]
        return torch.Generator().manual_seed(int(seed))

    def uniforms(self, steps: int, count: int) -> np.ndarray:
        """(steps * count,) float64 numbers in [0, 1), `count` for each of the next steps."""
        first = int(self.step)
        self.step.add_(steps)
        return self.uniforms_at(first, steps, count)

    def uniforms_at(self, first: int, steps: int, count: int) -> np.ndarray:
        """The numbers of `uniforms` for steps `first` to `first` + `steps` - 1, whichever is the next one."""
        per_block = max(1, NUMBERS_PER_BLOCK // count)  # steps
        parts = []
        while steps > 0:
            block, place = divmod(first, per_block)
            parts.append(self._block(block, per_block, count)[place : place + steps])
            first, steps = first + len(parts[-1]), steps - len(parts[-1])
        return (parts[0] if len(parts) == 1 else np.concatenate(parts)).reshape(-1)

    def _block(self, block: int, steps: int, count: int) -> np.ndarray:
        """(steps, count) numbers of consecutive steps."""
        entropy = (*self._entropy(block), count)
        if self._drawn is None or self._drawn[0] != entropy:
            numbers = np.random.default_rng(entropy).random((steps, count))
            # A little below 1, lest a product with such a number be rounded up to its other factor.
            self._drawn = (entropy, np.minimum(numbers, 1 - 1e-9))
        return self._drawn[1]

    def _entropy(self, place: int) -> tuple[int, ...]:
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        process = torch.distributed.get_rank() if distributed else 0
        return int(self.seed), process, place, self._stream


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
