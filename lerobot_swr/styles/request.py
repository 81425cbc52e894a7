"""Styles that somebody asks for, instead of leaving them to be drawn."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class StyleRequest:
    """Styles for the next episodes of the environment, taken in order, over and over.

    Attributes:
        episodes: K episodes whose styles are asked for; None where `vectors` are.
        vectors: (K, style_dim) styles that need not be any episode's; None where `episodes` are.

    Raises:
        ValueError: If neither or both are given, or nothing is asked for.
    """

    episodes: Sequence[int] | None = None
    vectors: Tensor | None = None

    def __post_init__(self) -> None:
        """Check that there is something to take."""
        if (self.episodes is None) == (self.vectors is None):
            raise ValueError("a request names episodes or gives vectors, one of the two")
        if len(self) == 0:
            raise ValueError("an empty request: name an episode, or give a style")

    def __len__(self) -> int:
        """K."""
        asked = self.vectors if self.episodes is None else self.episodes
        assert asked is not None
        return len(asked)

    def places(self, first: int, count: int) -> Tensor:
        """(count,) int64, places in the request of the episodes from `first` on."""
        return (first + torch.arange(count)) % len(self)
