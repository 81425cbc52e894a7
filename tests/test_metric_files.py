"""Values of episodes that other programs wrote become columns of the table."""

import json
from pathlib import Path

import pytest

from lerobot_swr.styles.metric_files import read_metric_file, read_metric_files

RECORDS = [{"episode_index": 1, "quality": 0.5}, {"episode_index": 0, "quality": 0.9}]


@pytest.mark.parametrize(
    "content",
    [
        RECORDS,
        {"version": 1, "episodes": RECORDS},
        {"quality": [0.9, 0.5]},
        {"0": {"quality": 0.9}, "1": {"quality": 0.5}},
        {"summary": {"mean": 0.7}, "per_episode": {"0": {"quality": 0.9}, "1": {"quality": 0.5}}},
        {"quality": {"0": 0.9, "1": 0.5}},
        [{"quality": 0.9}, {"quality": 0.5}],
        [{"episode_id": f"episode_00000{i}", "quality": value} for i, value in enumerate([0.9, 0.5])],
    ],
)
def test_shapes_of_json(tmp_path: Path, content):
    """Lists of records, objects by episode and columns all mean the same."""
    file = tmp_path / "report.json"
    file.write_text(json.dumps(content))
    assert read_metric_file(file, 2) == {"quality": [0.9, 0.5]}


def test_csv(tmp_path: Path):
    """A row is a record; numbers, truth values and text keep their kinds."""
    file = tmp_path / "report.csv"
    file.write_text("episode,quality,good,operator\n1,0.5,false,Ann\n0,0.9,True,Bob\n")
    assert read_metric_file(file, 2) == {
        "quality": [0.9, 0.5],
        "good": [True, False],
        "operator": ["Bob", "Ann"],
    }


def test_several_records_of_an_episode_are_averaged(tmp_path: Path):
    """One record a camera gives one value an episode; text that differs is left out."""
    file = tmp_path / "report.json"
    records = [
        {"episode_id": i, "camera": camera, "aggregate_score": score, "per_attribute": {"blur level": score}}
        for i, camera, score in [(0, "a", 0.2), (0, "b", 0.4), (1, "a", 0.6)]
    ]
    file.write_text(json.dumps(records))
    columns = read_metric_file(file, 2)
    assert columns["aggregate_score"] == pytest.approx([0.3, 0.6])
    assert columns["per_attribute_blur_level"] == pytest.approx([0.3, 0.6])
    assert "camera" not in columns


def test_several_files_and_functions(tmp_path: Path):
    """Functions beside files are left to others."""
    for name in "ab":
        (tmp_path / f"{name}.json").write_text(json.dumps({name: [1, 2]}))
    paths = f"{tmp_path}/a.json, my_module:metric ,{tmp_path}/b.json"
    assert read_metric_files(paths, 2) == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('[{"episode_index": 5, "quality": 1}]', r"episodes \[5\]; the dataset has episodes 0 to 1"),
        ('[{"episode_index": 0, "quality": 1}]', "no column with a value of each of the 2 episodes"),
        ("{", "cannot be read"),
        ('[{"episode_index": "first", "quality": 1}]', "'first' is no episode number"),
    ],
)
def test_what_is_wrong_is_told(tmp_path: Path, content: str, message: str):
    """The file and what is wrong with it are named."""
    file = tmp_path / "report.json"
    file.write_text(content)
    with pytest.raises(ValueError, match=message):
        read_metric_file(file, 2)


def test_an_absent_file_is_named(tmp_path: Path):
    """A file that is not there is named."""
    with pytest.raises(FileNotFoundError, match=r"nothing\.json"):
        read_metric_file(tmp_path / "nothing.json", 2)
