"""A dataset recipe: the name, the features and the seeded source of demonstrations of one dataset."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_swr.behaviors import BehaviorRule


@dataclass(frozen=True)
class Demonstration:
    """One recorded episode.

    Attributes:
        observations: LeRobot feature name to a float32 array (T, d): the state in which each action was
            taken. The last one already fulfils the task, so that the behaviour can be read from the states
            alone.
        actions: (T, A) float32, the action taken in each state, in the environment's units.
    """

    observations: Mapping[str, np.ndarray]
    actions: np.ndarray


@dataclass(frozen=True)
class DatasetRecipe:
    """How one of the package's datasets is made.

    Attributes:
        name: What ``lerobot-swr-dataset --task=`` calls it.
        instruction: Natural-language task stored with every frame.
        fps: Control rate of the environment, in Hz.
        robot_type: Stored in the dataset's metadata.
        features: LeRobot feature name (observations and ``action``) to the names of its dimensions.
        n_episodes: Number of demonstrations.
        demonstrations: Maps a seed to the episodes, in their order in the dataset. Deterministic in the seed.
        behavior_rule: Labels an episode of this dataset.
        resumable_demonstrations: For a source that takes long, if not None: the same episodes, made on all
            cores; finished ones are kept in the folder given, and those that an interrupted run with the same
            seed left there are used.
        pictures: What the task's camera sees in every state of a demonstration, (T, height, width, 3) uint8;
            None where there is no camera.
        picture_size: Height and width of these.
        resized: The same recipe for another number of episodes; None where it has one number only.
    """

    name: str
    instruction: str
    fps: int
    robot_type: str
    features: Mapping[str, tuple[str, ...]]
    n_episodes: int
    demonstrations: Callable[[int], Iterator[Demonstration]]
    behavior_rule: BehaviorRule
    resumable_demonstrations: Callable[[int, Path], Iterator[Demonstration]] | None = None
    pictures: Callable[[Demonstration], np.ndarray] | None = None
    picture_size: tuple[int, int] = (0, 0)
    resized: "Callable[[int], DatasetRecipe] | None" = None

    def with_episodes(self, n_episodes: int) -> "DatasetRecipe":
        """The recipe for another number of episodes.

        Raises:
            ValueError: If it is not for another number, or that is none.
        """
        if n_episodes < 1:
            raise ValueError(f"n_episodes={n_episodes}: expected at least 1")
        if self.resized is None:
            raise ValueError(
                f"n_episodes={n_episodes}: {self.name} always has {self.n_episodes} episodes; leave it out"
            )
        return self.resized(n_episodes)
