"""Styles that are switched in mid-rollout: what is counted, by a policy whose behaviour is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.pointer import Command
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.interactive.session import Session
from lerobot_swr.interactive.switching import measure_switches, share_kept
from lerobot_swr.styles.cookbook import StyleCookbook

DOORS = {0: 0.27, 1: 0.73}  # style to the door that it takes


class Guide:
    """Acts as style 0 or 1 says, deciding anew every `chunk` steps."""

    def __init__(self, chunk: int = 1):
        self.config = SimpleNamespace(type="guide")
        self.styles = StyleCookbook(2, 3, 0.1)
        self.styles.trained[:] = 1
        self.chunk = chunk
        self.reset()

    def reset(self):
        """Begin a rollout."""
        self.styles.end_rollout()
        self._steps = 0

    def select_action(self, batch):
        """(1, 2) action towards the door, or the goal behind it."""
        self.styles.active_styles(1)
        if self._steps % self.chunk == 0:
            self._door = DOORS[int(self.styles.active[0])]
        self._steps += 1
        x, y = batch["observation.state"][0].tolist()
        ahead = [(self._door, 0.54), (self._door, 0.46)][abs(x - self._door) >= 0.02]
        goal = ahead if y <= 0.5 else (0.5, 0.92)
        step = np.array(goal) - (x, y)
        return torch.tensor(step / max(0.02, np.abs(step).max()), dtype=torch.float32)[None]


def session_of(guide):
    checkpoint = Checkpoint(guide, lambda batch: batch, lambda action: action)
    return Session(Maze2DEnvConfig(task="small"), checkpoint)


@pytest.fixture(scope="module")
def switches():
    return measure_switches(session_of(Guide()), ["10", "20"], n_first=1)


def test_a_policy_that_follows_at_once_keeps_every_request(switches):
    """At the start, before the wall and after it, where the goal is all that is left to show."""
    assert share_kept(switches) == {
        "10": {"after 0": (1, 1), "before 1": (1, 1), "after 1": (1, 1)},
        "20": {"after 0": (1, 1), "before 1": (1, 1), "after 1": (1, 1)},
    }
    assert {switch.expected for switch in switches if switch.moment == "after 1"} == {"0"}
    assert {switch.latency for switch in switches if switch.moment != "after 1"} == {1}


def test_the_moments_lie_at_the_wall(switches):
    """Four steps before the agent passes it, and when it has."""
    session = session_of(Guide())
    session.reset(seed=0, styles=0)
    passed = 0
    while session.scene.observations["observation.state"][1] <= 0.5:
        session.step()
        passed += 1
    steps = {switch.moment: switch.step for switch in switches if switch.first == "10"}
    assert steps == {"after 0": 0, "before 1": passed - 4, "after 1": passed}


def test_a_plan_of_several_steps_delays_the_first_action():
    """Three of four steps of the plan are left when the request comes after the first one."""
    late = [s for s in measure_switches(session_of(Guide(4)), ["10", "20"], 1) if s.moment == "before 1"]
    assert all(switch.latency == (-switch.step) % 4 + 1 for switch in late)


def test_a_policy_that_ignores_requests_keeps_none():
    """It shows what it began with, and its actions never differ."""
    guide = Guide(chunk=1000)
    kept = share_kept(measure_switches(session_of(guide), ["10", "20"], 1))
    assert kept["10"]["before 1"] == (0, 1)
    assert kept["20"]["after 1"] == (1, 1)


def test_a_hand_moves_the_agent_of_a_policy():
    """The action of a person takes the policy's place for that step only."""
    session = session_of(Guide())
    session.reset(styles=0)
    session.step(session.follow(Command(push=(1, 0, 0))))
    np.testing.assert_allclose(session.scene.observations["observation.state"], [0.52, 0.08], atol=1e-6)
    assert session.step().observations["observation.state"][0] < 0.52
