"""``lerobot-swr-behaviors``: its files, and its rule wherever a rule is taken."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets import LeRobotDatasetMetadata
from sklearn.metrics import adjusted_rand_score

from lerobot_swr.behavior_rules import load_behavior_rule
from lerobot_swr.cli import behaviors
from lerobot_swr.cli import eval as eval_command
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.discovery.rule import read_rule_file
from lerobot_swr.envs.maze2d.behavior import small
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.trajectories import Trajectories, load_trajectories

STATE = "observation.state"


@pytest.fixture(scope="module")
def maze(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small maze's dataset with 12 episodes of one behaviour and 8 of the other."""
    root = tmp_path_factory.mktemp("datasets") / "two_ways"
    write_dataset(_recipe("two_ways", "small", {"10": 12, "20": 8}, steady), root, seed=0)
    return root


@pytest.fixture(scope="module")
def meta(maze: Path) -> LeRobotDatasetMetadata:
    """Its metadata."""
    return LeRobotDatasetMetadata("local/two_ways", root=maze)


@pytest.fixture
def folder(run_command, maze: Path, tmp_path: Path) -> Path:
    """What the command writes about it."""
    run_command(
        behaviors.main,
        f"--dataset.root={maze}",
        f"--output_dir={tmp_path / 'found'}",
        "--names=[from the left, from the right]",
    )
    return tmp_path / "found"


def by_hand(meta: LeRobotDatasetMetadata) -> tuple[Trajectories, list[str]]:
    """The episodes, and their labels by the maze's own rule."""
    trajectories = load_trajectories(meta, [STATE])
    return trajectories, [small(episode) for episode in trajectories.episodes()]


def test_the_file_holds_what_was_found(folder: Path, meta):
    """Labels, names and typical episodes agree with the maze's own rule."""
    data = json.loads((folder / "behaviors.json").read_text())
    _, labels = by_hand(meta)
    assert data["names"] == ["from the left", "from the right"]
    assert len(data["labels"]) == len(labels)
    assert adjusted_rand_score(labels, data["labels"]) == 1
    assert data["labels"].count("from the left") == 12
    assert [data["labels"][episode] for episode in data["medoids"]] == data["names"]


def test_the_rule_labels_known_and_new_episodes(folder: Path, meta):
    """Known episodes get their labels, new ones in other positions and at another pace the right ones."""
    data, rule = read_rule_file(folder / "behaviors.json"), load_behavior_rule(str(folder / "behaviors.json"))
    trajectories, labels = by_hand(meta)
    assert [rule(episode) for episode in trajectories.episodes()] == data["labels"]
    name = dict(zip(labels, data["labels"], strict=True))
    recipe = _recipe("new", "small", {"10": 5, "20": 5}, steady)
    for demonstration in recipe.demonstrations(7):
        observations = {STATE: demonstration.observations[STATE][::2]}
        assert rule(observations) == name[small(demonstration.observations)]
    assert rule({STATE: trajectories.episode(0)[STATE][:8]}) == "outlier"
    with pytest.raises(ValueError, match=r"this episode has no observation\.state"):
        rule({"observation.environment_state": np.zeros((5, 2))})


def test_names_that_are_changed_in_the_file_hold(folder: Path, meta):
    """The report saves the file with other names; equal names make one behaviour."""
    file = folder / "behaviors.json"
    data = json.loads(file.read_text())
    file.write_text(json.dumps({**data, "names": ["same", "same"]}))
    rule = load_behavior_rule(str(file))
    trajectories = load_trajectories(meta, [STATE, "observation.environment_state"])
    assert {rule(episode) for episode in trajectories.episodes()} == {"same"}


def test_the_report_opens_offline(folder: Path):
    """It holds names and paths, asks for nothing from elsewhere, and has the data to save."""
    page = (folder / "report.html").read_text()
    assert "from the left" in page
    assert not re.search(r"""(src|href)=["']https?:""", page)
    data = json.loads(re.search(r"const data = (.*);\n", page)[1])
    assert data["rule"] == json.loads((folder / "behaviors.json").read_text())
    assert all(len(behaviour["episodes"]) for behaviour in data["behaviours"])


def test_a_table_is_filtered_by_the_names(run_command, folder: Path, meta, tmp_path: Path):
    """Style tables take the file as a rule, and values of episodes from another program's report."""
    from lerobot_swr.similarity import similarity_of
    from lerobot_swr.styles.table import make_nearest_table

    trajectories = load_trajectories(meta, [STATE, "observation.environment_state"])
    report = tmp_path / "report.json"
    quality = np.linspace(0, 1, len(trajectories))
    report.write_text(json.dumps([{"episode_index": i, "quality": q} for i, q in enumerate(quality)]))
    similarity = similarity_of(trajectories, [STATE], tmp_path)
    rule = str(folder / "behaviors.json")
    table = make_nearest_table(trajectories, similarity, rule, str(report), meta.robot_type)
    kept = table.matches("quality > .5 and behavior == 'from the left'")
    labels = np.array(json.loads(Path(rule).read_text())["labels"])
    assert np.array_equal(kept, (quality > 0.5) & (labels == "from the left"))
    assert kept.any()


def test_evaluations_take_the_file(run_command, folder: Path, maze: Path, meta, tmp_path: Path):
    """Playback of the demonstrations shows the behaviours that were found, in their shares."""
    run_command(
        eval_command.main,
        "--baseline=playback",
        "--env.type=maze2d",
        "--env.task=small",
        f"--dataset.root={maze}",
        f"--behavior_rule={folder / 'behaviors.json'}",
        "--n_episodes=20",
        "--style_sampling=stratified",
        f"--output_dir={tmp_path / 'eval'}",
    )
    result = json.loads((tmp_path / "eval" / "behaviors.json").read_text())
    assert result["reference_histogram"] == {"from the left": 0.6, "from the right": 0.4}
    assert result["style_fidelity"] > 0.9
    assert result["l1"] < 0.2
    assert result["l1_floor"] == 0


def test_results_do_not_replace_the_rule(run_command, folder: Path, maze: Path, capsys):
    """An evaluation into the rule's folder is refused: its results have the same name."""
    before = (folder / "behaviors.json").read_bytes()
    with pytest.raises(SystemExit):
        run_command(
            eval_command.main,
            "--baseline=playback",
            "--env.type=maze2d",
            "--env.task=small",
            f"--dataset.root={maze}",
            f"--behavior_rule={folder / 'behaviors.json'}",
            f"--output_dir={folder}",
        )
    assert "would replace" in capsys.readouterr().err
    assert (folder / "behaviors.json").read_bytes() == before


def test_behaviours_of_one_name_are_one_row(maze: Path, tmp_path: Path, run_command, capsys):
    """Equal names are counted together; parts of one cloud are told, and what was compared."""
    run_command(
        behaviors.main,
        f"--dataset.root={maze}",
        f"--output_dir={tmp_path}",
        "--num_behaviors=3",
        "--names=[a, a, b]",
        "--frames=0",
    )
    printed = capsys.readouterr().out
    assert "2 behaviours in 20 episodes" in printed
    assert "Compared by the path of observation.state, at an even pace" in printed
    rows = [line.split()[:2] for line in printed.splitlines() if re.match(r"  [ab] ", line)]
    assert [name for name, _ in rows] == ["a", "b"]
    assert sum(int(count) for _, count in rows) == 20


def test_labels_of_other_rules_are_no_checkpoints():
    """What a maze expects of a start leaves names that are not its own alone."""
    task = Maze2DEnvConfig(task="medium")
    observations = {STATE: np.array([[0.5, 0.6]])}
    assert task.expected_behavior("6410", observations) == "10"
    assert task.expected_behavior("behavior 1", observations) == "behavior 1"


def test_outliers_can_be_deleted_and_labels_written(run_command, maze: Path, tmp_path: Path, capsys):
    """The command for LeRobot names the outliers; the copy has a column with the behaviours' numbers."""
    out = tmp_path / "out"
    run_command(
        behaviors.main,
        f"--dataset.root={maze}",
        f"--output_dir={out}",
        "--delete_command=true",
        f"--label_column={tmp_path / 'copy'}",
        "--frames=0",
    )
    data = json.loads((out / "behaviors.json").read_text())
    expected = [int(i) for i in data["outliers"]]
    text = (out / "delete_outliers.txt").read_text()
    listed = re.search(r'--operation.episode_indices="\[(.*)\]"', text)
    assert (json.loads(f"[{listed[1]}]") if listed else []) == expected
    copy = load_trajectories(LeRobotDatasetMetadata("local/copy", root=tmp_path / "copy"), ["behavior"])
    names = [*data["names"], "outlier"]
    assert [names[int(episode["behavior"][0, 0])] for episode in copy.episodes()] == data["labels"]


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--num_behaviors=0", "num_behaviors=0: expected at least 1"),
        ("--features=nowhere:function", "features='nowhere:function'"),
        ("--keys=[observation.nothing]", "no feature 'observation.nothing'"),
        ("--dataset.episodes=[1]", "dataset.episodes=[1]: behaviours are found among all episodes"),
        ("--names=[one]", "1 names for 2 behaviours"),
    ],
)
def test_mistakes_are_told(run_command, maze: Path, tmp_path: Path, capsys, flag: str, message: str):
    """The key, its value and the fix are named."""
    with pytest.raises(SystemExit):
        run_command(behaviors.main, f"--dataset.root={maze}", f"--output_dir={tmp_path / 'out'}", flag)
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "does not exist"), ("{", "is no JSON"), ('{"histogram": {}}', "was not written by")],
)
def test_other_files_are_no_rules(tmp_path: Path, content: str | None, message: str):
    """A file that is absent, damaged or an evaluation's result is told apart."""
    file = tmp_path / "behaviors.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        load_behavior_rule(str(file))
