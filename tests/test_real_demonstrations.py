"""A real dataset (100 teleoperated episodes, 26 dimensions): training, styles and offline evaluation."""

import json
import os
from pathlib import Path

import pytest
from conftest import train_flags

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.cli import train as train_command

REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", Path(__file__).parents[2] / "shared"))
DATASET = REFERENCE / "real_demos" / "unitree_g1_100"

pytestmark = pytest.mark.skipif(
    not (DATASET / "meta" / "info.json").is_file(),
    reason=f"{DATASET} is absent: point LEROBOT_SWR_REFERENCE at the folder that holds real_demos",
)


def offline_errors(run_command, checkpoint: Path, output_dir: Path) -> dict[str, float]:
    """Mean squared error of normalised actions by kind of style."""
    flags = [f"--policy.path={checkpoint}", f"--dataset.root={DATASET}", f"--output_dir={output_dir}"]
    run_command(eval_command.main, *flags)
    return json.loads((output_dir / "offline.json").read_text())["action_error"]


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_a_few_steps_on_real_data_tell_styles_apart(run_command, tmp_path, policy_type):
    """After a few hundred steps an episode is explained better by its own style than by a random one."""
    flags = train_flags(
        policy_type, DATASET, tmp_path / "run", 300, "--policy.backbone.num_hidden=3", "--jobs=1"
    )
    run_command(train_command.main, *flags, "--seeds=0", "--policy.style_lr_scale=20")
    checkpoint = tmp_path / "run/seed_0/checkpoints/last/pretrained_model"
    errors = offline_errors(run_command, checkpoint, tmp_path / "eval")
    assert errors["own"] < errors["random"] < 1


@pytest.mark.slow
def test_styles_explain_real_demonstrations_better_than_none(run_command, tmp_path):
    """5,000 steps, batch 64: own style below random style and below BC, for ZBC and WZBC."""
    errors = {}
    for policy_type in ("bc", "zbc", "wzbc"):
        output_dir = tmp_path / policy_type
        flags = train_flags(policy_type, DATASET, output_dir, 5000, "--seeds=0", "--jobs=1")
        run_command(train_command.main, *[f for f in flags if "batch_size" not in f], "--batch_size=64")
        checkpoint = output_dir / "seed_0/checkpoints/last/pretrained_model"
        errors[policy_type] = offline_errors(run_command, checkpoint, tmp_path / f"eval_{policy_type}")
    for policy_type in ("zbc", "wzbc"):
        assert errors[policy_type]["own"] < errors[policy_type]["random"]
        assert errors[policy_type]["own"] < errors["bc"]["none"]
