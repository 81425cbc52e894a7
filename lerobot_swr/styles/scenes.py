"""How each demonstration began, and which of them began most like now."""

import numpy as np
import torch
from torch import Tensor, nn

ROUNDING = 1e-5  # relative error of a product in float32, generously
TIE = 1e-5  # relative difference of squared distances below which scenes are equally near


class Scenes(nn.Module):
    """First observations of N demonstrations, in the units that the policy sees, and their distances.

    The distance is Euclidean over the dimensions that vary at the start, each in units of its standard
    deviation there. Where nothing varies all demonstrations are equally near.

    Attributes:
        first: (N, c) float32 buffer, first observations; NaN where they are not known.
        scale: (c,) float32 buffer, what differences are multiplied by; 0 for dimensions that do not count.

    Args:
        num_episodes: N.
        dim: c, dimensions of an observation.
    """

    def __init__(self, num_episodes: int, dim: int):
        super().__init__()
        self.first: Tensor
        self.scale: Tensor
        self.register_buffer("first", torch.full((num_episodes, dim), torch.nan))
        self.register_buffer("scale", torch.zeros(dim))
        self._prepared: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None = (
            None  # allowed, first, of these
        )

    def fit(self, first: Tensor, varying: np.ndarray) -> None:
        """Take the demonstrations' first observations.

        Args:
            first: (N, c) normalised observations.
            varying: (c,) bool, which dimensions vary at the start.
        """
        spread = first.std(dim=0, correction=0)
        counts = torch.from_numpy(varying).to(first.device) & (spread > 0)
        self.first = first.to(torch.float32)
        self.scale = torch.where(counts, 1 / spread, torch.zeros_like(spread)).to(torch.float32)

    def append(self, first: Tensor) -> None:
        """Take those of demonstrations that were added, (E, c)."""
        self.first = torch.cat([self.first, first.to(self.first)])

    def near(self, scene: Tensor, allowed: Tensor, k: int) -> list[Tensor]:
        """Which demonstrations began most like a scene.

        Args:
            scene: (B, c) normalised observations.
            allowed: (M,) int64 episodes.
            k: How many.

        Returns:
            For each of the B scenes the episodes that are no farther than the k-th nearest, at least one.

        Raises:
            ValueError: If it is not known how the demonstrations began.
        """
        counts = self.scale > 0
        scaled = (scene.to(self.first) * self.scale)[:, counts]  # (B, d)
        columns, norms, slack = self._columns(allowed, counts)
        found = []
        for row in scaled:
            # Squared distances but for the row's own norm, up to rounding: one product with all M.
            about = torch.addmv(norms, columns.T, row, alpha=-2)
            far = about.min() if k == 1 else about.kthvalue(min(k, len(allowed))).values
            most = float(far + slack * (1 + row @ row))
            few = np.flatnonzero(about.float().cpu().numpy() <= most)  # in a tenth of torch's time
            near = torch.from_numpy(few).to(about.device)
            squared = (columns[:, near] - row[:, None]).square_().sum(dim=0)
            reach = squared.kthvalue(min(k, len(near))).values
            found.append(allowed[near[squared <= (1 + TIE) * reach]])
        return found

    def _columns(self, allowed: Tensor, counts: Tensor) -> tuple[Tensor, ...]:
        """(d, M) scaled first observations of some episodes, their squared norms, and how far rounding goes.

        Those of the last ones asked for are kept.
        """
        known = self._prepared
        if known is None or known[0] is not allowed or known[1] is not self.first:
            first = self.first[allowed]
            if first.shape[1] == 0 or first.isnan().any():
                raise ValueError(
                    "style_sampling='scene': it is not known how these demonstrations began (an earlier "
                    "version made this checkpoint, or there are no observations of numbers); train the "
                    "policy anew, or use style_sampling='uniform'"
                )
            columns = (first * self.scale)[:, counts].T.contiguous()
            norms = columns.square().sum(dim=0)
            self._prepared = known = (allowed, self.first, columns, norms, ROUNDING * (1 + norms.max()))
        return known[2:]
