"""Steering mode: what is known of a policy's styles, what was asked of it, and what it showed."""

import shlex
from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from lerobot_swr.interactive.session import Session
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.filters import column_kind
from lerobot_swr.styles.map import project_styles
from lerobot_swr.trajectories import Trajectories

FREE = ""  # stands for the behaviour asked for where styles are drawn freely, or there is no label


class Steering:
    """Requests of styles in a session, and their outcomes.

    Args:
        session: With a policy; one without styles can be watched and disturbed.
        demonstrations: The training dataset, for the paths in the map; None leaves them out.

    Raises:
        ValueError: If the dataset has fewer episodes than the cookbook has trained styles.
    """

    def __init__(self, session: Session, demonstrations: Trajectories | None = None):
        assert session.checkpoint is not None
        self._session = session
        self.styles: StyleCookbook | None = (
            session.checkpoint.policy.styles if session.checkpoint.has_styles else None
        )
        self._demonstrations = demonstrations
        self._asked: list[int] = []
        self._text = ""
        self._outcomes: dict[str, Counter[str]] = defaultdict(Counter)
        self._switched = False
        self.successes = self.episodes = 0

    def request(self, episodes: Sequence[int]) -> None:
        """Ask for the styles of some episodes, from the next step on."""
        self._session.steer(list(episodes))
        self._ask(list(episodes), f"--policy.style_episodes='[{','.join(map(str, episodes))}]'")

    def request_filter(self, text: str) -> None:
        """Ask for the styles that match a filter, or the filter of that name."""
        styles = self._styles()
        named = {} if styles.table is None else styles.table.filters
        text = text.strip()
        matching = styles.filter(named.get(text, text))
        self._session.steer(text)
        self._ask(matching, f"--policy.style_filter={shlex.quote(named.get(text, text))}")

    def free(self) -> None:
        """Let styles be drawn again, from the next rollout on."""
        self._styles().request(None)
        self._ask([], "")

    def begin(self) -> None:
        """A rollout begins."""
        self._switched = False

    def end(self) -> None:
        """A rollout has ended: count what it showed, unless it was asked for something else on its way."""
        scene = self._session.scene
        self.episodes += 1
        self.successes += scene.success
        if not self._switched:
            self._outcomes[self.requested()][self._session.behavior()] += 1

    def requested(self) -> str:
        """Behaviour of the demonstration whose style acts."""
        style, table = self._session.scene.style, None if self.styles is None else self.styles.table
        if style is None or table is None or "behavior" not in table.columns:
            return FREE
        return str(table.columns["behavior"][style])

    def state(self) -> dict[str, Any]:
        """What the page shows of requests and outcomes."""
        return {
            "asked": self._asked,
            "flag": self._text,
            "outcomes": {requested: dict(shown) for requested, shown in self._outcomes.items()},
            "episodes": self.episodes,
            "successes": self.successes,
        }

    def map(self) -> dict[str, Any] | None:
        """The styles as points of a map, with their demonstrations' columns, paths and the named filters."""
        if self.styles is None:
            return None
        episodes = np.flatnonzero(self.styles.trained.bool().cpu().numpy()).tolist()
        vectors = self.styles.embedding.weight.detach().cpu().numpy()[episodes]
        table = self.styles.table
        columns = {} if table is None else table.columns
        columns = {name: [_told(values[i]) for i in episodes] for name, values in columns.items()}
        projections = {name: np.round(flat, 4).tolist() for name, flat in project_styles(vectors).items()}
        return {
            "episodes": episodes,
            "projections": projections,
            "columns": columns,
            "kinds": {name: column_kind(values) for name, values in columns.items() if None not in values},
            "color": next((name for name in ("behavior", "length") if name in columns), None),
            "filters": {} if table is None else table.filters,
            "paths": self._paths(episodes),
        }

    def _paths(self, episodes: list[int]) -> dict[int, list]:
        """Where each demonstration led through the picture."""
        data, pointer = self._demonstrations, self._session.pointer
        if data is None:
            return {}
        known = [i for i in episodes if i < len(data)]
        if pointer is None:
            return {}
        paths = {}
        for i in known:
            path = pointer.project(data.episode(i))
            chosen = np.linspace(0, len(path) - 1, min(len(path), 60)).round().astype(int)
            paths[i] = np.round(path[chosen].astype(float), 4).tolist()
        return paths

    def _ask(self, episodes: list[int], text: str) -> None:
        self._asked, self._text = episodes, text
        self._switched = self._session.scene.steps > 0 and not self._session.scene.over

    def _styles(self) -> StyleCookbook:
        if self.styles is None:
            raise ValueError("this policy has no styles: it can be watched and disturbed, not steered")
        return self.styles


def _told(value: Any) -> Any:
    """A value as a page can read it, which knows no infinite numbers."""
    return None if isinstance(value, float) and not np.isfinite(value) else value
