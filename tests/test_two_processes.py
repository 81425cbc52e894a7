"""Styled policies train on two processes and end cleanly."""

import subprocess
import sys

import pytest
from conftest import train_flags
from lerobot.configs import PreTrainedConfig

from lerobot_swr.evaluation.checkpoint import load_checkpoint


@pytest.mark.slow
@pytest.mark.parametrize("num_workers", [0, 2])
def test_torchrun_with_two_processes_ends(small_maze, tmp_path, num_workers):
    """Both processes end by themselves, with status 0, and leave one whole checkpoint, card included."""
    flags = train_flags("wzbc", small_maze, tmp_path / "run", 20, "--policy.backbone.hidden_dim=16")
    flags = [flag for flag in flags if not flag.startswith("--num_workers")]
    script = tmp_path / "train.py"
    script.write_text("from lerobot.scripts.lerobot_train import main\n\nmain()\n")
    launch = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2")
    command = [*launch, str(script), *flags, f"--num_workers={num_workers}"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr[-3000:]
    checkpoint = tmp_path / "run" / "checkpoints" / "000020" / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    assert load_checkpoint(config).policy.styles.trained.sum() == 6
    assert (checkpoint / "README.md").is_file()
