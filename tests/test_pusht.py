"""PushT: the block's geometry against gym-pusht's own, the behaviour rule, the recordings."""

import os
from collections import Counter
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lerobot.datasets import LeRobotDatasetMetadata
from scipy.spatial.transform import Rotation

from lerobot_swr.envs.pusht.block import (
    GOAL_POSE,
    KEYPOINTS,
    SIDES,
    block_pose,
    keypoints_of,
    nearest_side,
    reset_state,
)
from lerobot_swr.evaluation.checkpoint import load_demonstrations

pytest.importorskip("gym_pusht", reason="absent: pip install 'lerobot_policy_swr[pusht]'")

from lerobot_swr.envs.pusht.behavior import NO_PUSH, UNFINISHED, first_push, goal_coverage

STATE, SCENE = "observation.state", "observation.environment_state"
REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", Path(__file__).parents[2] / "shared"))
RECORDINGS = REFERENCE / "human_demos" / "pusht_human"

poses = st.tuples(st.floats(100, 400), st.floats(100, 400), st.floats(-3.1, 3.1)).map(np.array)

# Where an agent of radius 15 touches each side, in the block's frame, and which way it pushes.
CONTACTS = {
    "top": ((20, -15), (0, 1)),
    "right_end": ((75, 15), (-1, 0)),
    "right": ((30, 80), (-1, 0)),
    "bottom": ((0, 135), (0, -1)),
    "left": ((-30, 80), (1, 0)),
    "left_end": ((-75, 15), (1, 0)),
}
OPPOSITE = {"right": "left", "left": "right", "right_end": "left_end", "left_end": "right_end"}


@pytest.fixture
def env():
    """gym-pusht's environment itself."""
    env = gym.make("gym_pusht/PushT-v0", obs_type="environment_state_agent_pos")
    yield env.unwrapped
    env.close()


def episode(agent, pose):
    """What a dataset or a rollout holds of agent positions (T, 2) and block poses (T, 3)."""
    scene = keypoints_of(np.asarray(pose, float)).reshape(len(pose), 16)
    return {STATE: np.asarray(agent, np.float32), SCENE: scene.astype(np.float32)}


def in_field(points, pose):
    """Points (..., 2) of the block's frame in the field."""
    return pose[:2] + np.asarray(points) @ Rotation.from_euler("z", pose[2]).as_matrix()[:2, :2].T


def pushed_home(side, step=4.0, n_steps=25):
    """A block that a push from `side` brings straight to the goal, and the agent that does it."""
    contact, direction = CONTACTS[side]
    way = in_field(direction, [0, 0, GOAL_POSE[2]])
    left = step * np.arange(n_steps, -1, -1)  # pixels that are left to the goal
    pose = np.stack([GOAL_POSE - [*(pixels * way), 0] for pixels in left])
    return episode([in_field(contact, p) for p in pose], pose)


def joined(*episodes):
    """Episodes one after the other."""
    return {key: np.concatenate([e[key] for e in episodes]) for key in (STATE, SCENE)}


def shifted_agent(example, shift):
    """The first state of an example twice 50 times, the agent moved by up to `shift` and back."""
    shares = np.sin(np.linspace(0, np.pi, 50))[:, None]
    agent = example[STATE][0] + shares * np.asarray(shift)
    return {STATE: agent.astype(np.float32), SCENE: np.repeat(example[SCENE][:1], 50, axis=0)}


# --- Geometry ---


@given(poses)
def test_a_pose_is_found_again_from_its_keypoints(pose):
    """The round trip, in the keypoints' own precision."""
    np.testing.assert_allclose(block_pose(keypoints_of(pose)), pose, atol=1e-9)


@given(poses, st.integers(0, 2**32 - 1))
def test_the_fit_to_noisy_keypoints_is_scipys(pose, seed):
    """Kabsch's algorithm in three dimensions gives the same angle and centre."""
    seen = keypoints_of(pose) + np.random.default_rng(seed).normal(0, 2, (8, 2))
    flat, own = (np.pad(p - p.mean(axis=0), ((0, 0), (0, 1))) for p in (seen, KEYPOINTS))
    turn = Rotation.align_vectors(flat, own)[0]
    fitted = block_pose(seen)
    assert np.cos(turn.as_euler("xyz")[2] - fitted[2]) == pytest.approx(1)
    np.testing.assert_allclose(keypoints_of(fitted).mean(axis=0), seen.mean(axis=0), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_poses_and_keypoints_are_gym_pushts(env, seed):
    """Its keypoints give the pose that its info names, and that pose gives its keypoints."""
    observation, info = env.reset(seed=seed)
    keypoints = observation["environment_state"].reshape(8, 2)
    pose = info["block_pose"]
    np.testing.assert_allclose(keypoints_of(pose), keypoints, atol=1e-6)
    np.testing.assert_allclose(block_pose(keypoints)[:2], pose[:2], atol=1e-6)
    assert np.cos(block_pose(keypoints)[2] - pose[2]) == pytest.approx(1)


@pytest.mark.parametrize("offset", [(0, 0, 0), (10, -5, 0.1), (-30, 20, -0.8), (200, 0, 0)])
def test_the_coverage_is_gym_pushts(env, offset):
    """The share of the goal that the block covers, at the goal, near it and beside it."""
    env.reset(seed=0)
    pose = GOAL_POSE + offset
    env.block.angle, env.block.position = float(pose[2]), tuple(map(float, pose[:2]))
    expected = env._get_coverage()
    assert goal_coverage(episode([(0, 0)], [pose]))[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_reset_puts_agent_and_block_where_they_were(env, seed):
    """To a thousandth of a pixel, where nothing touches."""
    seen, _ = env.reset(seed=seed)
    keypoints = seen["environment_state"].reshape(8, 2)
    state = reset_state(np.array([20.0, 30.0]), keypoints)
    again, _ = env.reset(options={"reset_to_state": state})
    np.testing.assert_allclose(again["environment_state"], seen["environment_state"], atol=1e-3)
    np.testing.assert_allclose(again["agent_pos"], [20, 30])


@given(poses)
def test_the_nearest_side_is_the_one_that_is_touched(pose):
    """Wherever the block lies."""
    touching = np.stack([in_field(contact, pose) for contact, _ in CONTACTS.values()])
    keypoints = np.repeat(keypoints_of(pose)[None], len(CONTACTS), axis=0)
    assert [SIDES[k] for k in nearest_side(touching, keypoints)] == list(CONTACTS)


# --- The rule ---


@pytest.mark.parametrize("side", SIDES)
def test_a_push_is_named_after_its_side(side):
    """A block that one push brings home."""
    assert first_push(pushed_home(side)) == side


@settings(max_examples=30)
@given(st.sampled_from(SIDES), st.tuples(st.floats(-80, 80), st.floats(-80, 80)), st.integers(1, 9))
def test_the_label_does_not_depend_on_time(side, shift, pause):
    """Walking about beforehand, pausing, and moving twice as fast change nothing."""
    example = pushed_home(side)
    early = joined(shifted_agent(example, shift), example)
    paused = {key: np.repeat(value, pause, axis=0) for key, value in example.items()}
    assert first_push(early) == first_push(paused) == first_push(pushed_home(side, 8.0, 12)) == side


@given(st.sampled_from(SIDES), st.integers(0, 2**32 - 1))
def test_the_label_survives_small_noise(side, seed):
    """Half a pixel on the agent, a tenth on the keypoints."""
    rng = np.random.default_rng(seed)
    example = pushed_home(side)
    noisy = {
        STATE: example[STATE] + rng.normal(0, 0.5, example[STATE].shape),
        SCENE: example[SCENE] + rng.normal(0, 0.1, example[SCENE].shape),
    }
    assert first_push(noisy) == side


@pytest.mark.parametrize("side", SIDES)
def test_the_mirror_image_swaps_left_and_right(side):
    """Mirrored in the goal's own axis, in which top and bottom stay."""
    example = pushed_home(side)
    back = Rotation.from_euler("z", GOAL_POSE[2]).as_matrix()[:2, :2]

    def mirrored(points):
        return ((points - GOAL_POSE[:2]) @ back * [-1, 1]) @ back.T + GOAL_POSE[:2]

    keypoints = mirrored(example[SCENE].reshape(-1, 8, 2))[:, [1, 0, 3, 2, 5, 4, 7, 6]]
    image = {STATE: mirrored(example[STATE]), SCENE: keypoints.reshape(-1, 16)}
    assert first_push(image) == OPPOSITE.get(side, side)


def test_the_first_of_several_pushes_counts_unless_it_is_a_touch():
    """A push of 100 pixels from one side before another one; 8 pixels are none."""
    home = pushed_home("top")
    away = {key: value[::-1] for key, value in pushed_home("top").items()}
    contact = np.array(CONTACTS["bottom"][0])
    away[STATE] = np.stack([in_field(contact, block_pose(k.reshape(8, 2))) for k in away[SCENE]])
    away = {key: value[1:] for key, value in away.items()}  # the goal itself would end it
    outside = {key: value[8:] for key, value in away.items()}  # where it covers less than is asked for
    assert first_push(joined(outside, home)) == "bottom"
    assert first_push(joined({key: value[-3:] for key, value in away.items()}, home)) == "top"


def test_what_never_comes_near_the_goal_is_unfinished():
    """Whatever was pushed; a block that lies there from the start was not pushed."""
    assert first_push({key: value[:10] for key, value in pushed_home("top").items()}) == UNFINISHED
    assert first_push(episode([(20, 20)] * 4, [GOAL_POSE] * 4)) == NO_PUSH


def test_what_comes_after_the_goal_is_ignored():
    """A rollout that goes on where a recording ends has the recording's label."""
    example = pushed_home("left")
    assert first_push(joined(example, pushed_home("right"))) == "left"


# --- The recordings ---


@pytest.mark.skipif(
    not (RECORDINGS / "meta" / "info.json").is_file(),
    reason=f"{RECORDINGS} is absent: point LEROBOT_SWR_REFERENCE at the folder that holds human_demos",
)
def test_the_recordings_have_these_behaviours():
    """The table in docs/pusht.md; all come near the goal, none to the environment's own success."""
    meta = LeRobotDatasetMetadata("local/pusht_human", root=RECORDINGS)
    episodes = list(load_demonstrations(meta).episodes())
    shown = Counter(first_push(e) for e in episodes)
    assert shown == {"top": 57, "right": 56, "left": 47, "left_end": 20, "bottom": 13, "right_end": 13}
    best = [goal_coverage(e).max() for e in episodes]
    assert min(best) > 0.77
    assert max(best) < 0.91
