"""Styles that somebody asks for, instead of leaving them to be drawn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import index

import torch
from torch import Tensor

from lerobot_swr.styles.selection import StyleSelection


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
