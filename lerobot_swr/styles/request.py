"""Styles that somebody asks for, instead of leaving them to be drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import index

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.styles.selection import StyleSelection
from lerobot_swr.styles.table import StyleTable

BLENDED = -1  # stands in `StyleCookbook.active` for a style that is no single episode's


@dataclass(frozen=True, eq=False)
class StyleRequest:
    """Styles for the next episodes of the environment, taken in order, over and over.

    Attributes:
        episodes: K episodes whose styles are asked for; None where another field says it.
        vectors: (K, style_dim) styles that need not be any episode's.
        choices: K lists of episodes; of each one style is drawn, in the cookbook's way (by scene, for one).

    Raises:
        ValueError: If not just one of them is given, or nothing is asked for.
    """

    episodes: Sequence[int] | None = None
    vectors: Tensor | None = None
    choices: Sequence[Sequence[int]] | None = None

    def __post_init__(self) -> None:
        """Check that there is something to take."""
        if sum(asked is not None for asked in (self.episodes, self.vectors, self.choices)) != 1:
            raise ValueError("a request names episodes (or choices of them) or gives vectors, one of the two")
        if len(self) == 0 or any(len(choice) == 0 for choice in self.choices or ()):
            raise ValueError("an empty request: name an episode, or give a style")

    @property
    def named(self) -> list[int]:
        """The episodes whose styles may be used; empty where vectors are given."""
        return [*(self.episodes or ()), *(i for choice in self.choices or () for i in choice)]

    def __len__(self) -> int:
        """K."""
        for asked in (self.episodes, self.vectors, self.choices):
            if asked is not None:
                return len(asked)
        return 0

    def places(self, first: int, count: int) -> Tensor:
        """(count,) int64, places in the request of the episodes from `first` on."""
        return (first + torch.arange(count)) % len(self)


Styles = StyleRequest | StyleSelection | str | int | Sequence[int] | Tensor | None
"""What a user may name styles by; see `as_request`."""


def as_request(styles: Styles, filters: Mapping[str, str]) -> StyleRequest | StyleSelection | None:
    """What a user asks for, in one of its many forms.

    Args:
        styles: An episode or several, (K, style_dim) or (style_dim,) vectors, a filter or the name of one,
            a selection, or a request as it is; None for nothing.
        filters: Named filters.

    Raises:
        ValueError: If the text is no filter, or nothing is asked for.
    """
    if styles is None or isinstance(styles, StyleRequest | StyleSelection):
        return styles
    if isinstance(styles, str):
        return StyleSelection(filter=filters.get(styles, styles))
    if isinstance(styles, Tensor):
        return StyleRequest(vectors=torch.atleast_2d(styles))
    if isinstance(styles, Sequence):
        return StyleRequest([index(episode) for episode in styles])  # type: ignore[arg-type]
    return StyleRequest([index(styles)])


def check_request(
    asked: StyleRequest | StyleSelection, trained: np.ndarray, table: StyleTable | None, style_dim: int
) -> None:
    """Refuse a request that cannot be served.

    Args:
        asked: The request.
        trained: (N,) bool, which episodes have a style.
        table: The demonstrations' table, if there is one.
        style_dim: Dimension of a style.

    Raises:
        ValueError: If an episode has no style, nothing matches, or vectors have other dimensions.
    """
    if isinstance(asked, StyleRequest):
        if asked.vectors is not None and asked.vectors.shape[1:] != (style_dim,):
            raise ValueError(
                f"styles of shape {list(asked.vectors.shape)}: this cookbook's have {style_dim} dimensions, "
                f"give (K, {style_dim})"
            )
        if not asked.named:
            return
        asked, table = StyleSelection(episodes=asked.named), None
    asked.check_episodes(len(trained))
    asked.resolve(trained, table)
