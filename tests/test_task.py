"""What evaluations ask of an environment: this package's tasks, unknown environments, registered adapters."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from lerobot.envs import EnvConfig

from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.task import MissingRuleError, Task, task_of

EPISODE = {"observation.state": np.arange(12.0).reshape(4, 3)}


@EnvConfig.register_subclass("unknown_to_us")
@dataclass
class UnknownEnvConfig(EnvConfig):
    """An environment of another package."""

    features: dict = field(default_factory=dict)

    @property
    def gym_kwargs(self) -> dict:
        """None are needed."""
        return {}


@dataclass
class AdaptedEnvConfig(UnknownEnvConfig):
    """Another one, for which an adapter is registered."""


@task_of.register(AdaptedEnvConfig)
class AdaptedTask(Task):
    """The adapter: what differs from an unknown environment."""

    def start_rule(self):
        """As `Task.start_rule`."""
        return lambda observations: {"reset_to_state": observations["observation.state"][0]}


def test_our_configurations_are_their_own_tasks():
    """The task of a configuration of this package is the configuration, with all its options."""
    for env_cfg in (Maze2DEnvConfig(task="small"), D3ILEnvConfig(task="aligning")):
        task = task_of(env_cfg)
        assert task is env_cfg
        assert task.env_cfg is env_cfg


def test_an_unknown_environment_has_answers_where_there_are_sensible_ones():
    """First two state dimensions as path, all actions needed, what is requested is expected, no scene."""
    task = task_of(UnknownEnvConfig())
    np.testing.assert_array_equal(task.plot_path(EPISODE), EPISODE["observation.state"][:, :2])
    assert task.steps_to_end(EPISODE) == 4
    assert task.expected_behavior("left", EPISODE) == "left"
    assert task.perturbations() == {}
    task.draw_scene(None)


def test_what_an_unknown_environment_lacks_is_named():
    """Rules cannot be guessed: the error is of its own type and names the environment and the flag."""
    task = task_of(UnknownEnvConfig())
    with pytest.raises(MissingRuleError, match=r"'unknown_to_us' has no behaviour rule.*--behavior_rule"):
        task.behavior_rule()
    with pytest.raises(MissingRuleError, match="'unknown_to_us' cannot be put into a recorded start"):
        task.start_rule()


def test_an_adapter_is_found_by_the_type_of_the_configuration():
    """A registered class answers what it knows, and leaves the rest as it is for unknown environments."""
    env_cfg = AdaptedEnvConfig()
    task = task_of(env_cfg)
    assert isinstance(task, AdaptedTask)
    assert task.env_cfg is env_cfg
    np.testing.assert_array_equal(task.start_rule()(EPISODE)["reset_to_state"], [0, 1, 2])
    assert task.steps_to_end(EPISODE) == 4
