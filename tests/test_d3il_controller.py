"""The compiled controller's parts against independent calculations."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_swr.envs.d3il.arm import TOOL_SITE
from lerobot_swr.envs.d3il.avoiding import avoiding_model
from lerobot_swr.envs.d3il.controller import clipped_solve, tool_kinematics

JOINT_LOW = np.array([-2.8, -1.7, -2.8, -3.0, -2.8, 0.0, -2.8])
JOINT_HIGH = np.array([2.8, 1.7, 2.0, -0.1, 2.8, 3.7, 2.8])


def kinematics(joints):
    """Position, rotation and Jacobian of the tool."""
    position, rotation, jacobian = np.empty(3), np.empty((3, 3)), np.empty((6, 7))
    tool_kinematics(joints, position, rotation, jacobian)
    return position, rotation, jacobian


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_kinematics_equal_mujocos(seed):
    """Pose and Jacobian of the tool equal MuJoCo's forward kinematics of the same joints."""
    joints = np.random.default_rng(seed).uniform(JOINT_LOW, JOINT_HIGH)
    model = avoiding_model()
    data = mujoco.MjData(model)
    data.qpos[:7] = joints
    mujoco.mj_forward(model, data)
    linear, angular = np.empty((3, model.nv)), np.empty((3, model.nv))
    mujoco.mj_jacSite(model, data, linear, angular, model.site(TOOL_SITE).id)

    position, rotation, jacobian = kinematics(joints)

    # The model's hand frame carries the benchmark's rounded quaternion, hence 1e-5 for the rotation.
    np.testing.assert_allclose(position, data.site(TOOL_SITE).xpos, atol=1e-9)
    np.testing.assert_allclose(rotation, data.site(TOOL_SITE).xmat.reshape(3, 3), atol=1e-5)
    np.testing.assert_allclose(jacobian, np.concatenate([linear, angular])[:, :7], atol=1e-9)


@settings(max_examples=100)
@given(st.integers(0, 2**32 - 1), st.floats(-8, 1))
def test_clipped_solve_equals_singular_values(seed, smallest_exponent):
    """The solver equals V diag(1 / clip(s, 0.01, 100)) U^T b from numpy's SVD, whether or not it clips."""
    rng = np.random.default_rng(seed)
    vectors, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    values = 10 ** rng.uniform(smallest_exponent, 1.2, size=6)
    matrix = (vectors * values) @ vectors.T
    matrix = (matrix + matrix.T) / 2
    vector = rng.normal(size=6)
    u, s, vt = np.linalg.svd(matrix)
    expected = vt.T @ ((u.T @ vector) / np.clip(s, 1e-2, 1e2))

    solution = vector.copy()
    clipped_solve(matrix.copy(), solution)

    np.testing.assert_allclose(solution, expected, atol=1e-9 * np.abs(expected).max())


def test_arm_mass():
    """The modelled arm weighs the sum of the published masses."""
    model = avoiding_model()
    assert model.body_mass.sum() == pytest.approx(18.8238743698, abs=1e-9)
