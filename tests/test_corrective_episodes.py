"""Episodes that are left out of a training: which they are; corrective labels learn nothing of them."""

import json

import numpy as np
import pytest
import torch
import yaml
from corrective_policies import ACTION, STATE, batch_of, make
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies.factory import make_policy_config

from lerobot_swr.configuration import training_episodes, training_on
from lerobot_swr.corrective.inverse_model import fit_inverse_model


@pytest.mark.parametrize(("way", "balanced"), [("flag", True), ("file", False)])
def test_episodes_left_out_shape_nothing(small_maze, tmp_path, monkeypatch, way, balanced):
    """J, R², ranges and limits are those of a dataset that never had the other episodes."""
    chosen = [0, 2, 3, 5]
    if way == "flag":
        argv = ["lerobot-train", f"--dataset.episodes={chosen}"]
    else:
        file = tmp_path / "train_config.json"
        file.write_text(json.dumps({"dataset": {"episodes": chosen}}))
        argv = ["lerobot-train", f"--config_path={file}"]
    monkeypatch.setattr("sys.argv", argv)
    policy, _ = make(small_maze, corrective="demos", balance_episodes=balanced)
    subset = policy.trajectories.subset(chosen)
    model = fit_inverse_model(subset)
    assert policy.config.inverse_r2 == pytest.approx(model.r2, abs=1e-4)
    feedback = policy.corrections.labels.feedback
    np.testing.assert_array_equal(feedback.paths.range, np.ptp(subset.columns[STATE], axis=0))
    np.testing.assert_allclose(feedback.limits, np.abs(subset.columns[ACTION]).max(axis=0))
    # Styles keep their episodes' numbers, also if a checkpoint was trained on others before.
    policy.styles.trained.fill_(1)
    drawn = policy.draw(batch_of(policy, policy._dataset_meta, torch.zeros(400, dtype=torch.int64)))
    styles = drawn["style_episode"][drawn["corrective"]]
    assert set(styles.tolist()) == set(chosen)
    torch.testing.assert_close(drawn["weight"][drawn["corrective"]], policy.frame_weights(styles))


def test_held_out_episodes_lend_no_states(small_maze):
    """Only episodes that were trained on become partners, and their states are the only ones that appear."""
    policy, meta = make(small_maze, corrective="demos")
    episodes = np.repeat(np.arange(6), policy.trajectories.lengths)
    rows = torch.from_numpy(np.flatnonzero(np.isin(episodes, (0, 2, 3))))
    policy.draw(batch_of(policy, meta, rows))
    batch = batch_of(policy, meta, rows[torch.randint(len(rows), (800,))])
    drawn = policy.draw(batch)
    everything = batch_of(policy, meta, torch.arange(len(episodes)))[STATE]
    distances = torch.cdist(drawn[STATE][drawn["corrective"]].double(), everything.double())
    lent = distances.amin(dim=1) < 1e-4  # the others are noise
    assert lent.double().mean() > 0.5
    assert set(episodes[distances.argmin(dim=1)[lent]].tolist()) == {0, 2, 3}


@pytest.mark.parametrize(
    "flags",
    [["--dataset.eval_split=0.3"], ["--dataset.episodes=[5, 1, 2, 0]", "--dataset.eval_split=0.4"], []],
)
def test_the_episodes_to_train_on_are_lerobots(small_maze, small_maze_meta, monkeypatch, flags):
    """What is read from the command line beside the datasets that LeRobot makes of it."""
    monkeypatch.setattr("sys.argv", ["lerobot-train", *flags])
    values = {key: yaml.safe_load(value) for key, value in (f.split(".", 1)[1].split("=") for f in flags)}
    dataset = DatasetConfig("local/small_maze", root=str(small_maze), **values)
    config = TrainPipelineConfig(dataset, policy=make_policy_config("zbc", device="cpu", push_to_hub=False))
    expected, _ = make_train_eval_datasets(config)
    found = training_episodes(small_maze_meta)
    assert (found and sorted(found)) == (expected.episodes and sorted(expected.episodes))


def test_of_several_flags_the_last_counts(small_maze_meta, monkeypatch):
    """As in LeRobot's parser, in either way of writing them; null takes all, whatever the file says."""
    several = ["--dataset.episodes=[0]", "--dataset.episodes", "[1, 2]", "--steps=3"]
    for more, expected in (
        ([], [1, 2]),
        (["--dataset.episodes=[4]"], [4]),
        (["--dataset.episodes=null"], None),
    ):
        monkeypatch.setattr("sys.argv", ["lerobot-train", *several, *more])
        assert training_episodes(small_maze_meta) == expected


def test_a_configuration_on_the_hub_names_the_episodes(small_maze, small_maze_meta, tmp_path, monkeypatch):
    """--config_path=user/repository, as LeRobot finds it; what is found nowhere is refused."""
    dataset = DatasetConfig("local/small_maze", root=str(small_maze), episodes=[0, 4], eval_split=0.5)
    policy = make_policy_config("zbc", device="cpu", push_to_hub=False)
    TrainPipelineConfig(dataset, policy=policy).save_pretrained(tmp_path)
    monkeypatch.setattr("sys.argv", ["lerobot-train", "--config_path=some/run", "--dataset.eval_split=0"])
    with pytest.raises(ValueError, match="config_path='some/run': found neither here nor on the Hub"):
        training_episodes(small_maze_meta)
    monkeypatch.setattr(
        "lerobot.configs.train.hf_hub_download", lambda filename, **_: str(tmp_path / filename)
    )
    assert training_episodes(small_maze_meta) == [0, 4]


def test_what_a_program_says_counts_against_its_command_line(small_maze, small_maze_meta, monkeypatch):
    """Within the block alone; of all episodes, too."""
    monkeypatch.setattr("sys.argv", ["program", "--dataset.episodes=[0]"])
    root = str(small_maze)
    with training_on(DatasetConfig("local/small_maze", root=root, episodes=[1, 2, 5])):
        assert training_episodes(small_maze_meta) == [1, 2, 5]
    with training_on(DatasetConfig("local/small_maze", root=root)):
        assert training_episodes(small_maze_meta) is None
    assert training_episodes(small_maze_meta) == [0]
