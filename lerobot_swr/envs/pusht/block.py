"""PushT's block, a T, as observations show it: eight keypoints, in pixels (of 512 × 512, y downwards).

The keypoints are the corners of two rectangles, bar (0 to 3) and stem (4 to 7), numbered as in gym-pusht::

    0───────────1
    │           │
    3───4───5───2
        │   │
        7───6

"left" and "right" are those of this drawing, in which the letter stands upright.
"""

import numpy as np

KEYPOINTS = np.array(
    [(-60, 0), (60, 0), (60, 30), (-60, 30), (-15, 30), (15, 30), (15, 120), (-15, 120)], dtype=np.float64
)
"""(8, 2) keypoints in the block's own frame."""

GOAL_POSE = np.array([256.0, 256.0, np.pi / 4])
"""x, y, angle in rad of the block at the goal."""

SIDES = ("top", "right_end", "right", "bottom", "left", "left_end")
"""The block's sides. ``right`` and ``left`` are the stem's, with the bar's underside beside it: an agent that
pushes into this corner touches both. The ``ends`` are the bar's."""

OUTLINE = (0, 1, 2, 5, 6, 7, 4, 3)
"""The keypoints in the order of the block's outline; edge k leads from the k-th of them to the next."""

_SIDE_OF_EDGE = np.array([0, 1, 2, 2, 3, 4, 4, 5])

CENTRE_OF_GRAVITY = np.array([0.0, 45.0])
"""In the block's own frame."""


def keypoints_of(pose: np.ndarray) -> np.ndarray:
    """Keypoints (..., 8, 2) of a block at x, y, angle (..., 3)."""
    position, angle = pose[..., None, :2], pose[..., 2, None]
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = KEYPOINTS.T
    return position + np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def block_pose(keypoints: np.ndarray) -> np.ndarray:
    """The pose that fits keypoints best, in the sense of least squares.

    In the plane the Procrustes problem has a closed form: the angle is that of Σ conj(own) · seen over the
    centred keypoints as complex numbers.

    Args:
        keypoints: (..., 8, 2).

    Returns:
        (..., 3): x, y, angle in rad, in (-π, π].
    """
    keypoints = np.asarray(keypoints, np.float64)
    centre, own_centre = keypoints.mean(axis=-2), KEYPOINTS.mean(axis=0)
    seen = (keypoints - centre[..., None, :]) @ [1, 1j]  # (..., 8)
    angle = np.angle(seen @ np.conj((KEYPOINTS - own_centre) @ [1, 1j]))
    turned = np.exp(1j * angle) * (own_centre @ [1, 1j])
    return np.stack([centre[..., 0] - turned.real, centre[..., 1] - turned.imag, angle], axis=-1)


def reset_state(agent: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """The "reset_to_state" that puts gym-pusht's agent and block where they were.

    gym-pusht places the block unturned, then turns it about its centre of gravity, which moves the point
    whose place was given (it keeps that for the sake of older results). Here this is undone.

    Args:
        agent: (2,) position.
        keypoints: (8, 2) of the block.

    Returns:
        (5,): agent x, y; block x, y, angle.
    """
    x, y, angle = block_pose(keypoints)
    cos, sin = np.cos(angle), np.sin(angle)
    shift = np.array([[cos, -sin], [sin, cos]]) @ CENTRE_OF_GRAVITY - CENTRE_OF_GRAVITY
    return np.array([*np.asarray(agent, np.float64), x + shift[0], y + shift[1], angle])


def nearest_side(agent: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """The side of the block that is nearest to the agent.

    Args:
        agent: (T, 2) positions.
        keypoints: (T, 8, 2).

    Returns:
        (T,) int, its place in `SIDES`.
    """
    corners = np.asarray(keypoints, np.float64)[:, OUTLINE]  # (T, 8, 2)
    edges = np.roll(corners, -1, axis=1) - corners
    offsets = np.asarray(agent, np.float64)[:, None] - corners
    along = np.clip((offsets * edges).sum(axis=2) / (edges**2).sum(axis=2), 0.0, 1.0)  # (T, 8), of the edge
    distances = np.linalg.norm(offsets - along[..., None] * edges, axis=2)
    return _SIDE_OF_EDGE[distances.argmin(axis=1)]
