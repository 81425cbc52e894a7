"""A scripted hand for the aligning task: flies to the box, lowers the rod, makes contact, steers it home.

It acts on observations alone. The arm lags behind its set-point by several steps, so the hand integrates the
desired position and leads the actual one just enough to overcome the box's friction; a fixed lead would
oscillate.
"""

import enum
import math
from dataclasses import dataclass

import numpy as np

from lerobot_swr.demos.box_steering import (
    Gains,
    Grip,
    PlanePose,
    from_frame,
    heading_costs,
    headings,
    pivot_curvature,
    rod_directions,
    to_frame,
    wrap,
)

MAX_STEP = 0.009  # m per step of the desired position
LEAD = 0.009  # m by which the desired position leads the actual one while the box slides
MAX_GRIPS = 2  # times that the rod is lowered in one episode; longer stories teach a policy little


@dataclass(frozen=True)
class Habits:
    """What differs between two demonstrations.

    Attributes:
        grip: Where the rod takes hold of the box.
        choice: Which of the headings is taken, in the order of their costs (0: the best).
        gains: Of the steering.
        pace: Relative speed.
        flying_z: Tool height above the box, m.
        working_z: Tool height while steering, m.
        pause: Steps of hesitation before lowering the rod.
        tremor: Standard deviation of the hand's noise, m.
    """

    grip: Grip
    choice: int
    gains: Gains
    pace: float
    flying_z: float
    working_z: float
    pause: int
    tremor: float


class Phase(enum.Enum):
    """What the hand is doing."""

    LIFT = enum.auto()
    FLY = enum.auto()
    LOWER = enum.auto()
    TOUCH = enum.auto()
    STEER = enum.auto()


class BoxHandler:
    """One demonstration's hand: maps observations to changes of the desired position.

    Args:
        habits: See `Habits`.
        rng: Source of tremor.
    """

    def __init__(self, habits: Habits, rng: np.random.Generator):
        self.habits = habits
        self._rng = rng
        self._phase = Phase.LIFT
        self._psi: float | None = None
        self._grips = 0
        self._pause = habits.pause
        self._noise: np.ndarray = np.zeros(3)
        self.gave_up = False

    def act(self, state: np.ndarray, scene: np.ndarray) -> np.ndarray:
        """(3,) change of the desired position, given ``agent_pos`` (6,) and ``environment_state`` (14,)."""
        desired, actual = np.array(state[:3], np.float64), np.array(state[3:], np.float64)
        box, target = _plane_pose(scene[:7]), _plane_pose(scene[7:])
        if self._psi is None:
            self._psi = self._choose_heading(box, target)
        step = self._next_step(desired, actual, box, target)
        self._noise = 0.9 * self._noise + math.sqrt(1 - 0.81) * self._rng.standard_normal(3)
        step += self.habits.tremor * self._noise * np.array([1.0, 1.0, 0.3])
        return _limited(step, MAX_STEP)

    def _choose_heading(self, box: PlanePose, target: PlanePose) -> float:
        costs = heading_costs(box, target, self.habits.grip)
        choice = self.habits.choice if self._grips == 0 else 0
        return headings(self.habits.grip)[int(np.argsort(costs)[choice])]

    def _next_step(
        self, desired: np.ndarray, actual: np.ndarray, box: PlanePose, target: PlanePose
    ) -> np.ndarray:
        assert self._psi is not None
        habits, grip = self.habits, self.habits.grip
        heading = PlanePose(box.x, box.y, box.angle + self._psi)
        goal = PlanePose(target.x, target.y, target.angle + self._psi)
        rod = to_frame(actual[:2] - box.position, heading.angle)
        above = box.position + from_frame(np.array([grip.above, 0.0]), heading.angle)

        if self._phase is Phase.LIFT and actual[2] > habits.flying_z - 0.02:
            self._phase = Phase.FLY
        if self._phase is Phase.FLY and np.linalg.norm(actual[:2] - above) < 0.012:
            self._pause -= 1
            if self._pause < 0:
                self._phase = Phase.LOWER
                self._grips += 1
        if self._phase is Phase.LOWER and actual[2] < habits.working_z + 0.012:
            self._phase = Phase.TOUCH
        if self._phase is Phase.TOUCH and rod[0] > grip.touching:
            self._phase = Phase.STEER
        curvature, ahead = pivot_curvature(heading, goal, grip, habits.gains)
        if self._phase is Phase.STEER and (ahead < -0.012 or self._lost(rod)):
            if self._grips == MAX_GRIPS:
                self.gave_up = True
            self._phase = Phase.LIFT
            # The remaining way is short, so that the yaw wanted at its end decides.
            self._psi = self._choose_heading(PlanePose(box.x, box.y, target.angle), target)

        pace = habits.pace
        if self._phase is Phase.LIFT:
            return np.array([0.0, 0.0, min(MAX_STEP * pace, habits.flying_z - desired[2])])
        if self._phase is Phase.FLY:
            return _towards(desired, np.array([*above, habits.flying_z]), MAX_STEP * pace)
        if self._phase is Phase.LOWER:
            return _towards(desired, np.array([*above, habits.working_z]), MAX_STEP * pace)
        if self._phase is Phase.TOUCH:
            velocity, force = np.array([1.0, -4.0 * rod[1]]), np.zeros(2)
        else:
            velocity, force = rod_directions(curvature, float(rod[1]), grip)
        slow = 0.6 if abs(ahead) < 0.06 else 1.0
        v, f = from_frame(velocity, heading.angle), from_frame(force, heading.angle)
        lag = desired[:2] - actual[:2]
        plane = pace * slow * 0.006 * v + 0.12 * (LEAD * f + LEAD * pace * v - lag)
        return np.array([*_limited(plane, MAX_STEP), np.clip(habits.working_z - desired[2], -0.003, 0.003)])

    def _lost(self, rod: np.ndarray) -> bool:
        """Whether the rod, at `rod` (2,) in the heading frame, cannot move the box on as intended."""
        if self.habits.grip.inside:
            return bool(np.linalg.norm(rod) > 0.075)
        return bool(abs(rod[1]) > 0.064 or rod[0] < -0.11)


def _plane_pose(pose: np.ndarray) -> PlanePose:
    """Position and yaw of a (7,) pose."""
    w, x, y, z = (float(part) for part in pose[3:7])
    return PlanePose(
        float(pose[0]), float(pose[1]), wrap(math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    )


def _limited(step: np.ndarray, limit: float) -> np.ndarray:
    length = float(np.linalg.norm(step))
    return step if length <= limit else step * (limit / length)


def _towards(position: np.ndarray, goal: np.ndarray, limit: float) -> np.ndarray:
    return _limited(goal - position, limit)
