"""The similarity-weighted sampler: draws whose style a frame teaches (algorithm 1)."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.similarity import (
    Dissimilarity,
    Normalization,
    Similarity,
    check_beta,
    check_normalization,
    similarity_weights,
)

PartnerSampling = Literal["uniform", "weighted"]
PARTNER_SAMPLINGS: tuple[PartnerSampling, ...] = get_args(PartnerSampling)

PARTNERS = 256  # nearest others that are drawn by their share; the rest are drawn uniformly
MAX_INSPECTED_STYLES = 64
LARGEST_FACTOR = 16.0  # by which a frame of the rest may weigh more than one drawn by its own share
ROWS = 4096  # episodes whose shares are computed at once


@dataclass(frozen=True)
class Pairs:
    """Which style each frame of a batch teaches, and how much.

    Attributes:
        episodes: (B,) int64, episode j whose style is used; j = i where the frame is not relabelled.
        weights: (B,) weight of the frame's loss.
        relabelled: (B,) bool, True where j ≠ i: no gradient may flow into z_j there.
    """

    episodes: Tensor
    weights: Tensor
    relabelled: Tensor


class PartnerSampler:
    """Draws pairs (i, j) for given episodes i, so that on average a style j learns as algorithm 1 has it.

    ``uniform`` is the paper's way: j ≠ i uniformly at probability p, weighted by W(τ_i, τ_j), else j = i.
    Where demonstrations differ, W is almost 0 and so a share p of the batch teaches almost nothing.
    ``weighted`` draws the pair by its share in the same expectation, 1 - p for j = i and p W(τ_i, τ_j) / (M
    - 1) for each of the M - 1 others, and weights every frame by the sum of these shares: no frame is wasted.

    That holds for i itself and its nearest partners, whose shares are held. The rest of the M candidates has
    one share in common, of which its members are drawn uniformly and weighted by W over what the share takes
    W for: about its root mean square, with which the weights vary least. So the expectation is the same, and
    memory and the work of a step do not grow with M beyond M times the number of partners.

    Args:
        similarity: Of N demonstrations.
        candidates: (M,) sorted episodes, those that take part in training: only they are drawn, and over them
            ν is normalised.
        beta: Inverse temperature of the weights, >= 0.
        p: Probability of relabelling a frame.
        normalization: How distances become dissimilarities, ``row`` or ``global``.
        partner_sampling: ``uniform`` or ``weighted``.
        partners: How many nearest others ``weighted`` draws by their shares.

    Attributes:
        effective_demos: Kish's effective number of demonstrations that teach a style, from 1 (its own alone)
            to M: (Σ_i W_ij)² / Σ_i W_ij², averaged over styles j; over some of them where there are many.

    Raises:
        ValueError: For a value out of range.
    """

    def __init__(
        self,
        similarity: Similarity,
        candidates: np.ndarray,
        beta: float,
        p: float,
        normalization: Normalization = "row",
        partner_sampling: PartnerSampling = "weighted",
        partners: int = PARTNERS,
    ):
        check_beta(beta)
        check_probability(p)
        check_partner_sampling(partner_sampling)
        check_normalization(normalization)
        self.beta, self.p, self.partner_sampling = beta, p, partner_sampling
        self._candidates, count = candidates, len(candidates)
        self._place = np.full(len(similarity), -1)  # (N,) of an episode among the candidates
        self._place[candidates] = np.arange(count)
        self._dissimilarity = Dissimilarity(similarity, candidates, normalization)
        drawn = np.random.default_rng(0).permutation(count)[:MAX_INSPECTED_STYLES]
        inspected = self._weights_of(candidates[np.sort(drawn)])
        self.effective_demos = float((inspected.sum(axis=0) ** 2 / (inspected**2).sum(axis=0)).mean())
        self._n_rest = 0
        if partner_sampling == "weighted" and p > 0 and count > 1:
            near, distances = similarity.nearest(candidates, partners, candidates)
            self._hold_shares(near, distances, inspected)

    def _weights_of(self, styles: np.ndarray) -> np.ndarray:
        """(M, S) float32 W(τ_i, τ_j) of all candidates i and some styles j."""
        weights = np.empty((len(self._candidates), len(styles)), dtype=np.float32)
        for start in range(0, len(weights), ROWS):
            rows = self._candidates[start : start + ROWS, None]
            weights[start : start + ROWS] = similarity_weights(
                self._dissimilarity.nu(rows, styles), self.beta
            )
        return weights

    def _hold_shares(self, near: np.ndarray, distances: np.ndarray, inspected: np.ndarray) -> None:
        """Prepare ``weighted``.

        Args:
            near: (M, K) nearest other candidates.
            distances: (M, K) their distances.
            inspected: (M, S) weights of every candidate and some styles, which stand for the rest.
        """
        count, partners = near.shape
        self._n_rest = count - 1 - partners
        # By place, so that the rest can be counted through: itself and its partners, then the rest.
        self._known = np.empty((count, partners + 1), dtype=np.int32)
        self._shares = np.empty((count, partners + 2))  # cumulative
        self._typical = np.zeros(count)  # W that the rest's share takes
        for start in range(0, count, ROWS):
            rows = slice(start, min(start + ROWS, count))
            own = self._candidates[rows, None]
            weights = similarity_weights(self._dissimilarity.of_distances(own, distances[rows]), self.beta)
            if self._n_rest:
                self._typical[rows] = _typical_weight(weights[:, -1], inspected[rows])
            known = np.column_stack([np.arange(count)[rows], self._place[near[rows]]])
            others = self.p / (count - 1)
            shares = np.column_stack([np.full(len(weights), 1 - self.p), others * weights])
            order = known.argsort(axis=1)
            self._known[rows] = np.take_along_axis(known, order, axis=1)
            shares = np.take_along_axis(shares, order, axis=1)
            rest = others * self._n_rest * self._typical[rows]
            self._shares[rows] = np.column_stack([shares, rest]).cumsum(axis=1)

    def nu(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """ν(τ_i, τ_j) of pairs of episodes, of equal shapes or broadcast to each other."""
        return self._dissimilarity.nu(i, j)

    def draw(self, episodes: Tensor, uniforms: np.ndarray) -> Pairs:
        """Draw a partner for every frame.

        Args:
            episodes: (B,) int64, episode i of each frame; all of them candidates.
            uniforms: (B,) independent numbers, uniform in [0, 1); each decides one frame's partner.

        Raises:
            ValueError: If an episode is no candidate.
        """
        # NumPy: on a CPU, torch's overhead for so few numbers would be noticeable in every step.
        own = self._place[episodes.cpu().numpy()]
        if (own < 0).any():
            known = np.unique(episodes.cpu().numpy()[own < 0]).tolist()
            raise ValueError(
                f"episodes {known} are not among the {len(self._candidates)} that are trained on"
            )
        if self.p == 0 or len(self._candidates) < 2:
            partner, weights = own, np.ones(len(own))
        elif self.partner_sampling == "uniform":
            partner, weights = self._draw_uniform(own, uniforms)
        else:
            partner, weights = self._draw_weighted(own, uniforms)
        device = episodes.device
        return Pairs(
            torch.from_numpy(self._candidates[partner]).to(device),
            torch.from_numpy(weights.astype(np.float32)).to(device),
            torch.from_numpy(partner != own).to(device),
        )

    def _draw_uniform(self, own: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(B,) partners j and weights W, of (B,) places."""
        others = len(self._candidates) - 1
        place = np.minimum((numbers * (others / self.p)).astype(np.int64), others - 1)
        place += place >= own  # skips the frame's own episode
        partner = np.where(numbers < self.p, place, own)
        return partner, self._weight(own, partner)

    def _draw_weighted(self, own: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(B,) partners j and weights, of (B,) places."""
        shares = self._shares[own]  # (B, K + 2)
        weights, last = shares[:, -1], self._known.shape[1] - 1
        numbers = numbers * weights
        # Inverse distribution function: how many cumulative shares lie at or below the number.
        slot = (shares <= numbers[:, None]).sum(axis=1)
        partner = self._known[own, np.minimum(slot, last)].astype(np.int64)
        (rest,) = np.nonzero((slot > last) & (self._typical[own] > 0))
        if len(rest):
            whose, known = own[rest], self._known[own[rest]]
            beyond = shares[rest, -1] - shares[rest, -2]
            count = ((numbers[rest] - shares[rest, -2]) / beyond * self._n_rest).astype(np.int64)
            count = np.minimum(count, self._n_rest - 1)
            # The count-th place that is not among the known ones, which are sorted.
            skipped = (known - np.arange(last + 1) <= count[:, None]).sum(axis=1)
            partner[rest] = count + skipped
            weights = weights.copy()
            weights[rest] *= self._weight(whose, partner[rest]) / self._typical[whose]
        return partner, weights

    def _weight(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """W(τ_i, τ_j) of pairs of places."""
        return similarity_weights(self._dissimilarity.nu(self._candidates[i], self._candidates[j]), self.beta)


def _typical_weight(nearest: np.ndarray, inspected: np.ndarray) -> np.ndarray:
    """(M,) about the root mean square of the rest's weights, and no less than bounds a frame's weight.

    Args:
        nearest: (M,) weights of the farthest partner, above which none of the rest's lies.
        inspected: (M, S) weights of some styles, not all of which belong to the rest.
    """
    of_rest = inspected <= (1 + 1e-5) * nearest[:, None]
    squares = (inspected**2 * of_rest).sum(axis=1) / np.maximum(of_rest.sum(axis=1), 1)
    return np.maximum(np.sqrt(squares), nearest / LARGEST_FACTOR)


def check_probability(p: float) -> None:
    """Refuse what is no probability.

    Raises:
        ValueError: If `p` is outside [0, 1].
    """
    if not 0 <= p <= 1:
        raise ValueError(f"p={p}: the relabelling probability must lie in [0, 1]; the paper uses 0.8")


def check_partner_sampling(partner_sampling: str) -> PartnerSampling:
    """The way of drawing partners of that name.

    Raises:
        ValueError: For anything but ``uniform`` and ``weighted``.
    """
    for known in PARTNER_SAMPLINGS:
        if known == partner_sampling:
            return known
    raise ValueError(f"partner_sampling={partner_sampling!r}: expected 'uniform' or 'weighted'")
