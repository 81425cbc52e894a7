"""PushT through LeRobot's own environment type: the adapter, a rollout evaluation, recorded starts."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.envs import make_env
from lerobot.envs.configs import PushtEnv
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from matplotlib.figure import Figure

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.envs.pusht.task import PushTTask
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import load_checkpoint, load_demonstrations
from lerobot_swr.evaluation.rollouts import run_rollouts
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig

pytest.importorskip("gym_pusht", reason="absent: pip install 'lerobot_policy_swr[pusht]'")

from lerobot_swr.envs.pusht.behavior import goal_coverage

STATE, SCENE = "observation.state", "observation.environment_state"
KEYPOINTS = {"obs_type": "environment_state_agent_pos"}
RULE = "lerobot_swr.envs.pusht.behavior:first_push"
FEATURES = {STATE: 2, SCENE: 16, "action": 2}
STEPS = 12


@pytest.fixture(scope="module")
def pushes(tmp_path_factory):
    """A dataset of 3 episodes in which the agent walks to the block and pushes it."""
    root = tmp_path_factory.mktemp("datasets") / "pushes"
    features = {k: {"dtype": "float32", "shape": (d,), "names": None} for k, d in FEATURES.items()}
    dataset = LeRobotDataset.create("local/pushes", fps=10, features=features, root=root, use_videos=False)
    env = gym.make("gym_pusht/PushT-v0", **KEYPOINTS)
    for seed in range(3):
        observation, _ = env.reset(seed=seed)
        for _ in range(STEPS):
            action = observation["environment_state"].reshape(8, 2).mean(axis=0)
            frame = {STATE: observation["agent_pos"], SCENE: observation["environment_state"]}
            frame = {k: v.astype(np.float32) for k, v in {**frame, "action": action}.items()}
            dataset.add_frame({**frame, "task": "push"})
            observation, *_ = env.step(frame["action"])
        dataset.save_episode()
    dataset.finalize()
    env.close()
    return root


@pytest.fixture
def checkpoint(pushes, tmp_path):
    """Folder of a small, untrained policy."""
    torch.manual_seed(0)
    meta = LeRobotDatasetMetadata("local/pushes", root=pushes)
    config = make_policy_config("bc", backbone=MLPConfig(8, 2), device="cpu", push_to_hub=False)
    return save_checkpoint(make_policy(config, ds_meta=meta), meta, tmp_path / "policy")


def test_lerobots_configuration_finds_the_adapter():
    """With the behaviour rule, and the block's middle as path."""
    task = task_of(PushtEnv(**KEYPOINTS))
    assert isinstance(task, PushTTask)
    assert task.draws_scenes
    assert task.behavior_rule().__name__ == RULE.partition(":")[2]
    corners = np.arange(32.0).reshape(2, 16)
    np.testing.assert_allclose(task.plot_path({SCENE: corners}), [(7, 8), (23, 24)])


def test_other_observations_are_refused_with_the_flag_that_mends_it():
    """Pictures, LeRobot's default, do not tell where the block is."""
    task = task_of(PushtEnv())
    for ask in (task.behavior_rule, task.start_rule):
        with pytest.raises(ValueError, match=r"'pixels_agent_pos'.*--env.obs_type=environment_state"):
            ask()


def test_pictures_show_the_goal():
    """In pixels, y downwards: the corners are where the environment has them."""
    axes = Figure().subplots()
    task_of(PushtEnv(**KEYPOINTS)).draw_scene(axes)
    corners = axes.patches[0].get_xy()
    env = gym.make("gym_pusht/PushT-v0", **KEYPOINTS).unwrapped
    env.reset(seed=0)
    env.block.angle = float(env.goal_pose[2])
    env.block.position = tuple(env.goal_pose[:2])
    expected = env.get_keypoints(env._block_shapes)
    assert np.abs(corners[:, None] - expected).sum(axis=2).min(axis=0).max() < 1e-6
    assert axes.yaxis_inverted()
    env.close()


def test_a_recorded_start_is_restored_through_lerobots_environment(pushes):
    """The options of the start rule put LeRobot's environment where the recording began."""
    episode = load_demonstrations(LeRobotDatasetMetadata("local/pushes", root=pushes)).episode(1)
    env_cfg = PushtEnv(**KEYPOINTS)
    env = make_env(env_cfg, n_envs=1)["pusht"][0]
    observation, _ = env.reset(options=task_of(env_cfg).start_rule()(episode))
    np.testing.assert_allclose(observation["agent_pos"][0], episode[STATE][0], atol=1e-3)
    np.testing.assert_allclose(observation["environment_state"][0], episode[SCENE][0], atol=1e-3)
    env.close()


def test_rollouts_are_labelled_and_scored(run_command, pushes, checkpoint, tmp_path):
    """By the environment's own rule and rewards; the mean of the largest ones stands in the result."""
    flags = (f"--policy.path={checkpoint}", f"--dataset.root={pushes}", f"--output_dir={tmp_path}")
    env = ("--env.type=pusht", "--env.obs_type=environment_state_agent_pos", "--env.episode_length=6")
    run_command(eval_command.main, *flags, *env, "--n_episodes=3")
    result = json.loads((tmp_path / "behaviors.json").read_text())
    assert set(result["histogram"]) == {"unfinished"}
    rewards = [record["max_reward"] for record in result["episodes"]]
    assert result["max_reward"] == pytest.approx(np.mean(rewards))
    interval = result["max_reward_interval"]
    assert interval["low"] <= result["max_reward"] <= interval["high"]
    assert (tmp_path / "behaviors.png").exists()


def test_the_largest_reward_is_the_largest_coverage(checkpoint):
    """In units of the .95 that success takes, recomputed from the states after the first one."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    env_cfg = PushtEnv(episode_length=6, **KEYPOINTS)
    shown = run_rollouts(load_checkpoint(config), env_cfg, lambda states: "", 3, 3, seed=20)
    for rollout in shown:
        largest = goal_coverage(rollout.observations)[1:].max()
        assert rollout.max_reward == pytest.approx(largest / 0.95, abs=1e-5)
    assert max(rollout.max_reward for rollout in shown) > 0
