"""Cards of policies and datasets, the folders that carry them, and loading what others made."""

import json

import pytest
from conftest import save_checkpoint
from huggingface_hub import DatasetCard, ModelCard

from lerobot_swr.checkpoint_files import check_files
from lerobot_swr.cli.share import main as share
from lerobot_swr.sharing.markdown import escaped, table
from lerobot_swr.sharing.measures import find_results, read_result
from lerobot_swr.sharing.pictures import groups_of

PNG = b"\x89PNG"


@pytest.fixture
def checkpoint(make_tiny_policy, small_maze_meta, tmp_path):
    """Folder of a saved zbc policy with a style of each of six demonstrations, four of them "10"."""
    return save_checkpoint(make_tiny_policy("zbc"), small_maze_meta, tmp_path / "pretrained_model")


@pytest.fixture
def results(tmp_path):
    """What an evaluation wrote: figures with and without an interval, conditions, a picture."""
    folder = tmp_path / "results"
    folder.mkdir()
    behaviors = {
        "n_episodes": 100,
        "l1": 0.25,
        "l1_interval": {"low": 0.125, "high": 0.375},
        "coverage": 1.0,
        "style_fidelity": None,
        "style_fidelity_interval": None,
        "episodes": [{"behavior": "10", "length": 3, "length_interval": [1, 2]}],
        "provenance": {"command": "lerobot-swr-eval --policy.path=x"},
    }
    cells = [{"perturbation": "noise 1", "success_rate": 0.5, "success_interval": [0.4, 0.6]}]
    errors = {"action_error": {"own": 0.1}, "action_error_interval": {"own": {"low": 0.05, "high": 0.2}}}
    for name, content in (("behaviors", behaviors), ("robustness", {"cells": cells}), ("offline", errors)):
        (folder / f"{name}.json").write_text(json.dumps(content))
    (folder / "behaviors.png").write_bytes(PNG)
    return folder


def test_a_saved_policy_has_a_card(checkpoint):
    """Behaviours with shares, the picture, flags to steer it, how to install, where it is from."""
    text = (checkpoint / "README.md").read_text()
    assert (checkpoint / "styles.png").read_bytes().startswith(PNG)
    for expected in (
        "6 styles of 6 demonstrations",
        "| 10 | 4 | 66.7% |",
        "| 20 | 2 | 33.3% |",
        "![The styles](styles.png)",
        """--policy.style_filter='behavior == "10"'""",
        "pip install lerobot_policy_swr",
        "local/small\\_maze",
        "| backbone | mlp |",
    ):
        assert expected in text
    assert ModelCard(text).data.to_dict()["library_name"] == "lerobot"


def test_the_flags_of_a_card_are_understood(checkpoint, small_maze, tmp_path, run_command):
    """Each of them, by the command that evaluates the checkpoint."""
    import shlex

    from lerobot_swr.cli.eval import main as evaluate

    lines = (checkpoint / "README.md").read_text().splitlines()
    flags = [shlex.split(line, comments=True) for line in lines if line.startswith("--policy.style_")]
    assert len(flags) == 4
    for number, given in enumerate(flags):
        run_command(
            evaluate,
            f"--policy.path={checkpoint}",
            *given,
            *("--env.type=maze2d", "--env.task=small", "--n_episodes=2", f"--dataset.root={small_maze}"),
            f"--output_dir={tmp_path / str(number)}",
        )
        used = json.loads((tmp_path / str(number) / "behaviors.json").read_text())["episodes"]
        assert all(episode["style_episode"] in range(6) for episode in used)


def test_the_command_makes_folder_and_card(checkpoint, results, tmp_path, run_command, capsys):
    """With the figures of all result files and their picture; what is loaded from it is the policy."""
    folder = tmp_path / "shared"
    run_command(share, checkpoint, f"--results={results}", "--repo_id=me/mine", f"--output_dir={folder}")
    text = (folder / "README.md").read_text()
    for expected in (
        "| L1 | 0.250 \\[0.125, 0.375\\] |",
        "| noise 1: success rate | 0.500 \\[0.400, 0.600\\] |",
        "| action error, own | 0.100 \\[0.050, 0.200\\] |",
        "100 rollouts",
        "![behaviors](behaviors.png)",
        "lerobot-swr-eval --policy.path=x",
        "--policy.path=me/mine",
    ):
        assert expected in text
    assert "coverage" not in text
    assert (folder / "model.safetensors").read_bytes() == (checkpoint / "model.safetensors").read_bytes()
    assert {path.suffix for path in folder.iterdir()} == {".md", ".json", ".safetensors", ".parquet", ".png"}
    assert f"hf upload me/mine {folder}" in capsys.readouterr().out


def test_a_dataset_is_shared(small_maze, tmp_path, run_command):
    """Behaviours with Wilson's intervals, features, picture; the original is left as it is."""
    folder = tmp_path / "shared"
    before = sorted(path.name for path in small_maze.rglob("*"))
    run_command(share, f"--dataset.root={small_maze}", "--repo_id=me/maze", f"--output_dir={folder}")
    text = (folder / "README.md").read_text()
    assert "| 10 | 4 | 66.7% \\[30.0%, 90.3%\\] |" in text
    assert "observation.state" in text
    assert (folder / "demonstrations.png").read_bytes().startswith(PNG)
    assert DatasetCard(text).data.to_dict()["task_categories"] == ["robotics"]
    assert (folder / "meta" / "info.json").read_bytes() == (small_maze / "meta" / "info.json").read_bytes()
    assert sorted(path.name for path in small_maze.rglob("*")) == before
    assert not (folder / "meta" / "info.json").samefile(small_maze / "meta" / "info.json")
    assert "license" not in DatasetCard(text).data.to_dict()
    again = tmp_path / "licensed"
    run_command(share, f"--dataset.root={small_maze}", f"--output_dir={again}", "--license=cc-by-4.0")
    assert DatasetCard((again / "README.md").read_text()).data.license == "cc-by-4.0"


@pytest.mark.parametrize("name", ["model.safetensors", "config.json", "styles.parquet"])
def test_a_damaged_file_is_told_by_name(checkpoint, tmp_path, run_command, capsys, name):
    """Cut in half, as by a broken download; nothing is written."""
    file = checkpoint / name
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(ValueError, match=name):
        check_files(checkpoint)
    with pytest.raises(SystemExit):
        run_command(share, checkpoint, f"--output_dir={tmp_path / 'shared'}")
    assert name in capsys.readouterr().err
    assert not (tmp_path / "shared").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--results=nowhere"], "results='nowhere'"),
        (["--dataset.root=data"], "name one thing to share"),
        (["--output_dir=."], "already exists"),
    ],
)
def test_bad_input_is_told_before_any_work(
    checkpoint, tmp_path, monkeypatch, run_command, capsys, flags, message
):
    """In one line."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        run_command(share, checkpoint, *flags)
    assert message in capsys.readouterr().err


def test_a_folder_is_replaced_only_when_asked(checkpoint, tmp_path, run_command):
    """And only one that has our card, and nothing of others."""
    folder = tmp_path / "shared"
    run_command(share, checkpoint, f"--output_dir={folder}")
    with pytest.raises(SystemExit):
        run_command(share, checkpoint, f"--output_dir={folder}")
    (folder / "old.png").touch()
    run_command(share, checkpoint, f"--output_dir={folder}", "--overwrite=true")
    assert not (folder / "old.png").exists()
    (folder / "thesis.txt").touch()
    with pytest.raises(SystemExit):
        run_command(share, checkpoint, f"--output_dir={folder}", "--overwrite=true")
    assert (folder / "thesis.txt").exists()
    project = tmp_path / "project"
    project.mkdir()
    (project / "README.md").write_text("# My project")
    with pytest.raises(SystemExit):
        run_command(share, checkpoint, f"--output_dir={project}", "--overwrite=true")
    assert (project / "README.md").read_text() == "# My project"


def test_figures_without_interval_are_left_out(results):
    """And those of single rollouts."""
    names = [measure.name for measure in read_result(results / "behaviors.json").measures]
    assert names == ["L1"]
    assert sum(len(one.measures) for one in find_results([results])) >= 2


def test_no_text_breaks_a_table():
    """Whatever labels and tasks hold stays in its cell, and is no markup."""
    [line] = table(("a",), [("x | <b>y</b>\n# z",)])[2:]
    assert line == "| x \\| &lt;b&gt;y&lt;/b&gt; \\# z |"
    assert escaped("`rm` [a](b)") == "\\`rm\\` \\[a\\](b)"


def test_numbers_are_grouped_by_tenths_of_their_range():
    """And rare labels into one group."""
    assert groups_of([0.0, 5.0, 10.0]) == ["0 to 1", "5 to 6", "9 to 10"]
    assert groups_of(["a"] * 2 + [f"{i}" for i in range(30)])[-1] == "others"
