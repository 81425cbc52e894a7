"""What a check is: a question with options of its own, about a policy and its demonstrations."""

import abc
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import draccus
from lerobot.envs import EnvConfig

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.evaluation.checkpoint import Checkpoint, DatasetSource
from lerobot_swr.evaluation.rollouts import RolloutOptions
from lerobot_swr.trajectories import Trajectories

ROLLOUTS = frozenset({"n_episodes", "batch_size", "style_sampling", "recorded_starts"})
"""The options of `RolloutOptions` that a check with rollouts of its own heeds."""


@dataclass(frozen=True)
class Subject:
    """What a check is about.

    Attributes:
        dataset: Where the demonstrations are.
        trajectories: All of them.
        rollouts: How many rollouts, and how.
        actor: The policy, or the baseline in its place; None where none acts.
        env: The environment; None without one.
        rule: Labels an episode; None where the environment has no rule and none is named.
    """

    dataset: DatasetSource
    trajectories: Trajectories
    rollouts: RolloutOptions = field(default_factory=RolloutOptions)
    actor: Checkpoint | None = None
    env: EnvConfig | None = None
    rule: BehaviorRule | None = None

    @property
    def title(self) -> str:
        """Heading of tables and pictures."""
        name = Path(self.trajectories.name).name
        return name if self.actor is None else f"{self.actor.policy.config.type} on {name}"


@dataclass(frozen=True)
class Finding:
    """What a check found.

    Attributes:
        result: A dataclass, for the JSON file.
        text: For the terminal.
        draw: Writes the picture.
    """

    result: Any
    text: str
    draw: Callable[[Path], None] | None = None


@dataclass
class Check(draccus.ChoiceRegistry, abc.ABC):
    """Options of a check, and how it is made.

    Attributes:
        file: Name of its JSON file and picture, without ending.
        heeds: Options of the command, beside those that every check heeds, that have an effect on it.
        actor: Who acts: only a ``policy``, ``any`` (a policy or playback), or ``none``.
        needs_env: Whether it acts in an environment; the others know none.
        needs_rule: Whether it labels behaviours.
        style_sampling: How styles are drawn where nobody says; None as the checkpoint does.
    """

    file: ClassVar[str]
    heeds: ClassVar[frozenset[str]] = frozenset()
    actor: ClassVar[Literal["policy", "any", "none"]] = "any"
    needs_env: ClassVar[bool] = True
    needs_rule: ClassVar[bool] = True
    style_sampling: ClassVar[str | None] = None

    @property
    def type(self) -> str:
        """Its name in ``--check.type``."""
        return self.get_choice_name(self.__class__)

    @abc.abstractmethod
    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """Make the check.

        Args:
            subject: What it is about.
            keep: Writes a result that is not complete yet, so that an interruption loses nothing.

        Raises:
            ValueError: If the subject lacks what the check needs, before any work.
        """
