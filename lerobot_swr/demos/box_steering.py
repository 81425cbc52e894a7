"""Steering a box over a table with a rod: pushing it from behind, or pulling it from inside.

Both are the same problem as parking a trailer. Sliding slowly, the box obeys a limit surface: a force (f1,
f2) at the contact point makes it move along the force and turn by the moment over a *compliance*. So the
contact point's velocity in the box's heading frame decides the curvature of the path of a *pivot* on the
heading axis, and a pose-stabilising law for that pivot brings the box to its target pose.

All quantities are in the table's plane; the heading frame has its origin in the box's centre and its first
axis along the heading, the direction in which the box is moved.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np


class PlanePose(NamedTuple):
    """Position in m and direction in rad."""

    x: float
    y: float
    angle: float

    @property
    def position(self) -> np.ndarray:
        """(2,) position."""
        return np.array([self.x, self.y])


@dataclass(frozen=True)
class Grip:
    """Where the rod touches the box, on the heading axis of the heading frame.

    Attributes:
        inside: Pull from inside a corner (ahead of the centre), which takes force in any forward direction,
            or push at a face (behind the centre), where friction takes the lateral force.
        contact: x of the contact point, m.
        above: x over which the rod is lowered, m.
        touching: x of the rod from which it can be taken to touch, m.
        compliance: Turn per moment relative to motion per force, m^2.
    """

    inside: bool
    contact: float
    above: float
    touching: float
    compliance: float

    @property
    def pivot(self) -> float:
        """Place (x, m) of the point that moves along the heading, whatever the curvature."""
        return -self.compliance / self.contact


# Compliances: the best of a few tried on 20 contexts that no dataset contains.
INSIDE_CORNER = Grip(inside=True, contact=0.0495, above=0.03, touching=0.0465, compliance=0.0015)
OUTSIDE_FACE = Grip(inside=False, contact=-0.055, above=-0.088, touching=-0.0665, compliance=0.0035)


@dataclass(frozen=True)
class Gains:
    """How sharply the pivot is steered.

    Attributes:
        turn: How far ahead of the goal line the heading turns.
        approach: How fast it turns.
        smallest_distance: Distance (m) below which curvature grows no further.
    """

    turn: float
    approach: float
    smallest_distance: float


def wrap(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def direction(angle: float) -> np.ndarray:
    """(2,) unit vector."""
    return np.array([math.cos(angle), math.sin(angle)])


def to_frame(vector: np.ndarray, angle: float) -> np.ndarray:
    """`vector` (2,) in axes turned by `angle`."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] + s * vector[1], -s * vector[0] + c * vector[1]])


def from_frame(vector: np.ndarray, angle: float) -> np.ndarray:
    """Inverse of `to_frame`."""
    return to_frame(vector, -angle)


def headings(grip: Grip) -> list[float]:
    """The four headings relative to the box's yaw: its corners or its faces."""
    return [(math.pi / 4 if grip.inside else 0.0) + k * math.pi / 2 for k in range(4)]


def heading_costs(box: PlanePose, target: PlanePose, grip: Grip) -> np.ndarray:
    """(4,) squared turns that each of `headings` asks for, from its start to the way and then to its end."""
    way = math.atan2(target.y - box.y, target.x - box.x)
    return np.array(
        [wrap(box.angle + psi - way) ** 2 + wrap(target.angle + psi - way) ** 2 for psi in headings(grip)]
    )


def pivot_curvature(heading: PlanePose, goal: PlanePose, grip: Grip, gains: Gains) -> tuple[float, float]:
    """Curvature (1/m) of the pivot's path, and its distance (m) ahead to its goal.

    Args:
        heading: Box centre and its heading.
        goal: Target centre and the heading wanted there.
        grip: Where the rod touches.
        gains: See `Gains`.

    Source: Park and Kuipers, "A smooth control law for graceful motion of differential wheeled mobile
    robots", ICRA 2011; within 5 cm of the goal, a linear law on its goal line.
    """
    pivot = heading.position + grip.pivot * direction(heading.angle)
    pivot_goal = goal.position + grip.pivot * direction(goal.angle)
    offset = pivot_goal - pivot
    distance = float(np.linalg.norm(offset))
    along, across = to_frame(offset, goal.angle)
    if distance < 0.05:
        return (-2.0 * wrap(heading.angle - goal.angle) + 12.0 * across) / 0.08, along
    line_of_sight = math.atan2(offset[1], offset[0])
    delta, theta = wrap(heading.angle - line_of_sight), wrap(goal.angle - line_of_sight)
    wanted = math.atan(-gains.turn * theta)
    bend = (1 + gains.turn / (1 + (gains.turn * theta) ** 2)) * math.sin(delta)
    curvature = -(gains.approach * (delta - wanted) + bend) / max(distance, gains.smallest_distance)
    return curvature, distance


def rod_directions(curvature: float, rod_y: float, grip: Grip) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and force of the rod, (2,) unit vectors in the heading frame, that give the box a curvature.

    Args:
        curvature: Wanted curvature of the pivot's path, 1/m.
        rod_y: Lateral offset of the rod in the heading frame, m.
        grip: Where the rod touches.
    """
    x = grip.contact
    if grip.inside:
        angle = np.clip(math.atan(curvature * (x - grip.pivot)), -math.radians(78), math.radians(78))
        velocity = direction(float(angle))
        force = np.array([velocity[0], velocity[1] / (1 + x * x / grip.compliance)])
    else:
        # Friction between rod and box is 1; a little less keeps the rod from slipping along the face.
        force = np.array([1.0, np.clip((curvature * grip.compliance + rod_y) / x, -0.9, 0.9)])
        turn = (x * force[1] - rod_y * force[0]) / grip.compliance
        velocity = force + turn * np.array([-rod_y, x])
    return velocity / np.linalg.norm(velocity), force / np.linalg.norm(force)
