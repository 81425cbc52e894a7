"""What environments show of their state (``obs_type``), and datasets with pictures."""

import json
import time

import gymnasium as gym
import numpy as np
import pytest
from conftest import train_flags
from gymnasium.utils.env_checker import check_env
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.envs import make_env, preprocess_observation
from lerobot.envs.utils import env_to_policy_features
from lerobot.scripts import lerobot_eval

from lerobot_swr.cli import dataset as dataset_command
from lerobot_swr.cli import eval as eval_command
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.envs.maze2d.camera import AGENT_RADIUS, MazeCamera
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.env import Maze2DEnv
from lerobot_swr.envs.maze2d.layouts import LAYOUTS
from lerobot_swr.envs.maze2d.scenes import draw_scene
from lerobot_swr.envs.observed import as_simulated
from lerobot_swr.evaluation.checkpoint import load_demonstrations
from lerobot_swr.evaluation.open_loop import play
from lerobot_swr.evaluation.rollouts import StateRecorder

PICTURE = "observation.images.top"
STATE, SCENE = "observation.state", "observation.environment_state"
FLOOR = (245, 245, 245)


@pytest.fixture(scope="module")
def scenes():
    """Some scenes of the large maze."""
    rng = np.random.default_rng(0)
    return np.stack([draw_scene(LAYOUTS["scenes_large"], rng) for _ in range(20)])


@pytest.mark.parametrize("obs_type", ["state", "pixels", "both"])
@pytest.mark.parametrize("task", ["medium", "scenes"])
def test_every_kind_of_observation_follows_gymnasiums_contract(task, obs_type):
    """Spaces, dtypes and seeding."""
    check_env(Maze2DEnv(task=task, obs_type=obs_type, camera_size=32, render_mode="rgb_array"))


@pytest.mark.parametrize(
    ("obs_type", "expected"),
    [
        ("state", {STATE: (2,), SCENE: (4,)}),
        ("both", {STATE: (2,), SCENE: (4,), PICTURE: (3, 48, 48)}),
        ("pixels", {STATE: (2,), PICTURE: (3, 48, 48)}),
    ],
)
def test_features_are_named_as_lerobots_are(obs_type, expected):
    """The configuration declares what the environment gives, in LeRobot's names and shapes."""
    cfg = Maze2DEnvConfig(task="scenes", obs_type=obs_type, camera_size=48)
    declared = {key: ft.shape for key, ft in env_to_policy_features(cfg).items() if key != "action"}
    assert declared == expected
    env = make_env(cfg, n_envs=2, use_async_envs=False)["maze2d"][0]
    given = preprocess_observation(env.reset(seed=[0, 1])[0])
    assert {key: tuple(given[key].shape[1:]) for key in expected} == expected
    env.close()


def test_pixels_tell_no_place_but_by_the_picture():
    """The state is the last displacement, so that two places look alike but in the picture; rules see all."""
    env = gym.make(Maze2DEnvConfig().gym_id, obs_type="pixels").unwrapped
    first, _ = env.reset(seed=0)
    np.testing.assert_array_equal(first["agent_pos"], [0, 0])
    after, *_ = env.step(np.array([1.0, 0.5], dtype=np.float32))
    np.testing.assert_allclose(after["agent_pos"], [0.02, 0.01], atol=1e-6)
    elsewhere, _ = env.reset(seed=0, options={"agent_pos": [0.3, 0.6]})
    np.testing.assert_array_equal(first["agent_pos"], elsewhere["agent_pos"])
    assert (first["pixels"]["top"] != elsewhere["pixels"]["top"]).any()
    told = as_simulated(preprocess_observation({k: v for k, v in elsewhere.items() if k != "pixels"}))
    np.testing.assert_allclose(told[STATE][0], [0.3, 0.6], atol=1e-6)
    np.testing.assert_allclose(told[SCENE][0], LAYOUTS["medium"].goal, atol=1e-6)


def test_the_picture_shows_agent_goal_and_walls_where_they_are(scenes):
    """Centres of mass of each colour against the numbers; doors are gaps in the wall."""
    layout, size = LAYOUTS["scenes_large"], 64
    rng = np.random.default_rng(1)
    positions = np.stack([rng.uniform(0.1, 0.9, 20), rng.uniform(0.42, 0.58, 20)], 1)
    pictures = MazeCamera(layout, size).pictures(positions, scenes).astype(float)
    centres = (np.arange(size) + 0.5) / size

    def centre(share):
        return (share * centres).sum() / share.sum(), (share * (1 - centres[:, None])).sum() / share.sum()

    for picture, position, scene in zip(pictures, positions, scenes, strict=True):
        red, green, blue = np.moveaxis(picture, -1, 0)
        np.testing.assert_allclose(centre(np.clip(blue - red - 30, 0, None)), position, atol=0.3 / size)
        np.testing.assert_allclose(centre(np.clip(green - blue - 60, 0, None)), scene[:2], atol=0.3 / size)
        for wall, doors in zip(layout.walls, (scene[2:4], scene[4:]), strict=True):
            row = picture[int((1 - wall.y) * size)].mean(axis=1)
            for x in doors:
                assert row[int(x * size)] > 200
                assert row[int((x + wall.doors[0].half_width) * size) + 1] < 120
    assert AGENT_RADIUS * size > 1.5


def test_agents_are_seen_to_a_fraction_of_a_pixel(scenes):
    """A fifth of a pixel's step changes the picture."""
    camera = MazeCamera(LAYOUTS["scenes_large"], 64)
    near = np.array([[0.5, 0.5], [0.5 + 0.2 / 64, 0.5]])
    first, second = camera.pictures(near, scenes[[0, 0]]).astype(int)
    assert np.abs(first - second).max() > 10


def test_a_frame_takes_less_than_a_millisecond(scenes):
    """Of processor time, on one core, in mazes that are already drawn."""
    camera = MazeCamera(LAYOUTS["scenes_large"], 64)
    positions = np.random.default_rng(2).uniform(0, 1, (20, 2))
    camera.pictures(positions, scenes)
    before = time.process_time()
    for _ in range(10):
        camera.pictures(positions, scenes)
    assert (time.process_time() - before) / 200 < 1e-3


def test_a_batch_sees_what_single_environments_see():
    """Pictures and displacements of all agents at once are those of each one alone, to its end."""
    cfg = Maze2DEnvConfig(task="scenes", obs_type="pixels", camera_size=24, episode_length=30)
    fast, usual = cfg.create_rollout_env(3), make_env(cfg, n_envs=3, use_async_envs=False)["maze2d"][0]
    rng = np.random.default_rng(1)
    seen = [env.reset(seed=[7, 8, 9])[0] for env in (fast, usual)]
    for _ in range(29):
        np.testing.assert_array_equal(*(one["pixels"]["top"] for one in seen))
        np.testing.assert_array_equal(*(one["agent_pos"] for one in seen))
        actions = np.clip(rng.normal([0, 0.5], 1, (3, 2)), -1, 1).astype(np.float32)
        seen = [env.step(actions)[0] for env in (fast, usual)]


def test_rules_see_the_simulators_states_of_a_camera_rollout():
    """A recorder of a camera environment returns positions and scene, the same as without a camera."""
    episodes = {}
    for obs_type in ("state", "pixels", "both"):
        cfg = Maze2DEnvConfig(task="scenes", obs_type=obs_type, camera_size=16)
        env = StateRecorder(cfg.create_rollout_env(2))
        env.reset(seed=[3, 4])
        for _ in range(5):
            env.step(np.array([[1, 0.5], [0, 1]], dtype=np.float32))
        episodes[obs_type] = env.episodes()
    for i in range(2):
        for key in (STATE, SCENE):
            for obs_type in ("pixels", "both"):
                np.testing.assert_array_equal(episodes[obs_type][i][key], episodes["state"][i][key])


@pytest.fixture(scope="module")
def camera_datasets(tmp_path_factory):
    """Folders of three demonstrations in the small maze, by ``obs_type``."""
    folder = tmp_path_factory.mktemp("cameras")
    recipe = _recipe("tiny", "small", {"10": 2, "20": 1}, steady)
    for obs_type in ("state", "both", "pixels"):
        write_dataset(recipe, folder / obs_type, seed=0, obs_type=obs_type)
    return folder


def test_a_dataset_with_pictures_holds_what_the_environment_shows(camera_datasets):
    """Frame by frame, played again: pictures without loss, and with `pixels` the displacements."""
    for obs_type in ("both", "pixels"):
        root = camera_datasets / obs_type
        dataset = LeRobotDataset(f"local/{obs_type}", root=root)
        cfg = Maze2DEnvConfig(task="small", obs_type=obs_type)
        env = cfg.create_rollout_env(1)
        shown, _ = env.reset(seed=[0])
        for t in range(6):
            frame = dataset[t]
            seen = preprocess_observation(shown)
            for key in (STATE, PICTURE):
                np.testing.assert_allclose(frame[key], seen[key][0], atol=1e-6)
            shown, *_ = env.step(frame["action"][None].numpy())
        assert set(dataset.features) & {SCENE, "simulator.state"} == (
            {SCENE} if obs_type == "both" else {"simulator.state"}
        )


def test_evaluations_read_the_simulators_states_of_every_kind_of_dataset(camera_datasets):
    """Behaviours, starts and actions are those of the dataset without a camera; replay succeeds."""
    read = {}
    for obs_type in ("state", "both", "pixels"):
        meta = LeRobotDatasetMetadata(f"local/{obs_type}", root=camera_datasets / obs_type)
        read[obs_type] = load_demonstrations(meta)
    cfg = Maze2DEnvConfig(task="small", obs_type="pixels", camera_size=16)
    for i in range(3):
        for obs_type in ("both", "pixels"):
            for key, column in read["state"].episode(i).items():
                np.testing.assert_array_equal(read[obs_type].episode(i)[key], column)
    episodes = list(read["pixels"].episodes())
    replays = play(cfg.create_rollout_env(3), episodes, list(map(cfg.start_rule(), episodes)), seed=0)
    assert all(replay.success for replay in replays)


def test_replay_is_in_step_with_a_dataset_for_cameras(run_command, camera_datasets, tmp_path):
    """``--baseline=replay`` compares the simulator's states, by their names."""
    run_command(
        eval_command.main,
        "--baseline=replay",
        "--env.type=maze2d",
        "--env.task=small",
        f"--dataset.root={camera_datasets / 'pixels'}",
        f"--output_dir={tmp_path}",
    )
    result = json.loads((tmp_path / "replay.json").read_text())
    assert result["success_rate"] == result["behavior_match"] == 1
    assert ["x", "y"] in [group["columns"] for group in result["offsets"]]


def test_the_command_adds_pictures(run_command, tmp_path, capsys):
    """``--images=true``, or the kind of observation by its name; contradictions are refused."""
    flags = ("--task=scenes_maze-two_ways", "--n_episodes=2")
    run_command(dataset_command.main, *flags, f"--root={tmp_path / 'a'}", "--images=true")
    meta = LeRobotDatasetMetadata("local/a", root=tmp_path / "a")
    assert meta.features[PICTURE]["shape"] == (64, 64, 3)
    assert {STATE, SCENE} <= set(meta.features)
    for more, message in (
        (("--images=true", "--obs_type=state"), "exclude each other"),
        (("--obs_type=depth",), "obs_type='depth': expected 'state', 'pixels' or 'both'"),
    ):
        with pytest.raises(SystemExit):
            run_command(dataset_command.main, *flags, f"--root={tmp_path / 'b'}", *more)
        assert message in capsys.readouterr().err
    assert not (tmp_path / "b").exists()


TINY = {
    "act": {
        **{"dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "n_encoder_layers": 1},
        **{"n_decoder_layers": 1, "chunk_size": 4, "n_action_steps": 4, "use_vae": "false"},
    },
    "diffusion": {
        **{"down_dims": "[8,16]", "n_groups": 4, "diffusion_step_embed_dim": 8, "horizon": 8},
        **{"n_action_steps": 4, "num_train_timesteps": 4, "spatial_softmax_num_keypoints": 4},
    },
}


@pytest.mark.parametrize(
    ("policy_type", "obs_type"), [("act", "both"), ("act", "pixels"), ("diffusion", "pixels")]
)
def test_lerobots_policies_train_on_pictures_and_act_in_the_environment(
    lerobot_train_command, run_command, camera_datasets, tmp_path, policy_type, obs_type
):
    """``lerobot-train`` and ``lerobot-eval`` as they are, with a tiny network."""
    lerobot_train_command(
        *train_flags(policy_type, camera_datasets / obs_type, tmp_path / "run", 2),
        "--policy.pretrained_backbone_weights=null",
        *(f"--policy.{key}={value}" for key, value in TINY[policy_type].items()),
        "--save_freq=2",
    )
    run_command(
        lerobot_eval.main,
        f"--policy.path={tmp_path / 'run/checkpoints/last/pretrained_model'}",
        "--policy.device=cpu",
        "--env.type=maze2d",
        "--env.task=small",
        f"--env.obs_type={obs_type}",
        "--env.episode_length=6",
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    overall = json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == 2


@pytest.mark.parametrize("options", [{"obs_type": "depth"}, {"camera_size": 8}])
def test_bad_cameras_are_named(options):
    """Before any environment is started."""
    with pytest.raises(ValueError, match=next(iter(options))):
        Maze2DEnvConfig(**options)


@pytest.mark.parametrize("task", ["avoiding", "aligning"])
def test_the_arms_camera_shows_what_moves(task):
    """Features, and pictures that differ where box and arm do; needs a renderer without a screen."""
    pytest.importorskip("mujoco")
    from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig

    cfg = D3ILEnvConfig(task=task, obs_type="both", camera_size=32)
    assert env_to_policy_features(cfg)[PICTURE].shape == (3, 32, 32)
    assert SCENE not in env_to_policy_features(D3ILEnvConfig(task=task, obs_type="pixels"))
    env = cfg.create_rollout_env(2)
    try:
        seen = env.reset(seed=[0, 1])[0]["pixels"]["top"]
    except RuntimeError as error:
        pytest.skip(str(error))
    assert (seen[0] != seen[1]).any() == (task == "aligning")
    for _ in range(8):
        after = env.step(np.full((2, cfg.features["action"].shape[0]), 0.01, dtype=np.float32))[0]
    assert (after["pixels"]["top"][0] != seen[0]).any()
    env.close()


def test_the_arms_demonstrations_are_seen_as_the_environment_shows_them():
    """Pictures of a short demonstration are those of an environment that plays it."""
    pytest.importorskip("mujoco")
    from lerobot_swr.demos.arm_pictures import aligning_pictures
    from lerobot_swr.demos.recipe import Demonstration
    from lerobot_swr.envs.d3il.aligning import AligningEnv

    env = AligningEnv(obs_type="both")
    try:
        seen = [env.reset(seed=3)[0]]
    except RuntimeError as error:
        pytest.skip(str(error))
    actions = np.tile(np.array([[0.004, 0.006, -0.002]], dtype=np.float32), (5, 1))
    seen += [env.step(action)[0] for action in actions[:-1]]
    observations = {
        STATE: np.stack([one["agent_pos"] for one in seen]),
        SCENE: np.stack([one["environment_state"] for one in seen]),
    }
    pictures = aligning_pictures(Demonstration(observations, actions))
    shown = np.stack([one["pixels"]["top"] for one in seen])
    assert pictures.shape == shown.shape == (5, 96, 96, 3)
    assert np.abs(pictures.astype(int) - shown).mean() < 0.5
    assert get_recipe("d3il_aligning").pictures is aligning_pictures
