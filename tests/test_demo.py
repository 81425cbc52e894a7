"""``lerobot-swr-demo``: what it shows, and that it ends with a report."""

from pathlib import Path

import pytest

from lerobot_swr.cli import demo
from lerobot_swr.cli.demo import DATASETS, DemoCommand


def test_it_shows_two_mazes_and_an_arm():
    """With MuJoCo everything; without it the mazes, and the way to the rest."""
    assert {env.type for env in DATASETS.values()} == {"maze2d", "d3il"}
    assert demo._datasets(DemoCommand(datasets=["medium_maze-one_side"])) == ["medium_maze-one_side"]


def test_without_the_simulator_the_arm_is_left_out(monkeypatch, capsys):
    """And named, with what to install; asked for, it is an error when it is made."""
    monkeypatch.setattr(demo, "unmet_requirements", lambda extra: ["mujoco==3.3.6"])
    assert demo._datasets(DemoCommand()) == ["medium_maze-one_side", "medium_maze-only_forward"]
    assert "d3il_avoiding (needs mujoco==3.3.6: pip install" in capsys.readouterr().out


def test_an_unknown_dataset_is_told_before_any_work(tmp_path, run_command, capsys):
    """With those that there are."""
    with pytest.raises(SystemExit):
        run_command(demo.main, "--datasets=[maze]", f"--output_dir={tmp_path / 'demo'}")
    assert "datasets=['maze']" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
def test_the_demo_ends_with_a_report(tmp_path, run_command, capsys):
    """Three trainings of a few steps; a second call finds them and trains nothing."""
    flags = [
        *("--datasets=[medium_maze-one_side]", "--bc_steps=20", "--zbc_steps=20", "--wzbc_steps=20"),
        *("--n_episodes=4", f"--output_dir={tmp_path}"),
    ]
    run_command(demo.main, *flags)
    report = Path(tmp_path / "report.html").read_text()
    assert all(f"--policy.type={policy}" in report for policy in ("bc", "zbc", "wzbc"))
    assert report.count("<img") == 4
    weights = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("model.safetensors")}
    assert len(weights) == 3
    run_command(demo.main, *flags)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("model.safetensors")} == weights
