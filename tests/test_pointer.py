"""Pointers: from a hand on the picture to an action, and from observations to a place in the picture."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs.configs import EnvConfig

from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.pointer import Command, PlanePointer
from lerobot_swr.envs.pusht.task import PushTTask
from lerobot_swr.envs.task import MissingRuleError, Task, task_of
from lerobot_swr.interactive.recorder import dataset_kind
from lerobot_swr.interactive.session import Session


def at(*state):
    return {"observation.state": np.array(state, dtype=np.float32)}


MAZE = PlanePointer((0, 1), (0, 1), "displacement", speed=0.02, scale=0.02)
FIELD = PlanePointer((0, 512), (512, 0), "position", speed=60)


def test_the_agent_goes_straight_to_the_pointer_and_stops_there():
    """The larger component is the full step; nearer than a step, it is the rest of the way."""
    np.testing.assert_allclose(MAZE.action(at(0.5, 0.5), Command((0.7, 0.6))), [1, -0.5], atol=1e-5)
    np.testing.assert_allclose(MAZE.action(at(0.5, 0.5), Command((0.51, 0.5))), [0.5, 0], atol=1e-5)
    assert (MAZE.action(at(0.5, 0.5), Command()) == 0).all()


def test_a_position_action_leads_the_tool_by_no_more_than_the_speed():
    """An idle hand leaves the set-point where the tool is; the picture's y points down, as the field's."""
    np.testing.assert_allclose(FIELD.action(at(100, 100), Command((0.5, 0.2))), [160, 100 + 60 * 2.4 / 156])
    np.testing.assert_allclose(FIELD.action(at(100, 100), Command()), [100, 100])
    np.testing.assert_allclose(FIELD.action(at(100, 100), Command(push=(0, 1, 0))), [100, 40])


def test_arrow_keys_move_as_the_picture_shows_it():
    """To the right and up, whatever the directions of the plane's coordinates."""
    np.testing.assert_allclose(MAZE.action(at(0.5, 0.5), Command(push=(1, 0, 0))), [1, 0])
    np.testing.assert_allclose(MAZE.action(at(0.5, 0.5), Command(push=(0, -1, 0))), [0, -1])


@pytest.mark.parametrize("pointer", [MAZE, FIELD])
def test_projection_is_the_inverse_of_pointing(pointer):
    """A pointer at the tool's own place moves nothing."""
    state = at(0.3, 0.8) if pointer is MAZE else at(100, 400)
    place = pointer.project({key: value[None] for key, value in state.items()})[0]
    action = pointer.action(state, Command((place[0], place[1])))
    idle = pointer.action(state, Command())
    np.testing.assert_allclose(action, idle, atol=1e-4)


def test_a_third_coordinate_is_the_height():
    """It follows the third axis of the hand alone."""
    pointer = PlanePointer((0, 1), (0, 1), "displacement", speed=0.1, dims=(0, 1, 2))
    np.testing.assert_allclose(pointer.action(at(0.5, 0.5, 0.2), Command(push=(0, 0, -1))), [0, 0, -0.1])


def test_an_environment_says_so_in_its_metadata():
    """What is not said, or wrongly, is told."""

    class Silent(gym.Env):
        metadata = {"render_fps": 10}  # noqa: RUF012

    class Said(gym.Env):
        metadata = {"pointer": {"x": (0, 2), "y": (0, 1), "action": "position", "speed": 0.1}}  # noqa: RUF012

    class Wrong(gym.Env):
        metadata = {"pointer": {"x": (0, 2), "y": (0, 1), "action": "velocity", "speed": 0.1}}  # noqa: RUF012

    task = Task(Maze2DEnvConfig())
    assert task.pointer(Said()) == PlanePointer((0, 2), (0, 1), "position", 0.1)
    with pytest.raises(MissingRuleError, match=r"does not say how a pointer acts"):
        task.pointer(Silent())
    with pytest.raises(ValueError, match="action='velocity'"):
        task.pointer(Wrong())


def test_pusht_has_a_pointer():
    """LeRobot's own type, through its adapter."""
    config = EnvConfig.get_choice_class("pusht")(obs_type="environment_state_agent_pos")
    task = task_of(config)
    assert isinstance(task, PushTTask)
    assert task.pointer(gym.Env()) == FIELD


def test_a_hand_leads_pushts_agent():
    """It arrives at the pointer, and stays where the hand is taken off."""
    pytest.importorskip("gym_pusht")
    config = EnvConfig.get_choice_class("pusht")(obs_type="environment_state_agent_pos")
    session = Session(config, seed=3)
    for _ in range(25):
        session.step(session.follow(Command((0.9, 0.9))))
    np.testing.assert_allclose(session.place(), [0.9, 0.9], atol=0.01)
    session.step(session.follow(Command()))
    np.testing.assert_allclose(session.place(), [0.9, 0.9], atol=0.01)
    assert session.picture().shape == (384, 384, 3)
    kind = dataset_kind(session)
    assert (kind.fps, kind.robot_type, len(kind.features["observation.environment_state"])) == (
        10,
        "pusht",
        16,
    )
    session.close()


@pytest.mark.parametrize(("name", "n_axes"), [("avoiding", 2), ("aligning", 3)])
def test_the_arm_follows_the_ray_under_the_pointer(name, n_axes):
    """Held at the place where the tool should be, it gets there; the picture's place of it says so."""
    pytest.importorskip("mujoco")
    session = Session(D3ILEnvConfig(task=name))
    start = np.array(session.place())
    assert (np.abs(start - 0.5) < 0.5).all()
    goal = start + np.array([0.05, -0.04])
    actions = []
    for _ in range(60):
        actions.append(session.follow(Command((goal[0], goal[1]))))
        session.step(actions[-1])
    np.testing.assert_allclose(session.place(), goal, atol=0.01)
    assert all(np.linalg.norm(action) <= 0.0091 for action in actions)
    assert actions[0].shape == (n_axes,)
    session.close()
