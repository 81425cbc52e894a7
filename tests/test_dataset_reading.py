"""Datasets of other origin: what LeRobot reads trains, what cannot be used is told in one line."""

import logging

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from odd_datasets import (
    ACTION,
    LENGTHS,
    PLAIN,
    STATE,
    arc,
    arcs,
    data_file,
    edit_json,
    feature,
    metadata,
    set_column,
    split_into_files,
    write,
)

from lerobot_swr.frame_rows import FrameRows
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.run_context import running
from lerobot_swr.trajectories import load_trajectories

KEYS = [STATE, ACTION]


def make(root, policy_type="zbc", **options):
    """A small policy on a dataset."""
    config = make_policy_config(
        policy_type, backbone=MLPConfig(8, 1), device="cpu", push_to_hub=False, **options
    )
    return make_policy(config, ds_meta=metadata(root))


def assert_arcs(root):
    """Our reader and LeRobot's give the written numbers, episode by episode."""
    trajectories = load_trajectories(metadata(root), KEYS)
    dataset = LeRobotDataset("local/odd", root=root)
    assert trajectories.lengths.tolist() == list(LENGTHS)
    read = [dataset[row] for row in range(sum(LENGTHS))]
    for i, n in enumerate(LENGTHS):
        frames = [item for item in read if item["episode_index"] == i]
        for key in KEYS:
            written = np.stack([arcs(i, t, n)[key] for t in range(n)])
            np.testing.assert_array_equal(trajectories.episode(i)[key], written)
            np.testing.assert_array_equal(np.stack([item[key] for item in frames]), written)


@pytest.mark.parametrize("kind", [pa.list_, pa.large_list, lambda t: pa.list_(t, 2)])
@pytest.mark.parametrize("number", [pa.float32(), pa.float64()])
def test_every_type_of_list_is_read(copied_arcs, kind, number):
    """Lists of fixed and of any length, in either precision: cast to what meta/info.json states."""
    values = pq.read_table(data_file(copied_arcs)).column(STATE).to_pylist()
    set_column(copied_arcs, STATE, values, kind(number))
    assert_arcs(copied_arcs)


def test_an_index_that_restarts_does_not_matter(copied_arcs):
    """As in a home-made merge; LeRobot counts rows."""
    rows = np.r_[np.arange(14), np.arange(22)]
    set_column(copied_arcs, "index", rows, pa.int64())
    assert_arcs(copied_arcs)
    make(copied_arcs)


@pytest.mark.parametrize("first_in_file", [[0, 2], [2, 0], [1, 0, 3]])
def test_several_files_in_any_order_are_read_by_their_episodes(copied_arcs, first_in_file):
    """Also where a later episode lies in an earlier file."""
    split_into_files(copied_arcs, first_in_file)
    assert_arcs(copied_arcs)
    make(copied_arcs)


@pytest.mark.parametrize("name", ["file-001", "file-000 (copy)", "file-000_old"])
def test_stray_copies_of_data_files_are_ignored(copied_arcs, name):
    """What the metadata do not list and LeRobot's numbers of frames do not lead to."""
    data_file(copied_arcs).with_name(f"{name}.parquet").write_bytes(data_file(copied_arcs).read_bytes())
    assert load_trajectories(metadata(copied_arcs), KEYS).lengths.tolist() == list(LENGTHS)
    make(copied_arcs)


@pytest.mark.parametrize("episodes", [None, [0, 1]])
def test_a_stray_file_that_lerobot_would_train_on_is_refused(copied_arcs, episodes):
    """It comes before the real one with other numbers, or holds episodes that are asked for by number."""
    table = pq.read_table(data_file(copied_arcs))
    shifted = pa.array(
        [[x + 1, y] for x, y in table.column(STATE).to_pylist()], table.schema.field(STATE).type
    )
    place = table.schema.get_field_index(STATE)
    name = "file-000 (copy)" if episodes is None else "file-000_old"
    pq.write_table(
        table.set_column(place, STATE, shifted), data_file(copied_arcs).with_name(f"{name}.parquet")
    )
    refused = pytest.raises(ValueError, match=r"data/chunk-000/file-000.*move it out of the data folder")
    with running(DatasetConfig("local/odd", episodes=episodes)), refused:
        make(copied_arcs)
    if episodes is not None:
        make(copied_arcs)  # all episodes: LeRobot does not come to it


def test_frame_numbers_of_the_metadata_that_restart_are_refused(copied_arcs):
    """LeRobot would train on the first half twice, and on the second never."""
    path = copied_arcs / "meta/episodes/chunk-000/file-000.parquet"
    table = pd.read_parquet(path)
    table.loc[2:, ["dataset_from_index", "dataset_to_index"]] -= 14
    table.to_parquet(path)
    with pytest.raises(ValueError, match=r"episode 2 begins at frame 0 \(dataset_from_index\) instead of 14"):
        make(copied_arcs)


def test_chosen_episodes_that_lerobot_would_not_find_are_refused(copied_arcs):
    """For them it needs the column index, which restarts here."""
    set_column(copied_arcs, "index", np.r_[np.arange(14), np.arange(22)], pa.int64())
    refused = pytest.raises(ValueError, match=r"index of episode 3 does not run from 24 to 35")
    with running(DatasetConfig("local/odd", episodes=[3])), refused:
        make(copied_arcs)


@pytest.mark.parametrize("within", [True, False])
def test_a_null_is_told_with_feature_file_episode_and_frame(copied_arcs, within):
    """A frame without a value, or with a number missing in it."""
    values = pq.read_table(data_file(copied_arcs)).column(ACTION).to_pylist()
    values[17] = [0.0, None] if within else None
    set_column(copied_arcs, ACTION, values, pa.list_(pa.float32()))
    with pytest.raises(
        ValueError, match=r"'action' is NaN or null .*data/chunk-000/file-000.parquet.*episode 2, frame 3;"
    ):
        make(copied_arcs)


def test_data_that_do_not_fit_the_metadata_are_told(copied_arcs):
    """With feature, file and both types."""
    values = [[*pair, 0.0] for pair in pq.read_table(data_file(copied_arcs)).column(STATE).to_pylist()]
    set_column(copied_arcs, STATE, values, pa.list_(pa.float32()))
    with pytest.raises(ValueError, match=r"'observation.state': .*file-000.parquet holds list.*shape \(2,\)"):
        make(copied_arcs)


@pytest.mark.parametrize("damage", ["missing file", "cut file", "fewer frames"])
def test_an_incomplete_dataset_is_told_with_file_and_episode(copied_arcs, damage):
    """Before any training, whichever part is missing."""
    split_into_files(copied_arcs, [0, 2])
    file = data_file(copied_arcs, 1)
    if damage == "missing file":
        file.unlink()
    elif damage == "cut file":
        file.write_bytes(file.read_bytes()[:300])
    else:
        pq.write_table(pq.read_table(file).slice(2), file)
    expected = {
        "missing file": r"data/chunk-000/file-001.parquet, which holds episodes 2 to 3, is missing",
        "cut file": r"file-001.parquet: damaged",
        "fewer frames": r"promises 10 frames of episode 2, .* hold 8 .*file-001.parquet",
    }
    with pytest.raises((ValueError, FileNotFoundError), match=expected[damage]):
        make(copied_arcs)


@pytest.mark.parametrize(
    ("reason", "values"),
    [
        ("is NaN or infinite in 4 frames, first in episode 0, frame 5, and in 3 more", "nan"),
        ("is not numeric", "text"),
        ("is missing in data/chunk-000/file-001.parquet", "one file"),
    ],
)
def test_a_bad_reward_is_left_out_of_the_table_and_nothing_else(tmp_path, caplog, reason, values):
    """With a warning that says why; training goes on, and the other columns are there."""
    kind = feature(1, dtype="string" if values == "text" else "float32")

    def frame(i, t, n):
        reward = np.array([np.nan if values == "nan" and t == n - 1 else 0.5], np.float32)
        reached = np.array([i > 1 and t == n - 1])
        return {
            **arcs(i, t, n),
            "next.reward": "good" if values == "text" else reward,
            "next.success": reached,
        }

    root = write(
        tmp_path / "data", {**PLAIN, "next.reward": kind, "next.success": feature(1, dtype="bool")}, frame
    )
    if values == "one file":
        split_into_files(root, [0, 2])
        pq.write_table(pq.read_table(data_file(root, 1)).drop_columns("next.reward"), data_file(root, 1))
    with caplog.at_level(logging.WARNING):
        table = make(root).styles.table
    assert "return" not in table.columns
    assert table.columns["success"] == [False, False, True, True]
    assert reason in caplog.text


def test_an_unused_observation_may_hold_anything(tmp_path):
    """NaN in an observation that policy.input_features leaves out; among the inputs it is refused."""
    features = {**PLAIN, "observation.force": feature(1)}
    root = write(
        tmp_path / "data",
        features,
        lambda i, t, n: {**arcs(i, t, n), "observation.force": np.array([np.nan], np.float32)},
    )
    make(root, input_features={STATE: PolicyFeature(FeatureType.STATE, (2,))})
    with pytest.raises(
        ValueError, match=r"'observation.force' is NaN or infinite .*--operation.episode_indic"
    ):
        make(root)


def test_whole_numbers_that_32_bits_cannot_hold_are_refused(tmp_path):
    """A clock in nanoseconds as an observation: float32 knows it to a minute."""
    features = {**PLAIN, "observation.clock": feature(1, dtype="int64")}
    root = write(
        tmp_path / "data",
        features,
        lambda i, t, n: {**arcs(i, t, n), "observation.clock": np.array([17 * 10**17 + 10**8 * t])},
    )
    with pytest.raises(ValueError, match=r"dimension 0 of feature 'observation.clock' changes by 1.1e\+09"):
        make(root)


def set_tasks(root, values):
    """Replace the task names in the table of episodes; None drops the column."""
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    place = table.schema.get_field_index("tasks")
    table = (
        table.remove_column(place) if values is None else table.set_column(place, "tasks", pa.array(values))
    )
    pq.write_table(table, path)


@pytest.mark.parametrize(
    ("listed", "expected"),
    [
        (None, ["reach"] * 4),
        ([None, [], ["push", "pull"], ["push"]], ["reach", "reach", "push; pull", "push"]),
        (["push", "push", "pull", ""], ["push", "push", "pull", "reach"]),
    ],
)
def test_tasks_are_found_in_whatever_form(copied_arcs, listed, expected):
    """Lists, plain strings, gaps or no column at all; gaps are filled from the frames' task numbers."""
    set_tasks(copied_arcs, listed)
    assert make(copied_arcs).styles.table.columns["task"] == expected


def test_a_dataset_without_tasks_has_no_column_for_them(copied_arcs):
    """Neither in the table of episodes nor in that of tasks."""
    set_tasks(copied_arcs, [None] * 3 + [[""]])
    (copied_arcs / "meta/tasks.parquet").unlink()
    edit_json(copied_arcs / "meta/info.json", lambda info: info.update(total_tasks=0))
    assert "task" not in make(copied_arcs).styles.table.columns


def test_tasks_in_a_plain_column_are_found(copied_arcs):
    """A tasks.parquet whose names are a column rather than the index."""
    set_tasks(copied_arcs, None)
    pd.DataFrame({"task_index": [0], "task": ["reach"]}).to_parquet(copied_arcs / "meta/tasks.parquet")
    assert make(copied_arcs).styles.table.columns["task"] == ["reach"] * 4


def test_episodes_of_a_single_frame_train(tmp_path):
    """They have no path, and a style all the same."""
    root = write(tmp_path / "data", lengths=(1, 5, 1, 6))
    table = make(root, "wzbc").styles.table
    assert table.columns["length"] == [1, 5, 1, 6]
    assert table.columns["path_length"][0] == table.columns["mean_speed"][0] == 0
    np.testing.assert_allclose(table.columns["first_0"], [arc(i, 0, 6)[0] for i in range(4)])


@pytest.mark.parametrize("numbers", ["as written", "restarting"])
def test_a_batchs_frames_are_found_again(copied_arcs, numbers):
    """By episode and index, whatever the order of the files and the timestamps."""
    split_into_files(copied_arcs, [1, 0, 3])
    if numbers == "restarting":
        for file in range(3):
            table = pq.read_table(data_file(copied_arcs, file))
            place = table.schema.get_field_index("index")
            pq.write_table(
                table.set_column(place, "index", pa.array(np.arange(len(table)))),
                data_file(copied_arcs, file),
            )
    trajectories = load_trajectories(metadata(copied_arcs), [STATE])
    batch = torch.utils.data.default_collate(
        [LeRobotDataset("local/odd", root=copied_arcs)[i] for i in (30, 2, 17)]
    )
    rows = FrameRows(trajectories)(batch)
    np.testing.assert_array_equal(trajectories.columns[STATE][rows], batch[STATE])
    owner = np.repeat(np.arange(4), trajectories.lengths)
    np.testing.assert_array_equal(owner[rows], batch["episode_index"])
