"""The simulated arm in one scene: reset it, then move its set-point 35 ms at a time."""

import copy

import numpy as np

from lerobot_swr.envs.d3il.arm import N_ARM_JOINTS, TOOL_SITE
from lerobot_swr.envs.d3il.controller import PERIOD_S, control
from lerobot_swr.envs.d3il.dependencies import mujoco
from lerobot_swr.envs.d3il.layouts import CONTROL_PERIOD_S

SUBSTEPS = round(CONTROL_PERIOD_S / PERIOD_S)

_FINGER_FORCE_AT_RESET = 0.9572
"""Newton; fitted to the motor forces of the reference traces, which it reproduces to 5e-7 N."""

SETTLING_STEPS = 80
"""Control periods in which the arm moves to another place and comes to rest there."""
_PATIENCE = 10  # control periods without coming nearer, after which the tool has passed a place
_SAME_PLACE = 1e-6  # metres


class ArmSimulation:
    """Physics state of one scene, whose arm tracks a desired tool position with the 1 kHz controller.

    Args:
        model: A compiled scene; it is only read, so that any number of simulations can share it.
        data: The state to go on from; None begins with the model's own.
    """

    def __init__(self, model: "mujoco.MjModel", data: "mujoco.MjData | None" = None):
        self.model = model
        self.data = mujoco.MjData(model) if data is None else data
        # Views stay valid for the life of `data`; looking them up costs more than the control law.
        self._qpos, self._qvel = self.data.qpos, self.data.qvel
        self._bias, self._ctrl = self.data.qfrc_bias, self.data.ctrl
        self._tool = self.data.site(TOOL_SITE).xpos
        self._planned_joints = np.zeros(N_ARM_JOINTS)

    def reset(self, qpos: np.ndarray, marker: np.ndarray | None = None) -> None:
        """Start at rest, then let one millisecond pass under gravity compensation alone.

        Args:
            qpos: (n_q,) joint positions.
            marker: (7,) pose of the scene's mocap body, if it has one: position and quaternion.
        """
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[:] = qpos
        if marker is not None:
            self.data.mocap_pos[0], self.data.mocap_quat[0] = marker[:3], marker[3:]
        mujoco.mj_forward(self.model, self.data)
        self._ctrl[:N_ARM_JOINTS] = self._bias[:N_ARM_JOINTS]
        self._ctrl[N_ARM_JOINTS:] = _FINGER_FORCE_AT_RESET
        mujoco.mj_step(self.model, self.data)
        self._planned_joints[:] = self._qpos[:N_ARM_JOINTS]

    def advance(self, desired: np.ndarray) -> None:
        """Hold the desired tool position (3,) for one control period of 35 ms."""
        model, data = self.model, self.data
        for _ in range(SUBSTEPS):
            control(desired, self._planned_joints, self._qpos, self._qvel, self._bias, self._ctrl)
            mujoco.mj_step(model, data)

    def approach(self, desired: np.ndarray, actual: np.ndarray) -> None:
        """Move from rest towards a desired tool position, until the tool comes nearest to an actual one.

        A recording may begin at rest in the arm's start pose, some control periods after it, or at rest
        elsewhere; the actual position tells which.

        Args:
            desired: (3,) position to hold.
            actual: (n,) first coordinates of the position to come near to.
        """
        for _ in range(self._periods_until_near(desired, actual)):
            self.advance(desired)

    def _periods_until_near(self, desired: np.ndarray, actual: np.ndarray) -> int:
        """Control periods after which `approach` ends, found out on a copy."""
        trial = ArmSimulation(self.model, copy.copy(self.data))
        trial._planned_joints[:] = self._planned_joints

        def distance_to(place: np.ndarray) -> float:
            return float(np.linalg.norm(trial.tool_position[: len(actual)] - place[: len(actual)]))

        # Before anything moves the tool is only where the recording begins if nothing is to move.
        best, nearest = 0, distance_to(actual) if distance_to(desired) < _SAME_PLACE else np.inf
        for period in range(1, SETTLING_STEPS + 1):
            if nearest < _SAME_PLACE or period > best + _PATIENCE:
                break
            trial.advance(desired)
            if distance_to(actual) < nearest:
                best, nearest = period, distance_to(actual)
        return best

    @property
    def tool_position(self) -> np.ndarray:
        """(3,) tool position in m, as the forward kinematics of the last physics step left it."""
        return self._tool.copy()

    @property
    def arm_joints(self) -> np.ndarray:
        """(7,) measured joint angles in rad."""
        return self._qpos[:N_ARM_JOINTS].copy()
