"""How styles are drawn for the episodes of an environment, of those that are allowed."""

from typing import Literal

import torch
from torch import Tensor

StyleSampling = Literal["uniform", "stratified", "fixed"]


class StyleDrawing:
    """Draws one of the allowed styles for every episode, from torch's global generator.

    Args:
        sampling: ``uniform`` draws with replacement (eq. 2); ``stratified`` uses each allowed style once, in
            random order, before any is used again; ``fixed`` takes the allowed styles in their given order,
            over and over.

    Raises:
        ValueError: For an unknown way of sampling.
    """

    def __init__(self, sampling: StyleSampling):
        check_style_sampling(sampling)
        self.sampling = sampling
        self._queues: dict[str | None, list[int]] = {}

    def restart(self) -> None:
        """Begin anew where styles are drawn in turn: the next draws do not depend on earlier ones."""
        self._queues = {}

    def draw(self, allowed: Tensor, count: int, name: str | None = None) -> Tensor:
        """(count,) int64 of the (M,) `allowed`.

        Args:
            allowed: Episodes whose styles may be drawn.
            count: Number of draws.
            name: Of the selection that allows them: each is drawn in turn for itself.
        """
        if self.sampling == "uniform":
            return allowed[torch.randint(len(allowed), (count,), device=allowed.device)]
        queue = self._queues.setdefault(name, [])
        while len(queue) < count:
            order = torch.arange(len(allowed)) if self.sampling == "fixed" else torch.randperm(len(allowed))
            queue += allowed.cpu()[order].tolist()
        self._queues[name] = queue[count:]
        return torch.tensor(queue[:count], device=allowed.device)


def check_style_sampling(sampling: str) -> None:
    """Refuse unknown ways of drawing styles.

    Raises:
        ValueError: For anything but ``uniform``, ``stratified`` and ``fixed``.
    """
    if sampling not in ("uniform", "stratified", "fixed"):
        raise ValueError(f"style_sampling={sampling!r}: expected 'uniform', 'stratified' or 'fixed'")
