"""How well the policies reproduce behaviours after training at full length (an hour: ``make slow``)."""

import json
import sys
from pathlib import Path

import pytest
from conftest import train_flags
from lerobot.scripts import lerobot_train

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.cli import train as train_command
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset

pytestmark = pytest.mark.slow


def stratified_result(monkeypatch, tmp_path: Path, policy_type: str, dataset: str, steps: int) -> dict:
    """Train on one of the maze datasets as its recipe does, and evaluate with each style once."""
    root, output_dir = tmp_path / "data", tmp_path / "run"
    write_dataset(get_recipe(f"medium_maze-{dataset}"), root, seed=0)
    flags = train_flags(policy_type, root, output_dir, steps, "--batch_size=16", f"--save_freq={steps}")
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *flags])
    lerobot_train.main()
    policy = output_dir / "checkpoints" / "last" / "pretrained_model"
    more = ["--env.type=maze2d", "--env.task=medium", "--style_sampling=stratified", "--n_episodes=100"]
    flags = [f"--policy.path={policy}", f"--dataset.root={root}", f"--output_dir={tmp_path / 'eval'}", *more]
    monkeypatch.setattr(sys, "argv", ["lerobot-swr-eval", *flags])
    eval_command.main()
    return json.loads((tmp_path / "eval" / "behaviors.json").read_text())


@pytest.mark.parametrize(
    ("policy_type", "dataset", "steps", "l1", "success"),
    [
        ("zbc", "only_forward", 20_000, 0.08, 0.97),
        ("wzbc", "only_forward", 50_000, 0.10, 0.95),
        ("zbc", "one_side", 20_000, 0.04, 0.98),
        ("wzbc", "one_side", 20_000, 0.04, 0.98),
    ],
)
def test_style_policies_reproduce_the_demonstrated_behaviours(
    monkeypatch, tmp_path, policy_type, dataset, steps, l1, success
):
    """Each style once: the histogram of the demonstrations, and the goal reached."""
    result = stratified_result(monkeypatch, tmp_path, policy_type, dataset, steps)
    assert result["l1"] <= l1
    assert result["success_rate"] >= success


def test_behaviour_cloning_shows_one_side_at_most(monkeypatch, tmp_path):
    """A deterministic policy without styles can not show both of two balanced behaviours."""
    assert stratified_result(monkeypatch, tmp_path, "bc", "one_side", 20_000)["l1"] >= 1


@pytest.mark.parametrize(
    ("policy_type", "rate", "steps"),
    [("ddpm_gpt", "2e-3", 15_000), ("beso", "2e-3", 12_000), ("ddpm_act", "1e-3", 12_000)],
)
def test_diffusion_policies_show_both_sides(run_command, tmp_path, policy_type, rate, steps):
    """Without styles, by the draw of their noise alone; seven minutes of training each."""
    root, output_dir = tmp_path / "data", tmp_path / "run"
    write_dataset(get_recipe("medium_maze-one_side"), root, seed=0)
    network = ("--policy.attention_dropout=0", "--policy.residual_dropout=0", "--policy.lr_schedule=cosine")
    sizes = ("--batch_size=64", f"--save_freq={steps}", "--seeds=1000", f"--policy.optimizer_lr={rate}")
    run_command(train_command.main, *train_flags(policy_type, root, output_dir, steps, *network, *sizes))
    policy = output_dir / "seed_1000" / "checkpoints" / "last" / "pretrained_model"
    run_command(
        eval_command.main,
        *(f"--policy.path={policy}", f"--dataset.root={root}", f"--output_dir={tmp_path / 'eval'}"),
        *("--env.type=maze2d", "--env.task=medium", "--n_episodes=100"),
    )
    result = json.loads((tmp_path / "eval" / "behaviors.json").read_text())
    assert result["success_rate"] >= 0.95
    assert result["coverage"] == 1
