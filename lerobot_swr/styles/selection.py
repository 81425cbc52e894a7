"""Which styles may be drawn: the selection that flags or Python code describe, resolved to episodes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.styles.filters import describe_columns, parse_filter
from lerobot_swr.styles.table import MAX_NEIGHBOURS, StyleTable


@dataclass(frozen=True)
class StyleSelection:
    """Conditions on the demonstrations whose styles may be drawn; they all have to hold.

    Attributes:
        episodes: Only these, in this order; None allows all.
        filter: Only those that match the filter; None allows all.
        like: Only this episode and those nearest to it by dissimilarity ν, nearest first; None allows all.
        neighbours: How many of the nearest others `like` allows.

    Raises:
        ValueError: If the selection is empty whatever the dataset, or the filter is none.
    """

    episodes: Sequence[int] | None = None
    filter: str | None = None
    like: int | None = None
    neighbours: int = 5

    def __post_init__(self) -> None:
        """Check what can be checked without a dataset."""
        if self.episodes is not None and len(self.episodes) == 0:
            raise ValueError("style_episodes=[]: the selection of styles is empty; leave it out to allow all")
        if self.filter is not None:
            parse_filter(self.filter)
        if not 0 <= self.neighbours <= MAX_NEIGHBOURS:
            raise ValueError(f"style_neighbours={self.neighbours}: expected 0 to {MAX_NEIGHBOURS}")

    def check_episodes(self, num_episodes: int) -> None:
        """Refuse episodes that do not exist.

        Raises:
            ValueError: Naming them.
        """
        given = [("style_episodes", list(self.episodes))] if self.episodes is not None else []
        given += [("style_like", [self.like])] if self.like is not None else []
        for key, episodes in given:
            unknown = [episode for episode in episodes if not 0 <= episode < num_episodes]
            if unknown:
                raise ValueError(
                    f"{key}={episodes}: episodes {unknown} do not exist; "
                    f"this cookbook has episodes 0 to {num_episodes - 1}"
                )

    def resolve(self, trained: np.ndarray, table: StyleTable | None, name: str | None = None) -> list[int]:
        """The episodes whose styles may be drawn.

        Args:
            trained: (N,) bool, which episodes have a style.
            table: The demonstrations' table, if the checkpoint has one.
            name: A named filter of the table that has to hold, too.

        Raises:
            ValueError: If nothing is left, an episode of the list has no style, or the table is missing.
        """
        if not trained.any():
            raise ValueError("no style has been trained yet: train the policy, or load a trained checkpoint")
        allowed = np.flatnonzero(trained).tolist()
        if self.like is not None:
            others = self._table(table, f"style_like={self.like}").neighbours[self.like].tolist()
            near = [i for i in others if i >= 0 and trained[i]]
            allowed = [i for i in (self.like,) if trained[i]] + near[: self.neighbours]
        if self.episodes is not None:
            untrained = [i for i in self.episodes if not trained[i]]
            if untrained:
                raise ValueError(
                    f"style_episodes={list(self.episodes)}: episodes {untrained} were not in the training "
                    f"data of this checkpoint, so they have no style; {int(trained.sum())} of {len(trained)} "
                    "episodes do"
                )
            allowed = [i for i in self.episodes if i in set(allowed)]
        for text in self._filters(table, name):
            matching = self._table(table, f"style_filter={text!r}").matches(text)
            allowed = [i for i in allowed if matching[i]]
        if not allowed:
            raise ValueError(self._nothing_left(trained, table, name))
        return allowed

    def _filters(self, table: StyleTable | None, name: str | None) -> list[str]:
        own = [] if self.filter is None else [self.filter]
        return own + ([] if name is None or table is None else [table.filters[name]])

    @staticmethod
    def _table(table: StyleTable | None, flag: str) -> StyleTable:
        if table is None:
            raise ValueError(
                f"{flag}: this checkpoint has no table of its demonstrations (an earlier version made it); "
                "make one with lerobot-swr-styles CHECKPOINT --dataset.root=TRAINING_DATASET"
            )
        return table

    def _nothing_left(self, trained: np.ndarray, table: StyleTable | None, name: str | None) -> str:
        flags = {
            "style_episodes": None if self.episodes is None else list(self.episodes),
            "style_like": self.like,
            "style_filter": self.filter,
            "task": name,
        }
        given = ", ".join(f"{key}={value!r}" for key, value in flags.items() if value is not None)
        known = {}
        if table is not None:
            known = {
                key: [values[i] for i in np.flatnonzero(trained)] for key, values in table.columns.items()
            }
        return f"{given}: no style is left to draw; the demonstrations have: {describe_columns(known)}"


@dataclass(frozen=True, eq=False)
class ResolvedSelection:
    """Which episodes a selection allowed, for it takes long to find that out of very many.

    Attributes:
        selection: The selection.
        table: The table by which it was resolved.
        trained: (N,) which episodes had a style.
    """

    selection: StyleSelection
    table: StyleTable | None
    trained: Tensor
    _episodes: dict[str | None, Tensor] = field(default_factory=dict)

    def allowed(self, name: str | None) -> Tensor:
        """(M,) int64 episodes that match a further filter of this name, too; None for none.

        Raises:
            ValueError: As `StyleSelection.resolve` does.
        """
        if name not in self._episodes:
            found = self.selection.resolve(self.trained.bool().cpu().numpy(), self.table, name)
            self._episodes[name] = torch.tensor(found, device=self.trained.device)
        return self._episodes[name]

    def holds(self, selection: StyleSelection, table: StyleTable | None, trained: Tensor) -> bool:
        """Whether it is what the selection would give now."""
        same = self.selection is selection and self.table is table and self.trained.shape == trained.shape
        return same and self.trained.device == trained.device and torch.equal(self.trained, trained)
