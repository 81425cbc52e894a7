"""The arm's controller, once per millisecond: inverse kinematics, joint PD, finger forces; compiled.

It is the benchmark's controller (Jia et al., ICLR 2024; gains from its published configuration), rewritten
from its equations. The inverse kinematics integrates its own last result, open loop; the low PD gains let
the measured tool lag behind the desired one by about a centimetre, which is part of the task. A coarser
control period loses this behaviour and gains no speed: inverse kinematics costs less than a physics step.

All functions live in one module because numba's on-disk cache notices changes in the caller's file only.
"""

import math

import numpy as np

from lerobot_swr.envs.d3il.dependencies import numba

PERIOD_S = 0.001

_REST = np.array([0.0, 0.174, 0.0, -0.872, 0.0, 1.222, 0.785])
_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
_UPPER = np.array([2.8973, 1.7628, 2.0, -0.0698, 2.8973, 3.7525, 2.8973])
_STIFFNESS = np.array([120.0, 120.0, 120.0, 120.0, 50.0, 30.0, 10.0])
_DAMPING = np.array([10.0, 10.0, 10.0, 10.0, 6.0, 5.0, 3.0])

_IK_ITERATIONS = 3
_IK_GAIN = np.array([200.0, 200.0, 800.0, 30.0, 30.0, 30.0])
_MAX_POSITION_ERROR = 0.01
_MAX_ROTATION_ERROR = 0.1
_NULL_SPACE_GAIN = 40.0
_MAX_NULL_SPACE_ERROR = 0.2
_MAX_JOINT_SPEED = 3.0
_MIN_SINGULAR_VALUE = 1e-2
_MAX_SINGULAR_VALUE = 1e2

_FINGER_OPENING = 0.04
_FINGER_STIFFNESS = 500.0
_FINGER_DAMPING = 10.0
_FINGER_FORCE_LIMIT = 5.0

# Fixed part of each joint's transform: translation, then a turn about x by +90, 0 or -90 degrees.
_OFFSETS = np.array(
    [
        [0.0, 0.0, 0.333],
        [0.0, 0.0, 0.0],
        [0.0, -0.316, 0.0],
        [0.0825, 0.0, 0.0],
        [-0.0825, 0.384, 0.0],
        [0.0, 0.0, 0.0],
        [0.088, 0.0, 0.0],
    ]
)
_QUARTER_TURNS = np.array([0, -1, 1, 1, -1, 1, 1])
_FLANGE_TO_TOOL = 0.107 + 0.105
_HAND_ANGLE = -math.pi / 4

_compiled = numba.njit(cache=True, nogil=True)


@_compiled
def _rotate_about_z(rotation: np.ndarray, angle: float) -> None:
    """Right-multiply `rotation` (3, 3) by a turn about z, in place."""
    c, s = math.cos(angle), math.sin(angle)
    for row in range(3):
        x, y = rotation[row, 0], rotation[row, 1]
        rotation[row, 0] = c * x + s * y
        rotation[row, 1] = c * y - s * x


@_compiled
def tool_kinematics(
    joints: np.ndarray, position: np.ndarray, rotation: np.ndarray, jacobian: np.ndarray
) -> None:
    """Pose of the tool centre point and its Jacobian in world axes.

    Args:
        joints: (7,) joint angles in rad.
        position: (3,) output in m.
        rotation: (3, 3) output.
        jacobian: (6, 7) output, linear over angular velocity.
    """
    position[:] = 0.0
    rotation[:] = np.eye(3)
    for joint in range(7):
        for row in range(3):
            position[row] += (
                rotation[row, 0] * _OFFSETS[joint, 0]
                + rotation[row, 1] * _OFFSETS[joint, 1]
                + rotation[row, 2] * _OFFSETS[joint, 2]
            )
        turn = _QUARTER_TURNS[joint]
        if turn != 0:
            for row in range(3):
                y, z = rotation[row, 1], rotation[row, 2]
                rotation[row, 1] = turn * z
                rotation[row, 2] = -turn * y
        _rotate_about_z(rotation, joints[joint])
        for row in range(3):
            jacobian[row, joint] = position[row]  # the joint's origin, until the tool's position is known
            jacobian[3 + row, joint] = rotation[row, 2]
    for row in range(3):
        position[row] += rotation[row, 2] * _FLANGE_TO_TOOL
    _rotate_about_z(rotation, _HAND_ANGLE)
    for joint in range(7):
        ax, ay, az = jacobian[3, joint], jacobian[4, joint], jacobian[5, joint]
        rx = position[0] - jacobian[0, joint]
        ry = position[1] - jacobian[1, joint]
        rz = position[2] - jacobian[2, joint]
        jacobian[0, joint] = ay * rz - az * ry
        jacobian[1, joint] = az * rx - ax * rz
        jacobian[2, joint] = ax * ry - ay * rx


@_compiled
def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


@_compiled
def _task_velocity(
    desired: np.ndarray, position: np.ndarray, rotation: np.ndarray, target: np.ndarray
) -> None:
    """Write the wanted tool velocity (6,) towards `desired` (3,) with the hand pointing straight down."""
    for row in range(3):
        target[row] = _IK_GAIN[row] * _clip(desired[row] - position[row], _MAX_POSITION_ERROR)
    # Vector part of the quaternion of R_desired R^T with R_desired = diag(1, -1, -1), scalar part >= 0.
    scalar = 0.5 * math.sqrt(max(1.0 + rotation[0, 0] - rotation[1, 1] - rotation[2, 2], 1e-16))
    error_x = (rotation[2, 1] - rotation[1, 2]) / (4.0 * scalar)
    error_y = (rotation[2, 0] + rotation[0, 2]) / (4.0 * scalar)
    error_z = (-rotation[1, 0] - rotation[0, 1]) / (4.0 * scalar)
    target[3] = _IK_GAIN[3] * _clip(error_x, _MAX_ROTATION_ERROR)
    target[4] = _IK_GAIN[4] * _clip(error_y, _MAX_ROTATION_ERROR)
    target[5] = _IK_GAIN[5] * _clip(error_z, _MAX_ROTATION_ERROR)


@_compiled
def _cholesky_solve(
    matrix: np.ndarray, shift: float, lower: np.ndarray, vector: np.ndarray, solve: bool
) -> bool:
    """Factor `matrix` - `shift` I (6, 6) into `lower`; False if it is not positive definite.

    With `solve`, overwrite `vector` (6,) with the solution of the shifted system.
    """
    for i in range(6):
        for j in range(i + 1):
            total = matrix[i, j]
            if i == j:
                total -= shift
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if total <= 0.0:
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    if solve:
        for i in range(6):
            total = vector[i]
            for k in range(i):
                total -= lower[i, k] * vector[k]
            vector[i] = total / lower[i, i]
        for i in range(5, -1, -1):
            total = vector[i]
            for k in range(i + 1, 6):
                total -= lower[k, i] * vector[k]
            vector[i] = total / lower[i, i]
    return True


@_compiled
def _jacobi_solve(matrix: np.ndarray, vector: np.ndarray) -> None:
    """Overwrite `vector` (6,) with the solution of `matrix` (6, 6, symmetric), its eigenvalues clipped.

    Cyclic Jacobi rotations diagonalise `matrix` in place. (numba's `eigh` aborted the process here.)
    """
    vectors = np.eye(6)
    for _ in range(30):
        off_diagonal = 0.0
        for i in range(6):
            for j in range(i):
                off_diagonal += matrix[i, j] ** 2
        if off_diagonal < 1e-30:
            break
        for p in range(5):
            for q in range(p + 1, 6):
                if matrix[p, q] == 0.0:
                    continue
                theta = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                t = math.copysign(1.0, theta) / (abs(theta) + math.sqrt(theta * theta + 1.0))
                c = 1.0 / math.sqrt(t * t + 1.0)
                s = t * c
                for k in range(6):
                    kp, kq = matrix[k, p], matrix[k, q]
                    matrix[k, p] = c * kp - s * kq
                    matrix[k, q] = s * kp + c * kq
                for k in range(6):
                    pk, qk = matrix[p, k], matrix[q, k]
                    matrix[p, k] = c * pk - s * qk
                    matrix[q, k] = s * pk + c * qk
                for k in range(6):
                    kp, kq = vectors[k, p], vectors[k, q]
                    vectors[k, p] = c * kp - s * kq
                    vectors[k, q] = s * kp + c * kq
    solution = np.zeros(6)
    for i in range(6):
        eigenvalue = min(max(matrix[i, i], _MIN_SINGULAR_VALUE), _MAX_SINGULAR_VALUE)
        weight = 0.0
        for k in range(6):
            weight += vectors[k, i] * vector[k]
        for k in range(6):
            solution[k] += vectors[k, i] * weight / eigenvalue
    vector[:] = solution


@_compiled
def clipped_solve(matrix: np.ndarray, vector: np.ndarray) -> None:
    """Overwrite `vector` (6,) with V diag(1 / clip(s)) V^T vector, where V diag(s) V^T is `matrix`.

    Where no singular value is below the limit (a Cholesky factor of the matrix minus the limit exists, and
    its trace keeps it far from the upper limit), clipping changes nothing and a plain solve is the same and
    faster.
    """
    trace = 0.0
    for i in range(6):
        trace += matrix[i, i]
    lower = np.empty((6, 6))
    if trace < _MAX_SINGULAR_VALUE and _cholesky_solve(matrix, _MIN_SINGULAR_VALUE, lower, vector, False):
        _cholesky_solve(matrix, 0.0, lower, vector, True)
    else:
        _jacobi_solve(matrix, vector)


@_compiled
def _improve_joints(joints: np.ndarray, desired: np.ndarray) -> None:
    """Move `joints` (7,) towards the tool position `desired` (3,) by one damped step, in place."""
    position, rotation, jacobian = np.empty(3), np.empty((3, 3)), np.empty((6, 7))
    task, matrix, null_space = np.empty(6), np.empty((6, 6)), np.empty(7)
    tool_kinematics(joints, position, rotation, jacobian)
    _task_velocity(desired, position, rotation, task)
    for joint in range(7):
        null_space[joint] = _NULL_SPACE_GAIN * _clip(_REST[joint] - joints[joint], _MAX_NULL_SPACE_ERROR)
    for i in range(6):
        for joint in range(7):
            task[i] -= jacobian[i, joint] * null_space[joint]
        for j in range(i + 1):
            total = 0.0
            for joint in range(7):
                total += jacobian[i, joint] * jacobian[j, joint]
            matrix[i, j] = matrix[j, i] = total
        matrix[i, i] += 1e-12
    clipped_solve(matrix, task)
    squared_speed = 0.0
    for joint in range(7):
        for i in range(6):
            null_space[joint] += jacobian[i, joint] * task[i]
        squared_speed += null_space[joint] ** 2
    scale = PERIOD_S
    if squared_speed > _MAX_JOINT_SPEED**2:
        scale *= _MAX_JOINT_SPEED / math.sqrt(squared_speed)
    for joint in range(7):
        moved = joints[joint] + scale * null_space[joint]
        joints[joint] = min(max(moved, _LOWER[joint]), _UPPER[joint])


@_compiled
def control(
    desired: np.ndarray,
    planned_joints: np.ndarray,
    qpos: np.ndarray,
    qvel: np.ndarray,
    bias: np.ndarray,
    ctrl: np.ndarray,
) -> None:
    """One millisecond of control: read the state, write the motor torques and finger forces.

    Args:
        desired: (3,) desired tool position in m.
        planned_joints: (7,) result of the last inverse kinematics in rad, updated in place.
        qpos: (>= 9,) measured joint positions, arm then fingers.
        qvel: (>= 9,) measured joint velocities.
        bias: (>= 7,) gravity and Coriolis forces, as the last physics step left them; the arm's are
            compensated.
        ctrl: (9,) output in N m and N.
    """
    previous = planned_joints.copy()
    for _ in range(_IK_ITERATIONS):
        _improve_joints(planned_joints, desired)
    for joint in range(7):
        planned_velocity = (planned_joints[joint] - previous[joint]) / PERIOD_S
        ctrl[joint] = (
            _STIFFNESS[joint] * (planned_joints[joint] - qpos[joint])
            + _DAMPING[joint] * (planned_velocity - qvel[joint])
            + bias[joint]
        )
    middle = 0.5 * (qpos[7] + qpos[8])
    for finger in (7, 8):
        opening = _FINGER_STIFFNESS * (_FINGER_OPENING - qpos[finger]) - _FINGER_DAMPING * qvel[finger]
        ctrl[finger] = _FINGER_STIFFNESS * (middle - qpos[finger]) + _clip(opening, _FINGER_FORCE_LIMIT)
