"""Which numbers of an episode behaviours are found by."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from lerobot_swr.user_functions import load_function

Episode = Mapping[str, np.ndarray]
FeatureFunction = Callable[[Episode], np.ndarray]


@dataclass(frozen=True)
class Source:
    """Where the numbers come from.

    Attributes:
        keys: Features whose values side by side are the states, if there is no function.
        function: ``module:function`` that maps an episode to (T', d) states or to a vector (d,); or None.
    """

    keys: tuple[str, ...]
    function: str | None = None

    def __post_init__(self) -> None:
        """Import the function.

        Raises:
            ValueError: If there is none of that name.
        """
        if self.function is not None:
            object.__setattr__(self, "_call", load_function("features", self.function))

    def states(self, episode: Episode) -> np.ndarray:
        """(T, d) states, or (1, d) for a vector, of an episode.

        Raises:
            ValueError: If the episode lacks a key, or the function fails or returns something else.
        """
        if self.function is None:
            absent = [key for key in self.keys if key not in episode]
            if absent:
                raise ValueError(
                    f"the behaviours were found by {', '.join(self.keys)}, but this episode has no "
                    f"{', '.join(absent)} (it has {', '.join(episode)}); find them anew by what is there: "
                    "lerobot-swr-behaviors --keys=[...]"
                )
            return np.concatenate([_two(episode[key]) for key in self.keys], axis=1, dtype=np.float64)
        try:
            value = np.asarray(self._call(episode), dtype=np.float64)  # type: ignore[attr-defined]
        except Exception as error:  # whatever a user's function raises
            raise ValueError(f"features={self.function!r} fails on an episode: {error!r}") from error
        if value.ndim not in (1, 2) or not value.size or not np.isfinite(value).all():
            raise ValueError(
                f"features={self.function!r} returns an array of shape {value.shape}; expected finite "
                "numbers of shape (T, d), a path, or (d,), one vector"
            )
        return value if value.ndim == 2 else value[None]


def _two(values: np.ndarray) -> np.ndarray:
    return np.asarray(values).reshape(len(values), -1)
