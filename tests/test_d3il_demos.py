"""The scripted D3IL demonstrators: every recording is a real success with the intended behaviour."""

import math
import os
import signal
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from held_command import held_command
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_swr.demos import d3il_aligning, d3il_avoiding
from lerobot_swr.demos.box_steering import (
    INSIDE_CORNER,
    OUTSIDE_FACE,
    Gains,
    PlanePose,
    direction,
    from_frame,
    pivot_curvature,
    rod_directions,
    to_frame,
    wrap,
)
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.d3il_aligning import AligningJob
from lerobot_swr.demos.d3il_avoiding import AvoidingJob
from lerobot_swr.demos.parallel_generation import generate, load_episode, save_episode
from lerobot_swr.demos.recipe import Demonstration
from lerobot_swr.envs.d3il.aligning import AligningEnv
from lerobot_swr.envs.d3il.avoiding import AvoidingEnv
from lerobot_swr.envs.d3il.behavior import (
    AVOIDING_BEHAVIORS,
    aligning_behavior,
    avoiding_behavior,
    is_aligned,
)
from lerobot_swr.envs.d3il.layouts import ACTION_LIMIT_M, FINISH_LINE_Y


def test_recipes_hold_what_they_promise():
    """Sizes and histograms of the four datasets."""
    assert get_recipe("d3il_avoiding").n_episodes == 96
    assert get_recipe("d3il_unbalanced_avoiding").n_episodes == 96
    assert get_recipe("d3il_aligning").n_episodes == 1000
    assert get_recipe("d3il_unbalanced_aligning").n_episodes == 1000
    assert set(d3il_avoiding.BALANCED.values()) == {4}
    assert set(d3il_avoiding.UNBALANCED) == set(AVOIDING_BEHAVIORS)
    assert len(set(d3il_avoiding.UNBALANCED.values())) > 5
    assert d3il_aligning.BALANCED == {"inside": 500, "outside": 500}


@pytest.mark.parametrize("behavior", AVOIDING_BEHAVIORS[::5])
def test_avoiding_demonstrations(behavior):
    """The recorded states follow from the recorded actions, and only the last is beyond the finish line."""
    demonstration = AvoidingJob((behavior,), seed=0)(0)
    states, actions = demonstration.observations["observation.state"], demonstration.actions
    assert avoiding_behavior(demonstration.observations) == behavior
    assert len(states) == len(actions)
    assert (states[:, 3] > FINISH_LINE_Y).tolist() == [False] * (len(states) - 1) + [True]
    assert np.abs(actions).max() < ACTION_LIMIT_M

    env = AvoidingEnv()
    observation, _ = env.reset()
    for state, action in zip(states, actions, strict=True):
        np.testing.assert_array_equal(observation["agent_pos"], state)
        observation, _, terminated, _, info = env.step(action)
        if terminated:
            break
    assert info["is_success"]
    assert not info["collision"]


def test_demonstrations_differ_and_repeat():
    """Two demonstrations of one behaviour differ; the same seed and number give the same one."""
    job = AvoidingJob(("top-mid-midtop",) * 2, seed=4)
    first, second, again = job(0), job(1), AvoidingJob(("top-mid-midtop",) * 2, seed=4)(0)
    assert len(first.actions) != len(second.actions) or not np.allclose(first.actions, second.actions)
    np.testing.assert_array_equal(first.actions, again.actions)


@pytest.mark.parametrize("behavior", ["inside", "outside"])
def test_aligning_demonstrations(behavior):
    """The box reaches its target in the last recorded state, in the intended way."""
    demonstration = AligningJob((behavior,), seed=1)(0)
    scene = demonstration.observations["observation.environment_state"]
    assert aligning_behavior(demonstration.observations) == behavior
    assert is_aligned(scene).tolist() == [False] * (len(scene) - 1) + [True]
    assert np.abs(demonstration.actions).max() < 0.01
    assert len(scene) == len(demonstration.actions) <= 401


def test_recorded_aligning_actions_reproduce_the_episode():
    """Replayed from the recorded context, the actions solve the task again."""
    demonstration = AligningJob(("outside",), seed=2)(0)
    scene = demonstration.observations["observation.environment_state"][0].astype(float)
    env = AligningEnv()
    box, target = ([*scene[i : i + 2], 2 * math.atan2(scene[i + 6], scene[i + 3])] for i in (0, 7))
    env.reset(options={"box": box, "target": target})
    success = [env.step(action)[4]["is_success"] for action in demonstration.actions]
    assert any(success[-10:])


@dataclass(frozen=True)
class NumberedJob:
    """A cheap job that also counts how often it ran."""

    log: Path

    def __call__(self, i: int) -> Demonstration:
        """Random numbers that depend on i alone."""
        (self.log / f"{i}-{time.time_ns()}").touch()
        values = np.random.default_rng([7, i]).normal(size=(3 + i, 2)).astype(np.float32)
        return Demonstration({"observation.state": values}, values[:, :1])

    def runs(self) -> Counter:
        """How often each episode was made."""
        return Counter(int(path.name.split("-")[0]) for path in self.log.iterdir())


def states(episodes):
    """The episodes' states."""
    return [episode.observations["observation.state"] for episode in episodes]


@pytest.mark.parametrize("n_workers", [1, 2])
def test_generation_continues_after_an_interruption(tmp_path, n_workers):
    """Finished episodes are kept, damaged ones made again; the result is that of one undisturbed process."""
    (tmp_path / "log").mkdir()
    job = NumberedJob(tmp_path / "log")
    undisturbed = states(generate(job, 6, tmp_path / "undisturbed", n_workers=1))
    job = NumberedJob(tmp_path)
    work_dir = tmp_path / "work"
    interrupted = generate(NumberedJob(tmp_path / "log"), 6, work_dir, n_workers=1)
    for _ in range(3):
        next(interrupted)
    interrupted.close()
    assert len(list(work_dir.glob("*.npz"))) == 3
    damaged = work_dir / "episode-000001.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    (work_dir / "episode-000004.npz.123.partial").write_bytes(b"half")

    job = NumberedJob(tmp_path / "log")
    before = job.runs()
    continued = states(generate(job, 6, work_dir, n_workers=n_workers))

    for ours, theirs in zip(continued, undisturbed, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert job.runs() - before == Counter([1, 3, 4, 5])


def test_a_killed_command_continues(tmp_path):
    """A dataset command killed in the middle leaves no dataset, and its successor finds what was finished."""
    flags = ["--task=d3il_avoiding", f"--root={tmp_path / 'out'}"]
    third = r"episode-000002\.npz\.\d+\.partial$"
    with held_command("lerobot_swr.cli.dataset", flags, third) as (command, wait_for_end):
        while len(finished := list(tmp_path.glob(".out-*/episodes/*.npz"))) < 2:
            assert command.poll() is None
            time.sleep(0.1)
        os.killpg(command.pid, signal.SIGKILL)
        wait_for_end()
    assert not (tmp_path / "out").exists()
    episode = load_episode(finished[0])
    assert avoiding_behavior(episode.observations) in AVOIDING_BEHAVIORS


def test_saved_episodes_are_read_back(tmp_path):
    """Saving and loading changes nothing; a missing file is no episode."""
    episode = Demonstration({"observation.state": np.ones((2, 3), np.float32)}, np.zeros((2, 1), np.float32))
    save_episode(tmp_path / "a.npz", episode)
    loaded = load_episode(tmp_path / "a.npz")
    np.testing.assert_array_equal(loaded.observations["observation.state"], np.ones((2, 3)))
    assert load_episode(tmp_path / "b.npz") is None


@given(st.floats(-10, 10), st.floats(-1, 1), st.floats(-1, 1))
def test_frames_are_inverse(angle, x, y):
    """Turning into a frame and back changes nothing, and a frame's first axis is its direction."""
    np.testing.assert_allclose(from_frame(to_frame(np.array([x, y]), angle), angle), [x, y], atol=1e-12)
    np.testing.assert_allclose(to_frame(direction(angle), angle), [1, 0], atol=1e-12)
    assert abs(wrap(angle)) <= math.pi


@settings(max_examples=60)
@given(st.floats(-1.2, 1.2), st.floats(-0.1, 0.1), st.floats(-1.2, 1.2))
def test_steering_law_brings_a_vehicle_home(heading, lateral, goal_angle):
    """A point that moves along its heading with the law's curvature ends at the goal with its heading."""
    grip, gains = INSIDE_CORNER, Gains(turn=1.2, approach=3.0, smallest_distance=0.05)
    goal = PlanePose(0.0, 0.0, goal_angle)
    pose, step = PlanePose(-0.5, lateral, heading), 0.001
    best = math.inf
    for _ in range(2000):
        curvature, ahead = pivot_curvature(pose, goal, grip, gains)
        if ahead < 0:
            break
        pivot = pose.position + grip.pivot * direction(pose.angle) + step * direction(pose.angle)
        angle = pose.angle + step * float(np.clip(curvature, -25, 25))
        centre = pivot - grip.pivot * direction(angle)
        pose = PlanePose(centre[0], centre[1], angle)
        best = min(best, float(np.hypot(*pose.position)) + 0.1 * abs(wrap(pose.angle - goal_angle)))
    assert best < 0.03


@pytest.mark.parametrize("grip", [INSIDE_CORNER, OUTSIDE_FACE])
def test_rod_moves_straight_for_a_straight_path(grip):
    """Without curvature a centred rod moves and presses along the heading; both are unit vectors."""
    velocity, force = rod_directions(0.0, 0.0, grip)
    np.testing.assert_allclose(velocity, [1, 0], atol=1e-12)
    np.testing.assert_allclose(force, [1, 0], atol=1e-12)
    for curvature in (-30.0, -3.0, 3.0, 30.0):
        velocity, force = rod_directions(curvature, 0.0, grip)
        assert np.linalg.norm(velocity) == pytest.approx(1)
        assert np.linalg.norm(force) == pytest.approx(1)
        # Ahead of the centre the rod swings the way of the turn, behind it the other way.
        assert np.sign(velocity[1]) == np.sign(curvature * grip.contact)
