"""The style cookbook: one trainable style z per demonstration, and how styles are drawn at inference."""

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn

StyleSampling = Literal["uniform", "stratified", "fixed"]


class StyleCookbook(nn.Module):
    """Styles {z_i} of a dataset's episodes.

    Attributes:
        embedding: `nn.Embedding` with one row per episode, (N, style_dim).
        trained: (N,) uint8 buffer, 1 where the episode has been trained on; only those styles are ever drawn.
        active: (B,) int64, the episodes whose styles the current rollout uses; None before its first action.

    Args:
        num_episodes: N.
        style_dim: Dimension of z.
        init_scale: Standard deviation of the normal initialisation.
        sampling: ``uniform`` draws with replacement (eq. 2); ``stratified`` uses each allowed style once, in
            random order, before any is used again; ``fixed`` takes the allowed styles in their given order,
            over and over.
        episodes: The styles that may be drawn, by episode; None allows all that were trained.

    Raises:
        ValueError: For an unknown way of sampling, or a selection that is empty or out of range.
    """

    def __init__(
        self,
        num_episodes: int,
        style_dim: int,
        init_scale: float,
        sampling: StyleSampling = "uniform",
        episodes: Sequence[int] | None = None,
    ):
        super().__init__()
        check_style_sampling(sampling)
        check_style_episodes(episodes, num_episodes)
        self.embedding = nn.Embedding(num_episodes, style_dim)
        nn.init.normal_(self.embedding.weight, std=init_scale)
        self.trained: Tensor
        self.register_buffer("trained", torch.zeros(num_episodes, dtype=torch.uint8))
        self.sampling, self.selected = sampling, episodes
        self.active: Tensor | None = None
        self._queue: list[int] = []

    def __len__(self) -> int:
        """Number of episodes, trained or not."""
        return self.embedding.num_embeddings

    def mark_trained(self, episodes: Tensor) -> None:
        """Remember, in every process, that the (B,) `episodes` were trained on."""
        self.trained[episodes] = 1
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(self.trained, torch.distributed.ReduceOp.MAX)

    def allowed(self) -> Tensor:
        """(M,) int64, the episodes whose styles may be drawn.

        Raises:
            ValueError: If nothing was trained, or a selected style was not.
        """
        trained = self.trained.bool()
        if not trained.any():
            raise ValueError("no style has been trained yet: train the policy, or load a trained checkpoint")
        if self.selected is None:
            return trained.nonzero().squeeze(1)
        untrained = [episode for episode in self.selected if not trained[episode]]
        if untrained:
            raise ValueError(
                f"style_episodes={list(self.selected)}: episodes {untrained} were not in the training data "
                f"of this checkpoint, so they have no style; {int(trained.sum())} of {len(self)} episodes do"
            )
        return torch.tensor(list(self.selected), device=self.trained.device)

    def draw(self, batch_size: int) -> Tensor:
        """Draw the styles of `batch_size` episodes from torch's global generator: (B,) int64, by episode."""
        allowed = self.allowed()
        if self.sampling == "uniform":
            return allowed[torch.randint(len(allowed), (batch_size,), device=allowed.device)]
        while len(self._queue) < batch_size:
            order = torch.arange(len(allowed)) if self.sampling == "fixed" else torch.randperm(len(allowed))
            self._queue += allowed.cpu()[order].tolist()
        drawn, self._queue = self._queue[:batch_size], self._queue[batch_size:]
        return torch.tensor(drawn, device=allowed.device)

    def end_rollout(self) -> None:
        """Forget the active styles; the next action draws new ones."""
        self.active = None

    def active_styles(self, batch_size: int) -> Tensor:
        """(B, style_dim) styles of the rollout under way, drawn at its first action and kept to its end.

        Raises:
            ValueError: If the batch size changes within a rollout.
        """
        if self.active is None:
            self.active = self.draw(batch_size)
        if len(self.active) != batch_size:
            raise ValueError(
                f"batch of {batch_size} observations in a rollout of {len(self.active)} environments: "
                "call policy.reset() before a rollout with another number of environments"
            )
        return self.embedding(self.active)


def check_style_sampling(sampling: str) -> None:
    """Refuse unknown ways of drawing styles.

    Raises:
        ValueError: For anything but ``uniform``, ``stratified`` and ``fixed``.
    """
    if sampling not in ("uniform", "stratified", "fixed"):
        raise ValueError(f"style_sampling={sampling!r}: expected 'uniform', 'stratified' or 'fixed'")


def check_style_episodes(episodes: Sequence[int] | None, num_episodes: int) -> None:
    """Refuse a selection of styles that is empty or names episodes that do not exist.

    Raises:
        ValueError: Naming the selection.
    """
    if episodes is None:
        return
    if len(episodes) == 0:
        raise ValueError("style_episodes=[]: the selection of styles is empty; leave it out to allow all")
    unknown = [episode for episode in episodes if not 0 <= episode < num_episodes]
    if unknown:
        raise ValueError(
            f"style_episodes={list(episodes)}: episodes {unknown} do not exist; "
            f"this cookbook has episodes 0 to {num_episodes - 1}"
        )
