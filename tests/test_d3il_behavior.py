"""The D3IL behaviour rules, against the benchmark's rules written down independently."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_swr.envs.d3il.behavior import (
    AVOIDING_BEHAVIORS,
    Gaps,
    aligning_behavior,
    avoiding_behavior,
    gaps_after,
    gaps_of_behavior,
    is_aligned,
    mode_bits,
    rotation_distance,
)
from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.d3il.layouts import FINISH_LINE_Y


def benchmark_bits(path):
    """The nine bits, as the paper's environment defines them (numbers from Jia et al., ICLR 2024)."""
    bits, done = np.zeros(9), [False, False, False]
    for x, y in path:
        if not done[0] and abs(y + 0.1) <= 0.03:
            done[0] = True
            bits[0 if x < 0.5 else 1] = 1
        if not done[1] and abs(y - 0.08) <= 0.03:
            done[1] = True
            bits[2 if x < 0.425 else 3 if x < 0.575 else 4] = 1
        if not done[2] and y >= 0.26:
            done[2] = True
            bits[5 if x < 0.35 else 6 if x < 0.5 else 7 if x < 0.65 else 8] = 1
    return bits


@given(st.integers(0, 2**32 - 1))
def test_mode_bits_equal_the_benchmarks(seed):
    """On random walks towards the finish line, the bits equal the benchmark's."""
    rng = np.random.default_rng(seed)
    path = np.cumsum(rng.normal([0.0, 0.008], [0.02, 0.01], size=(90, 2)), axis=0)
    path += [0.525, -0.28]
    gaps: Gaps = (None, None, None)
    for point in path:
        gaps = gaps_after(gaps, point)
    np.testing.assert_array_equal(mode_bits(gaps), benchmark_bits(path))


def test_there_are_24_behaviors():
    """Labels and gaps determine each other."""
    assert len(set(AVOIDING_BEHAVIORS)) == 24
    assert {gaps_of_behavior(b) for b in AVOIDING_BEHAVIORS} == {
        (i, j, k) for i in range(2) for j in range(3) for k in range(4)
    }


def avoiding(path):
    """Label of a path of the actual position; the desired one is elsewhere."""
    path = np.array(path, dtype=np.float32)
    return avoiding_behavior({"observation.state": np.concatenate([path + 9, path], axis=1)})


def test_avoiding_failures_have_their_own_labels():
    """Ending at an obstacle is a collision, any other episode that does not cross the line is unfinished."""
    assert avoiding([(0.52, -0.28), (0.51, -0.14)]) == "collision"
    assert avoiding([(0.52, -0.28), (0.6, -0.1), (0.6, 0.0)]) == "unfinished"


def test_avoiding_reads_the_actual_position():
    """The desired position, which runs ahead, is not what counts."""
    assert avoiding([(0.6, -0.1), (0.5, 0.08), (0.4, 0.27), (0.4, 0.36)]) == "bottom-mid-midtop"
    assert avoiding([(0.4, -0.1), (0.3, 0.08), (0.8, 0.27), (0.8, 0.35 + 1e-5)]) == "top-top-bottom"


def pose(x, y, angle, z=0.0):
    """Position and quaternion of a turn about the vertical."""
    return [x, y, z, math.cos(angle / 2), 0, 0, math.sin(angle / 2)]


def aligning(boxes, tools, target):
    """Label of an episode of box poses and tool positions."""
    scene = np.array([[*box, *target] for box in boxes], dtype=np.float32)
    state = np.array([[0, 0, 0, *tool] for tool in tools], dtype=np.float32)
    return aligning_behavior({"observation.state": state, "observation.environment_state": scene})


@pytest.mark.parametrize(
    ("offset", "angle", "aligned"),
    [(0.0154, 0.0, True), (0.0156, 0.0, False), (0.0, 8.6, True), (0.0, 8.7, False), (0.0, 180.0, False)],
)
def test_alignment_tolerances(offset, angle, aligned):
    """A resting box (9.2 mm below the target) may be 15.5 mm and 8.64 degrees off."""
    scene = np.array([*pose(0.5 + offset, 0.3, math.radians(angle), z=-0.0092), *pose(0.5, 0.3, 0.0)])
    assert bool(is_aligned(scene)) == aligned


def test_aligning_labels():
    """Inside and outside are told apart by 51 mm between tool and box; a box off its target is a failure."""
    target, there, away = pose(0.5, 0.3, 0.1), pose(0.505, 0.3, 0.1), pose(0.5, 0.1, 0.1)
    assert aligning([away, there], [(0.5, 0.1, 0.1), (0.545, 0.3, 0.1)], target) == "inside"
    assert aligning([away, there], [(0.5, 0.1, 0.1), (0.565, 0.3, 0.1)], target) == "outside"
    assert aligning([away, away], [(0.5, 0.1, 0.1), (0.5, 0.1, 0.1)], target) == "not_aligned"


def test_rotation_distance_of_equal_rotations_is_zero():
    """Rounding beyond 1 gives 0 rather than NaN, and q equals -q."""
    q = np.array([0.6, 0.0, 0.0, 0.8]) * (1 + 1e-7)
    assert rotation_distance(q, q) == 0.0
    assert rotation_distance(q, -q) == 0.0


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_rotation_distance_is_the_angle_between(first, second):
    """For turns about one axis it is the difference of the angles, the short way round."""
    a, b = (np.array([math.cos(t / 2), 0, 0, math.sin(t / 2)]) for t in (first, second))
    difference = abs((first - second + math.pi) % (2 * math.pi) - math.pi)
    assert rotation_distance(a, b) == pytest.approx(difference, abs=1e-6)


def test_a_demonstration_ends_where_the_environment_would():
    """Recordings that run on behind the finish line, or with the box in place, are not longer for that."""
    path = np.zeros((8, 4), np.float32)
    path[:, 3] = [-0.28, 0.0, 0.2, FINISH_LINE_Y, 0.36, 0.3, 0.37, 0.4]
    avoiding = D3ILEnvConfig(task="avoiding")
    assert avoiding.steps_to_end({"observation.state": path}) == 4
    assert avoiding.steps_to_end({"observation.state": path[:4]}) == 4
    scene = np.zeros((5, 14), np.float32)
    scene[:, [3, 10]] = 1  # unturned
    scene[:, 0] = [0.3, 0.1, 0.01, 0.1, 0.0]
    assert D3ILEnvConfig(task="aligning").steps_to_end({"observation.environment_state": scene}) == 2
