"""Perturbations of the D3IL tasks: a shifted start, noisy actions, a pushed box. All off by default."""

from dataclasses import dataclass

import numpy as np

PUSH_STEPS = (10, 150)
"""First and last step before which the box may be pushed."""
GRAVITY = 9.81


@dataclass(frozen=True)
class ArmPerturbations:
    """How an episode differs from the benchmark's.

    Attributes:
        start_radius: Half the side of the square in which the tool's start is drawn uniformly, around its
            usual place in the table's plane, in metres.
        action_noise: Standard deviation of the Gaussian noise on each coordinate of every action, in metres.
        box_push: How far a push moves a box that stands free, in metres; aligning only.

    Raises:
        ValueError: For a negative value.
    """

    start_radius: float = 0.0
    action_noise: float = 0.0
    box_push: float = 0.0

    def __post_init__(self) -> None:
        """Check the values."""
        for key, value in vars(self).items():
            if not 0 <= value < np.inf:
                raise ValueError(f"{key}={value}: expected a length in metres, 0 or more")

    def draw_shift(self, rng: np.random.Generator) -> np.ndarray:
        """(3,) shift of the start, in metres; draws nothing without one."""
        if self.start_radius == 0:
            return np.zeros(3)
        return np.append(rng.uniform(-self.start_radius, self.start_radius, size=2), 0.0)

    def disturb(self, action: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """An action (A,) with noise; draws nothing without noise."""
        if self.action_noise == 0:
            return action
        return action + self.action_noise * rng.standard_normal(len(action))

    def draw_push(self, friction: float, rng: np.random.Generator) -> tuple[int, np.ndarray] | None:
        """Before which step the box is pushed, and its (2,) velocity in m/s; None without a push.

        A box that slides with friction μ stops after v² / (2 μ g).
        """
        if self.box_push == 0:
            return None
        step, angle = int(rng.integers(PUSH_STEPS[0], PUSH_STEPS[1] + 1)), rng.uniform(0, 2 * np.pi)
        speed = np.sqrt(2 * friction * GRAVITY * self.box_push)
        return step, speed * np.array([np.cos(angle), np.sin(angle)])
