"""A pointer for the arm: the tool follows the ray under it, at the tool's height."""

from collections.abc import Mapping

import numpy as np
from lerobot.utils.constants import OBS_STATE

from lerobot_swr.envs.d3il.layouts import AVOIDING_START_TOOL
from lerobot_swr.envs.pointer import Command, Pointer

SPEED_M = 0.009
"""How far the desired tool moves in one step at most: as demonstrators moved it."""

REACH_M = ((0.25, 0.75), (-0.45, 0.45), (0.115, 0.35))
"""Where the desired tool stays, in x, y and z: the arm can follow, and does not push through the table."""


class CameraPointer(Pointer):
    """Seen from a camera that looks down on the table.

    Args:
        position: (3,) of the camera, in metres.
        axes: (3, 3) its directions to the right, up and backwards, by column.
        fovy_rad: Its vertical field of view.
        aspect: The picture's width by its height.
        n_axes: Coordinates of the tool that actions change, 2 or 3.
    """

    def __init__(self, position: np.ndarray, axes: np.ndarray, fovy_rad: float, aspect: float, n_axes: int):
        self._position, self._axes = np.array(position), np.array(axes).reshape(3, 3)
        self._half = np.tan(fovy_rad / 2) * np.array([aspect, 1.0])  # of the picture, at distance 1
        self._n_axes = n_axes

    def action(self, observations: Mapping[str, np.ndarray], command: Command) -> np.ndarray:
        """See `Pointer.action`: the change of the desired tool position."""
        desired = observations[OBS_STATE][: self._n_axes].astype(np.float64)
        height = desired[2] if self._n_axes == 3 else AVOIDING_START_TOOL[2]
        step = np.zeros(self._n_axes)
        if command.place is not None:
            step[:2] = self._under(command.place, height) - desired[:2]
        right, up, towards = command.push
        # The camera stands behind the table's far edge: the robot's y points right and its x at the viewer.
        step[:2] += np.array([-up, right]) * SPEED_M
        step[2:] = towards * SPEED_M
        step *= min(1.0, SPEED_M / max(float(np.linalg.norm(step)), 1e-12))
        low, high = np.array(REACH_M[: self._n_axes]).T
        # Towards the reach from outside of it, never further out.
        return (
            np.clip(desired + step, np.minimum(low, desired), np.maximum(high, desired)) - desired
        ).astype(np.float32)

    def project(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """See `Pointer.project`: of the actual tool."""
        state = observations[OBS_STATE].astype(np.float64)
        tool = state[:, self._n_axes : 2 * self._n_axes]
        if self._n_axes == 2:
            tool = np.column_stack([tool, np.full(len(tool), AVOIDING_START_TOOL[2])])
        seen = (tool - self._position) @ self._axes  # right, up, backwards
        flat = seen[:, :2] / -seen[:, 2:] / self._half  # -1 to 1
        return np.stack([(1 + flat[:, 0]) / 2, (1 - flat[:, 1]) / 2], axis=1)

    def _under(self, place: tuple[float, float], height: float) -> np.ndarray:
        """(2,) where the ray through a place of the picture is at a height above the table's frame."""
        flat = np.array([2 * place[0] - 1, 1 - 2 * place[1]]) * self._half
        ray = self._axes @ np.array([*flat, -1.0])
        if ray[2] > -1e-3:  # not downwards: above the horizon
            ray[2] = -1e-3
        return (self._position + ray * (height - self._position[2]) / ray[2])[:2]
