"""How a person's pointer in the picture of an environment becomes an action, and where the tool is in it.

An environment of another package says so in its class's metadata, where the picture shows the plane of its
first two coordinates::

    metadata = {
        "render_fps": 10,
        "pointer": {"x": (0, 512), "y": (512, 0), "action": "position", "speed": 20},
    }

or through its adapter's `Task.pointer` (`lerobot_swr.envs.task`).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from lerobot.utils.constants import OBS_STATE


@dataclass(frozen=True)
class Command:
    """What a person's hand says at one moment.

    Attributes:
        place: Where the pointer is held down, as shares of the picture's width and height from its upper left
            corner; None where it is not held.
        push: Arrow keys or sticks, to the right, up and towards the viewer (a tool's height), each -1 to 1.
    """

    place: tuple[float, float] | None = None
    push: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def is_idle(self) -> bool:
        """Whether the hand is off."""
        return self.place is None and not any(self.push)


class Pointer(ABC):
    """A pointer for one environment. Observations have LeRobot's names, those of one moment (d,)."""

    @abstractmethod
    def action(self, observations: Mapping[str, np.ndarray], command: Command) -> np.ndarray:
        """(A,) float32 action that follows the command; an idle one leaves the tool where it is."""

    @abstractmethod
    def project(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """(T, 2) the tool's places in the picture, as `Command.place`, of observations (T, d)."""


@dataclass(frozen=True)
class PlanePointer(Pointer):
    """The picture shows a plane of the tool's coordinates, as a map does.

    Attributes:
        x: The plane's coordinates at the picture's left and right edge.
        y: Those at its lower and upper edge.
        action: Whether an action is a ``displacement`` or a ``position`` of the tool.
        speed: How far the tool moves in one step at most, in the plane's unit.
        scale: The plane's units that an action of 1 stands for.
        dims: Components of ``observation.state`` that are the tool's coordinates; a third one is its height.

    Raises:
        ValueError: For an unknown kind of action.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    action_is: Literal["displacement", "position"]
    speed: float
    scale: float = 1.0
    dims: tuple[int, ...] = (0, 1)

    @classmethod
    def of_metadata(cls, said: Mapping) -> "PlanePointer":
        """The pointer that an environment's metadata describe.

        Raises:
            ValueError: Naming what is wrong.
        """
        try:
            options = {("action_is" if key == "action" else key): value for key, value in said.items()}
            return cls(**options)
        except TypeError as error:
            raise ValueError(f"metadata['pointer']={said!r}: {error}") from error

    def __post_init__(self) -> None:
        """Check what can be checked without the environment."""
        if self.action_is not in ("displacement", "position"):
            raise ValueError(f"action={self.action_is!r}: expected 'displacement' or 'position'")
        if len(self.dims) not in (2, 3):
            raise ValueError(f"dims={self.dims!r}: a pointer moves two or three coordinates")

    def action(self, observations: Mapping[str, np.ndarray], command: Command) -> np.ndarray:
        """See `Pointer.action`."""
        at = observations[OBS_STATE][list(self.dims)].astype(np.float64)
        step = np.zeros(len(at))
        if command.place is not None:
            step[:2] = self._world(command.place) - at[:2]
        step[:2] += np.array(command.push[:2]) * self.speed * self._directions
        step[2:] = command.push[2] * self.speed
        step *= min(1.0, self.speed / max(np.abs(step).max(), 1e-12))
        return ((step if self.action_is == "displacement" else at + step) / self.scale).astype(np.float32)

    def project(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """See `Pointer.project`."""
        at = observations[OBS_STATE][:, list(self.dims[:2])]
        right = (at[:, 0] - self.x[0]) / (self.x[1] - self.x[0])
        return np.stack([right, 1 - (at[:, 1] - self.y[0]) / (self.y[1] - self.y[0])], axis=1)

    @property
    def _directions(self) -> np.ndarray:
        """(2,) signs of the coordinates to the right and upwards."""
        return np.sign([self.x[1] - self.x[0], self.y[1] - self.y[0]])

    def _world(self, place: tuple[float, float]) -> np.ndarray:
        return np.array([np.interp(place[0], (0, 1), self.x), np.interp(1 - place[1], (0, 1), self.y)])
