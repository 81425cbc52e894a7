"""Commands of LeRobot and of this package with styles over LeRobot's policies."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch
from conftest import train_flags
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_policy_config
from lerobot.scripts import lerobot_eval
from safetensors.torch import load_file
from styled_policies import LENGTHS, batch_of, checkpoint, load, metadata_of, nested
from training_command import assert_same_checkpoint, forget_after, train_in_two_processes

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.cli import styles as styles_command
from lerobot_swr.evaluation.checkpoint import load_checkpoint
from lerobot_swr.evaluation.checks.offline import frame_errors
from lerobot_swr.trajectories import load_trajectories


@pytest.mark.parametrize(("policy_type", "kind"), [("zbc", "act"), ("wzbc", "diffusion")])
def test_training_goes_on_exactly_and_acts(
    lerobot_train_command, small_maze, tmp_path, monkeypatch, policy_type, kind
):
    """``lerobot-train``, stopped and resumed: the same bit for bit; then ``lerobot-eval`` on the maze."""
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    flags = [*nested(kind), "--save_freq=3", "--log_freq=2", "--policy.lr_schedule=cosine"]
    lerobot_train_command(*train_flags(policy_type, small_maze, whole, 6, *flags))
    shutil.copytree(whole, stopped, symlinks=True)
    forget_after(3, stopped)
    config = checkpoint(stopped, "000003") / "train_config.json"
    config.write_text(config.read_text().replace(str(whole), str(stopped)))
    lerobot_train_command(f"--config_path={config}", "--resume=true")
    expected, resumed = (
        load_file(checkpoint(run, "000006") / "model.safetensors") for run in (whole, stopped)
    )
    assert all(torch.equal(value, resumed[key]) for key, value in expected.items())

    output = tmp_path / "eval"
    command = [f"--policy.path={checkpoint(whole)}", "--env.type=maze2d", "--env.task=small"]
    more = ["--eval.n_episodes=2", "--eval.batch_size=2", f"--output_dir={output}", "--policy.device=cpu"]
    monkeypatch.setattr(sys, "argv", ["lerobot-eval", *command, *more, "--policy.style_sampling=stratified"])
    lerobot_eval.main()
    assert json.loads((output / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def test_behaviours_are_evaluated_and_demonstrations_added(
    make_styled, small_maze, tmp_path, run_command, capsys
):
    """``lerobot-swr-eval``; ``--add`` encodes under the backbone's loss, never worse."""
    policy = make_styled("zbc", "act", small_maze, episodes=[0, 1, 2, 3])
    folder = save(policy, small_maze, tmp_path / "old")
    run_command(
        eval_command.main,
        f"--policy.path={folder}",
        "--env.type=maze2d",
        "--env.task=small",
        f"--dataset.root={small_maze}",
        "--n_episodes=4",
        "--style_sampling=stratified",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert list((tmp_path / "eval").rglob("*.json"))
    source = [f"--dataset.root={small_maze}", f"--add={small_maze}", f"--output_dir={tmp_path / 'new'}"]
    capsys.readouterr()
    run_command(styles_command.main, folder, *source)
    told = capsys.readouterr().out.splitlines()
    assert any("loss (under the nearest demonstration's style)" in line for line in told)
    rows = [line.split() for line in told if line.strip()[:1].isdigit()]
    assert [int(row[0]) for row in rows] == [4, 5]
    assert all(float(row[2]) <= float(row[3].strip("()")) for row in rows)
    new = load(tmp_path / "new")
    assert new.styles.trained.tolist() == [1] * 6
    for key, value in policy.backbone.state_dict().items():
        assert torch.equal(value, new.backbone.state_dict()[key])


def save(policy, root: Path, folder: Path) -> Path:
    """A checkpoint with its processors."""
    from lerobot.policies import make_pre_post_processors

    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=metadata_of(root).stats):
        processor.save_pretrained(folder)
    return folder


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_held_out_episodes_are_scored_under_an_encoded_style(make_styled, small_maze, kind):
    """Under the backbone's own loss, the same every time, and not worse than under any trained style."""
    policy = make_styled("zbc", kind, small_maze, episodes=[0, 1, 2, 3], balance_episodes=False).eval()
    batch = batch_of(policy, small_maze, size=6)
    episode = policy.data.frames(5, torch.arange(6).numpy())
    held_out = {key: episode[key] for key in batch if key in episode}
    held_out["episode_index"] = torch.full((6,), 5)
    state = torch.get_rng_state()
    with torch.no_grad():
        loss = policy.forward(held_out)[0]
        assert policy.forward(held_out)[0] == loss
        borrowed = [policy.forward({**held_out, "episode_index": torch.full((6,), i)})[0] for i in range(4)]
    assert loss < min(borrowed) + 1e-3
    assert torch.equal(torch.get_rng_state(), state)
    assert policy.styles.trained.tolist() == [1, 1, 1, 1, 0, 0]


def test_flags_stand_above_a_plain_checkpoint(make_styled, small_maze, tmp_path, monkeypatch):
    """Those that say what is the default anyway, too; a checkpoint with styles begins from no plain one."""
    act = PreTrainedConfig.get_choice_class("act")
    act(device="cpu", chunk_size=4, n_action_steps=2).save_pretrained(tmp_path)
    flags = ["--policy.backbone.chunk_size=100", f"--policy.backbone.pretrained_path={tmp_path}"]
    monkeypatch.setattr("sys.argv", ["lerobot-train", *flags])
    backbone = act(device="cpu", pretrained_path=tmp_path)
    config = make_policy_config("zbc", backbone=backbone, device="cpu")
    assert (config.backbone.chunk_size, config.backbone.n_action_steps) == (100, 2)
    with pytest.raises(ValueError, match=r"the weights come from the checkpoint at policy\.path"):
        make_policy_config("zbc", backbone=backbone, device="cpu", num_episodes=3)


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_fine_tuning_begins_from_a_plain_checkpoint(
    lerobot_train_command, make_styled, small_maze, tmp_path, kind
):
    """Options and weights are the plain policy's; only what sees the style is new."""
    lerobot_train_command(*train_flags(kind, small_maze, tmp_path / "plain", 2, *nested(kind, "policy.")[1:]))
    plain = load(checkpoint(tmp_path / "plain"))
    flags = [
        f"--policy.backbone.type={kind}",
        f"--policy.backbone.pretrained_path={checkpoint(tmp_path / 'plain')}",
    ]
    lerobot_train_command(
        *train_flags("zbc", small_maze, tmp_path / "styled", 1, *flags, "--policy.style_lr=1e-12")
    )
    config = json.loads((checkpoint(tmp_path / "styled") / "config.json").read_text())
    assert config["backbone"]["n_action_steps"] == plain.config.n_action_steps

    torch.manual_seed(0)
    options = {"backbone": {"pretrained_path": checkpoint(tmp_path / "plain")}}
    policy = make_styled("zbc", kind, small_maze, **options).eval()
    own, theirs = policy.backbone.policy.state_dict(), plain.state_dict()
    assert own.keys() == theirs.keys()
    enlarged = [key for key, value in theirs.items() if value.shape != own[key].shape]
    assert enlarged
    for key, value in theirs.items():
        if key not in enlarged:
            assert torch.equal(value, own[key])
    batch = batch_of(policy, small_maze, size=4)
    zero = torch.zeros(4, policy.config.style_dim)
    with torch.no_grad():
        torch.manual_seed(1)
        styled = policy.backbone.policy.forward(policy.backbone.place.put(batch, zero))[0]
        torch.manual_seed(1)
        assert torch.allclose(plain.eval().forward(dict(batch))[0], styled, atol=1e-6)


def test_a_checkpoint_of_another_policy_is_refused(make_styled, small_maze, tmp_path):
    """And one with styles, which goes on with --policy.path; and none at all."""
    folder = save(make_styled("zbc", "act", small_maze), small_maze, tmp_path / "styled")
    with pytest.raises(ValueError, match=r"checkpoint of 'zbc', .*type='act'; .*--policy.path"):
        make_styled("zbc", "act", small_maze, backbone={"pretrained_path": folder})
    with pytest.raises(FileNotFoundError, match=r"policy.backbone.pretrained_path=.*no config.json"):
        make_styled("zbc", "act", small_maze, backbone={"pretrained_path": tmp_path / "none"})


def test_seeds_of_a_policy_that_is_not_stackable_train_one_by_one(swr_train, small_maze, tmp_path):
    """``lerobot-swr-train`` on states: as ``lerobot-train --seed`` does, and resumed exactly."""
    flags = train_flags("zbc", small_maze, tmp_path / "runs", 4, *nested("act"), "--jobs=1", "--save_freq=2")
    swr_train(*flags, "--seeds=0")
    shutil.copytree(tmp_path / "runs", tmp_path / "again", symlinks=True)
    forget_after(2, tmp_path / "again/seed_0")
    again = [flag.replace(str(tmp_path / "runs"), str(tmp_path / "again")) for flag in flags]
    swr_train(*again, "--seeds=0", "--resume=true")
    last = Path("seed_0/checkpoints/000004")
    assert_same_checkpoint(tmp_path / "runs" / last, tmp_path / "again" / last)


def test_cameras_are_seen(make_styled, camera_arcs, caplog):
    """Images are inputs of the backbone; ν compares the numbers; a picture changes what is done."""
    policy = make_styled("wzbc", "act", camera_arcs).train()
    assert "left out" not in caplog.text
    assert policy.config.compared_keys == ["observation.state"]
    assert set(policy.config.image_features) == {"observation.images.front", "observation.images.wrist"}
    batch = batch_of(policy, camera_arcs)
    loss, _ = policy.forward(batch)
    loss.backward()
    dark = {key: value * 0 if "images" in key else value for key, value in batch.items()}
    policy.eval()
    with torch.no_grad():
        assert not torch.equal(policy.predict_action_chunk(batch), policy.predict_action_chunk(dark))
    assert len(policy.trajectories) == len(LENGTHS)


def test_pictures_are_not_read_for_the_similarity(make_styled, camera_arcs, monkeypatch):
    """Making the policy decodes none."""
    from lerobot.datasets import LeRobotDataset

    monkeypatch.setattr(LeRobotDataset, "__getitem__", lambda *args: pytest.fail("a frame was decoded"))
    make_styled("wzbc", "act", camera_arcs)


def test_offline_evaluation_sees_what_training_saw(make_styled, camera_arcs, tmp_path):
    """Cameras and windows; the error of the present action, against the chunk's first."""
    folder = save(make_styled("zbc", "act", camera_arcs), camera_arcs, tmp_path)
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    loaded = load_checkpoint(config)
    meta = metadata_of(camera_arcs)
    trajectories = load_trajectories(meta, ["observation.state", "action"])
    errors = frame_errors(loaded, trajectories)
    assert errors.squared["own"].shape == (sum(LENGTHS), 2)
    policy, own = loaded.policy, []
    with torch.no_grad():
        for i, length in enumerate(LENGTHS):
            from lerobot_swr.policies.demonstration_frames import dataset_frames

            frames = dataset_frames(policy.config, camera_arcs, loaded.preprocessor).frames(
                i, torch.arange(length).numpy()
            )
            z = policy.styles.embedding.weight[i].expand(length, -1)
            own.append(
                (policy.backbone.predict_action_chunk(frames, z)[:, 0] - frames["action"][:, 0]).square()
            )
    assert torch.allclose(torch.from_numpy(errors.squared["own"]), torch.cat(own), atol=1e-5)


def test_two_processes_train_one_policy(small_maze, tmp_path):
    """It runs to its end, and the checkpoint has every style."""
    flags = train_flags("zbc", small_maze, tmp_path / "run", 2, *nested("act"))
    assert "Effective batch size: 8 x 2 = 16" in train_in_two_processes(flags, tmp_path / "log")
    assert load(checkpoint(tmp_path / "run")).styles.trained.tolist() == [1] * 6
