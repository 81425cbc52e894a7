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
_SAME_PLACE = 6  # decimals of a metre that have to agree; recordings have float32's


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
        """Move from rest in the start pose to where a recording begins.

        It begins there, or one control period after the first move, or at rest elsewhere (whoever let the arm
        move before recording waited for it): wherever the tool is nearest to the actual position.

        Args:
            desired: (3,) position to hold.
            actual: (n,) first coordinates of the tool's position.
        """
        trial = ArmSimulation(self.model, copy.copy(self.data))
        trial._planned_joints[:] = self._planned_joints
        trial.advance(desired)
        places = np.stack([self.tool_position, trial.tool_position, desired])
        distances = np.linalg.norm(places[:, : len(actual)] - actual, axis=1)
        nearest = distances.round(_SAME_PLACE).argmin()  # of equal ones the first
        stays = not (desired - self.tool_position).round(_SAME_PLACE).any()
        for _ in range((0 if stays else 1, 1, SETTLING_STEPS)[nearest]):
            self.advance(desired)

    @property
    def tool_position(self) -> np.ndarray:
        """(3,) tool position in m, as the forward kinematics of the last physics step left it."""
        return self._tool.copy()

    @property
    def arm_joints(self) -> np.ndarray:
        """(7,) measured joint angles in rad."""
        return self._qpos[:N_ARM_JOINTS].copy()
