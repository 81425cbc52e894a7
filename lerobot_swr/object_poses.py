"""Poses of things in observations, found by the names of their dimensions, and the frames that they span.

A dimension is called ``<thing>.<part>``: ``box.x``, ``box.qw``, ``goal_y``. Parts are x, y and z of the
position, qw, qx, qy and qz of a unit quaternion, or yaw for things that turn in the plane. The thing without
a name (``x``), or with one of `HANDS`, is the robot's hand.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

HANDS = ("", "hand", "tool", "tcp", "ee", "eef", "end_effector", "gripper", "agent", "robot", "pusher")
POSITION, QUATERNION, YAW = ("x", "y", "z"), ("qw", "qx", "qy", "qz"), ("yaw", "theta", "angle")
_NAME = re.compile(rf"(?:(?P<thing>.*?)[._/ -])?(?P<part>{'|'.join(POSITION + QUATERNION + YAW + ('w',))})")
_ENDING = re.compile(r"[._/ -]?(?P<kind>pos|position|pose|quat|quaternion|rot|rotation|orientation)$")

Names = Mapping[str, Sequence[str]]
"""Feature name to the names of its dimensions."""


@dataclass(frozen=True)
class Pose:
    """Where a thing's pose stands in a feature.

    Attributes:
        key: The feature.
        parts: Name of a part to its dimension.
    """

    key: str
    parts: Mapping[str, int] = field(default_factory=dict)

    @property
    def has_position(self) -> bool:
        """Whether the thing is somewhere."""
        return "x" in self.parts and "y" in self.parts

    @property
    def is_spatial(self) -> bool:
        """Whether it has a height, too."""
        return "z" in self.parts

    @property
    def turns(self) -> bool:
        """Whether it has an orientation."""
        return "yaw" in self.parts or all(part in self.parts for part in QUATERNION)

    def position(self, values: Tensor) -> Tensor:
        """(..., 3) position of raw values (..., d) of the feature; z is 0 where there is none."""
        columns = [values[..., self.parts[part]] for part in POSITION if part in self.parts]
        columns += [torch.zeros_like(columns[0])] * (3 - len(columns))
        return torch.stack(columns, dim=-1)

    def rotation(self, values: Tensor) -> Tensor:
        """(..., 3, 3) rotation from the thing's frame to the world's; the identity without orientation."""
        if not self.turns:
            eye = torch.eye(3, dtype=values.dtype, device=values.device)
            return eye.expand(*values.shape[:-1], 3, 3)
        if "yaw" in self.parts:
            half = values[..., self.parts["yaw"]] / 2
            zero = torch.zeros_like(half)
            w, x, y, z = half.cos(), zero, zero, half.sin()
        else:
            quaternion = torch.stack([values[..., self.parts[part]] for part in QUATERNION], dim=-1)
            w, x, y, z = (quaternion / quaternion.norm(dim=-1, keepdim=True).clamp_min(1e-9)).unbind(-1)
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def into_frame(vectors: Tensor, rotation: Tensor) -> Tensor:
    """(..., 3) vectors of the world as seen in frames of (..., 3, 3) rotations."""
    return torch.einsum("...ji,...j->...i", rotation, vectors)


def out_of_frame(vectors: Tensor, rotation: Tensor) -> Tensor:
    """(..., 3) vectors of frames of (..., 3, 3) rotations as seen in the world."""
    return torch.einsum("...ij,...j->...i", rotation, vectors)


def find_poses(names: Names) -> dict[str, Pose]:
    """The things whose positions stand in features, by name, in order.

    Args:
        names: Of the features' dimensions.
    """
    found: dict[str, Pose] = {}
    for key, dimensions in names.items():
        parts: dict[str, dict[str, int]] = {}
        for place, name in enumerate(dimensions):
            thing, part = _parse(name)
            if part is not None:
                parts.setdefault(thing, {}).setdefault(part, place)
        for thing, own in parts.items():
            pose = Pose(key, own)
            if pose.has_position and thing not in found:
                found[thing] = pose
    return found


def _parse(name: str) -> tuple[str, str | None]:
    """Thing and part that a dimension's name says; no part where it says none."""
    match = _NAME.fullmatch(name)
    if match is None:
        return name, None
    thing, part = match["thing"] or "", match["part"]
    ending = _ENDING.search(thing)
    kind = None if ending is None else ending["kind"]
    thing = thing if ending is None else thing[: ending.start()]
    if kind in ("quat", "quaternion") and part in ("w", "x", "y", "z"):
        part = f"q{part}"
    return thing, "yaw" if part in YAW else part if part != "w" else None


def hand_of(poses: Mapping[str, Pose]) -> str:
    """Which of the things is the hand.

    Raises:
        ValueError: If none is.
    """
    for name in HANDS:
        if name in poses:
            return name
    raise ValueError(
        f"no hand among the observed things {sorted(poses)}: dimensions of its position are called x, y "
        f"(and z), or hand.x, ...; name them with policy.dimension_names"
    )


def object_of(poses: Mapping[str, Pose], name: str, key: str) -> Pose:
    """The pose of an object that an option names.

    Args:
        poses: What there is.
        name: The object.
        key: The option, for messages.

    Raises:
        ValueError: If there is no such object.
    """
    if name not in poses:
        known = ", ".join(thing for thing in poses if thing not in HANDS) or "none"
        raise ValueError(
            f"{key}={name!r}: no dimensions are called {name}.x, {name}.y, ...; objects found by their "
            f"names: {known}; name dimensions with policy.dimension_names={{feature: [names]}}"
        )
    return poses[name]
