"""Behaviour and offline evaluation through their command, for our policies and for LeRobot's."""

import json
from collections import Counter

import numpy as np
import pytest
import torch
from conftest import SMALL_MAZE, save_checkpoint, train_flags
from lerobot.scripts import lerobot_eval

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.envs.maze2d.behavior import small
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.evaluation.checks import behaviors as behaviors_check
from lerobot_swr.evaluation.metrics import histogram, l1_distance
from lerobot_swr.evaluation.rollouts import StateRecorder
from lerobot_swr.trajectories import load_trajectories

ENV = ("--env.type=maze2d", "--env.task=small", "--env.episode_length=60")


@pytest.fixture(scope="module")
def trained_zbc(small_maze, tmp_path_factory):
    """Folder of a zbc policy that replays the small maze's demonstrations."""
    import sys

    from lerobot.scripts import lerobot_train

    output_dir = tmp_path_factory.mktemp("runs") / "zbc"
    flags = (
        "--policy.backbone.hidden_dim=64",
        "--policy.backbone.num_hidden=4",
        "--save_checkpoint=true",
        "--log_freq=500",
    )
    before = sys.argv
    sys.argv = ["lerobot-train", *train_flags("zbc", small_maze, output_dir, 1500, *flags)]
    try:
        lerobot_train.main()
    finally:
        sys.argv = before
    return output_dir / "checkpoints" / "last" / "pretrained_model"


def evaluate(run_command, policy, root, output_dir, *more):
    run_command(
        eval_command.main,
        f"--policy.path={policy}",
        f"--dataset.root={root}",
        f"--output_dir={output_dir}",
        *more,
    )
    name = "behaviors.json" if any("env.type" in flag for flag in more) else "offline.json"
    return json.loads((output_dir / name).read_text())


def test_every_style_once_reproduces_the_demonstrations(run_command, trained_zbc, small_maze, tmp_path):
    """A trained policy, stratified: L1 near its floor of 0, its figures recomputed from its own records."""
    flags = (*ENV, "--n_episodes=6", "--style_sampling=stratified")
    result = evaluate(run_command, trained_zbc, small_maze, tmp_path, *flags)
    shown = [episode["behavior"] for episode in result["episodes"]]
    assert result["reference_histogram"] == {k: v / 6 for k, v in SMALL_MAZE.items()}
    assert result["histogram"] == histogram(shown)
    assert result["l1"] == pytest.approx(l1_distance(result["histogram"], result["reference_histogram"]))
    assert result["l1_floor"] == 0
    assert result["success_rate"] == np.mean([episode["success"] for episode in result["episodes"]])
    assert sorted(episode["style_episode"] for episode in result["episodes"]) == list(range(6))
    assert result["style_fidelity"] >= 5 / 6
    assert result["l1"] <= 2 / 6 + 1e-9
    assert (tmp_path / "behaviors.png").stat().st_size > 10_000


def test_fidelity_compares_with_the_demonstration_of_the_style(
    run_command, trained_zbc, small_maze, small_maze_meta, tmp_path
):
    """Style fidelity recomputed from the records and the dataset."""
    result = evaluate(
        run_command, trained_zbc, small_maze, tmp_path, *ENV, "--n_episodes=10", "--batch_size=4"
    )
    rule = Maze2DEnvConfig(task="small").behavior_rule()
    demonstrated = [rule(e) for e in load_trajectories(small_maze_meta, ["observation.state"]).episodes()]
    assert Counter(demonstrated) == SMALL_MAZE
    matches = [demonstrated[e["style_episode"]] == e["behavior"] for e in result["episodes"]]
    assert result["style_fidelity"] == pytest.approx(np.mean(matches))
    assert result["n_episodes"] == len(result["episodes"]) == 10
    assert 0 < result["l1_floor"] < 1


def test_the_same_seed_gives_the_same_rollouts(run_command, trained_zbc, small_maze, tmp_path):
    """Noise, starts and styles all follow --seed."""
    flags = (*ENV, "--env.start=pseudo_random", "--env.transition_noise=0.5", "--n_episodes=8")
    first = evaluate(run_command, trained_zbc, small_maze, tmp_path / "a", *flags, "--seed=3")
    again = evaluate(run_command, trained_zbc, small_maze, tmp_path / "b", *flags, "--seed=3")
    other = evaluate(run_command, trained_zbc, small_maze, tmp_path / "c", *flags, "--seed=4")
    assert first["episodes"] == again["episodes"]
    assert first["episodes"] != other["episodes"]


def test_rollouts_begin_where_demonstrations_did(
    run_command, make_tiny_policy, small_maze, small_maze_meta, tmp_path, monkeypatch
):
    """One after the other, and again from the first, over batches; with their styles if these are fixed."""
    shown = []
    monkeypatch.setattr(
        behaviors_check, "plot_behaviors", lambda path, _, rollouts, *rest: shown.extend(rollouts)
    )
    policy = make_tiny_policy("bc")
    checkpoint = save_checkpoint(policy, small_maze_meta, tmp_path / "policy")
    flags = (*ENV, "--env.start=random", "--recorded_starts=true", "--n_episodes=8", "--batch_size=5")
    evaluate(run_command, checkpoint, small_maze, tmp_path, *flags)
    starts = [
        e["observation.state"][0]
        for e in load_trajectories(small_maze_meta, ["observation.state"]).episodes()
    ]
    for k, (path, _) in enumerate(shown):
        np.testing.assert_allclose(path[0], starts[k % 6], atol=1e-6)
    assert len(shown) == 8


def test_recorded_starts_are_refused_where_starts_are_chosen_otherwise(
    run_command, trained_zbc, small_maze, tmp_path, capsys
):
    """Perturbed starts are not the recorded ones."""
    flags = (*ENV, "--recorded_starts=true", "--check.type=robustness")
    with pytest.raises(SystemExit):
        evaluate(run_command, trained_zbc, small_maze, tmp_path, *flags)
    assert "--recorded_starts: no effect on check.type='robustness'" in capsys.readouterr().err


def test_lerobot_eval_runs_the_same_checkpoint(trained_zbc, tmp_path, monkeypatch):
    """LeRobot's own command, with videos."""
    flags = ["--eval.n_episodes=2", "--eval.batch_size=1", f"--output_dir={tmp_path}", *ENV]
    monkeypatch.setattr("sys.argv", ["lerobot-eval", f"--policy.path={trained_zbc}", *flags])
    lerobot_eval.main()
    info = json.loads((tmp_path / "eval_info.json").read_text())
    assert info["overall"]["pc_success"] >= 50
    assert len(list(tmp_path.rglob("*.mp4"))) == 2


def test_offline_errors_are_smallest_for_the_own_style(run_command, trained_zbc, small_maze, tmp_path):
    """On frames: own style below nearest below random; the table by dimension averages to the same."""
    result = evaluate(run_command, trained_zbc, small_maze, tmp_path)
    error = result["action_error"]
    assert set(error) == {"own", "nearest", "random", "same", "other"}
    assert error["own"] < error["nearest"] < error["random"]
    for kind, value in error.items():
        assert np.mean(result["action_error_by_dimension"][kind]) == pytest.approx(value, rel=1e-5)
    assert (tmp_path / "offline.png").exists()


def test_offline_errors_by_behavior(run_command, trained_zbc, small_maze, small_maze_meta, tmp_path):
    """Behaviours make up the whole; styles of the same behaviour explain more than those of another."""
    result = evaluate(run_command, trained_zbc, small_maze, tmp_path / "known")
    table, error = result["action_error_by_behavior"], result["action_error"]
    assert list(table) == ["10", "20"]  # the most frequent first
    episodes = load_trajectories(small_maze_meta, ["observation.state"])
    behaviors = np.array([small(episode) for episode in episodes.episodes()])
    frames = {name: episodes.lengths[behaviors == name].sum() for name in table}
    for kind in ("own", "same", "other"):
        whole = sum(frames[name] * table[name][kind] for name in table) / sum(frames.values())
        assert whole == pytest.approx(error[kind], rel=1e-5)
    assert error["own"] < error["same"] < error["other"]
    first = [int(np.flatnonzero(behaviors == name)[0]) for name in table]
    alone = f"--policy.style_episodes=[{first[0]},{first[1]}]"
    result = evaluate(run_command, trained_zbc, small_maze, tmp_path / "alone", alone)
    assert "same" not in result["action_error"]
    assert result["action_error"]["other"] == pytest.approx(result["action_error"]["nearest"])


def test_offline_evaluation_keeps_to_the_styles_that_may_be_drawn(
    run_command, trained_zbc, small_maze, small_maze_meta, tmp_path, capsys
):
    """A filter chooses the episodes, and among them the nearest and the random other style."""
    lengths = load_trajectories(small_maze_meta, ["observation.state"]).lengths
    middle = int(np.median(lengths))
    chosen = np.flatnonzero(lengths > middle)
    policy = f"--policy.style_filter=length > {middle}"
    result = evaluate(run_command, trained_zbc, small_maze, tmp_path / "some", policy)
    assert result["n_episodes"] == len(chosen)
    assert result["n_frames"] == lengths[chosen].sum()
    listed = f"--policy.style_episodes=[{','.join(map(str, chosen))}]"
    assert (
        evaluate(run_command, trained_zbc, small_maze, tmp_path / "same", listed)["action_error"]
        == (result["action_error"])
    )
    by_number = f"--dataset.episodes=[{','.join(map(str, chosen))}]"  # of all styles
    everything = evaluate(run_command, trained_zbc, small_maze, tmp_path / "all", by_number)
    assert everything["action_error"]["own"] == pytest.approx(result["action_error"]["own"])
    for flag in ("style_sampling=fixed", "style_interpolate=[0,1,0.5]"):
        with pytest.raises(SystemExit):
            evaluate(run_command, trained_zbc, small_maze, tmp_path / "out", f"--policy.{flag}")
        told = capsys.readouterr().err
        assert f"policy.{flag.partition('=')[0]}: no effect on check.type='offline'" in told
        assert "--env.type" in told


def test_offline_evaluation_of_bc_has_no_styles(
    run_command, make_tiny_policy, small_maze, small_maze_meta, tmp_path
):
    """bc reports the error without style, equal to a computation with LeRobot's dataset and processors."""
    from lerobot.datasets import LeRobotDataset
    from lerobot.policies import make_pre_post_processors

    policy = make_tiny_policy("bc").eval()
    folder = save_checkpoint(policy, small_maze_meta, tmp_path / "bc")
    result = evaluate(run_command, folder, small_maze, tmp_path / "out")
    dataset = LeRobotDataset("local/small_maze", root=small_maze)
    batch = torch.utils.data.default_collate([dataset[i] for i in range(len(dataset))])
    batch = make_pre_post_processors(policy.config, dataset_stats=small_maze_meta.stats)[0](batch)
    expected = (policy.select_action(batch) - batch["action"]).square().mean().item()
    assert result["action_error"] == {"none": pytest.approx(expected, rel=1e-4)}


ACT = (
    *("--policy.dim_model=16", "--policy.n_heads=2", "--policy.dim_feedforward=16", "--policy.chunk_size=8"),
    *("--policy.n_action_steps=8", "--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1"),
)
DIFFUSION = (
    *("--policy.down_dims=[8,16]", "--policy.n_groups=4", "--policy.diffusion_step_embed_dim=8"),
    *("--policy.horizon=8", "--policy.n_action_steps=4", "--policy.num_inference_steps=2"),
)


@pytest.mark.parametrize(("policy_type", "flags"), [("act", ACT), ("diffusion", DIFFUSION)])
def test_lerobots_own_policies_train_on_our_data_and_are_scored(
    lerobot_train_command, run_command, small_maze, tmp_path, policy_type, flags
):
    """act and diffusion: same datasets, same evaluation; they have no styles."""
    lerobot_train_command(*train_flags(policy_type, small_maze, tmp_path / "run", 2, *flags))
    policy = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    result = evaluate(run_command, policy, small_maze, tmp_path / "out", *ENV, "--n_episodes=3")
    assert result["n_episodes"] == 3
    assert result["style_fidelity"] is None
    assert [episode["style_episode"] for episode in result["episodes"]] == [None] * 3


def test_the_recorder_ends_with_the_terminal_state_under_autoreset():
    """Also where the vector environment resets at once, the last state is the episode's own."""
    import gymnasium as gym
    from gymnasium.vector import AutoresetMode, SyncVectorEnv

    cfg = Maze2DEnvConfig(task="small", episode_length=4)
    reset_at_once = SyncVectorEnv(
        [lambda: gym.make(cfg.gym_id, **cfg.gym_kwargs)] * 2, autoreset_mode=AutoresetMode.SAME_STEP
    )
    recorded = []
    for env in (StateRecorder(reset_at_once), StateRecorder(cfg.create_rollout_env(2))):
        env.reset(seed=[0, 1])
        for _ in range(4):
            env.step(np.array([[0.5, 1.0], [1.0, 0.0]], dtype=np.float32))
        recorded.append(env.episodes())
    for first, second in zip(*recorded, strict=True):
        assert first["observation.state"].shape == (5, 2)
        np.testing.assert_array_equal(first["observation.state"], second["observation.state"])


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--style_sampling=often", *ENV), "style_sampling='often'"),
        (("--n_episodes=0", *ENV), "n_episodes=0"),
        (("--policy.style_episodes=[]", *ENV), "style_episodes=[]"),
        (("--policy.style_episodes=[9]", *ENV), "episodes [9] do not exist"),
        (("--env.type=maze2d", "--env.task=huge"), "task='huge'"),
        (("--behavior_rule=nowhere:rule", *ENV), "behavior_rule='nowhere:rule'"),
        (("--dataset.episodes=[99]", *ENV), "dataset.episodes=[99]"),
    ],
)
def test_bad_flags_are_named(run_command, trained_zbc, small_maze, tmp_path, capsys, flags, message):
    """One line that names key and value, a failing exit status, nothing written."""
    output_dir = tmp_path / "out"
    with pytest.raises(SystemExit) as exit_info:
        evaluate(run_command, trained_zbc, small_maze, output_dir, *flags)
    assert exit_info.value.code in (1, 2)  # 1: refused by LeRobot's own parser
    assert message in capsys.readouterr().err
    assert not output_dir.exists()


def test_missing_folders_and_foreign_datasets_are_named(
    run_command, trained_zbc, small_maze, tmp_path, capsys
):
    """No dataset, no checkpoint, or a dataset that is not the checkpoint's."""
    from lerobot_swr.demos.dataset_writer import write_dataset
    from lerobot_swr.demos.maze2d import _recipe, steady

    write_dataset(_recipe("three", "small", {"10": 3}, steady), tmp_path / "three")
    write_dataset(_recipe("six", "small", {"10": 6}, steady), tmp_path / "six", seed=1)
    for policy, root, message in (
        (trained_zbc, tmp_path / "nowhere", "no such folder"),
        (tmp_path, small_maze, "no config.json in this folder"),
        (trained_zbc, tmp_path / "three", "has 3 episodes, but the checkpoint has styles of 6"),
        (trained_zbc, tmp_path / "six", "is not the dataset that the checkpoint was trained on"),
    ):
        with pytest.raises(SystemExit):
            evaluate(run_command, policy, root, tmp_path / "out", *ENV)
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("key", ["n_episodes", "batch_size"])
@pytest.mark.parametrize("in_file", [True, False])
def test_options_of_rollouts_are_refused_offline(run_command, tmp_path, capsys, key, in_file):
    """Whether they are on the command line or in a file."""
    file = tmp_path / "flags.yaml"
    file.write_text(f"{key}: 7\n")
    given = f"--config_path={file}" if in_file else f"--{key}=100"
    with pytest.raises(SystemExit):
        run_command(eval_command.main, given, f"--policy.path={tmp_path}", f"--dataset.root={tmp_path}")
    assert (
        f"--{key}: no effect on check.type='offline'; for rollouts in an environment name one"
        in capsys.readouterr().err
    )
