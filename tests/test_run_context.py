"""Which episodes a run trains on and whether it is resumed, as LeRobot's command would have it."""

import json

import pytest
import torch
import yaml
from conftest import train_flags
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies.factory import make_policy_config
from safetensors.torch import load_file

from lerobot_swr.run_context import RunContext, running

ALL = (0, 1, 2, 3, 4, 5)


@pytest.fixture
def context(small_maze_meta, monkeypatch):
    """What a command with some flags finds."""

    def find(*flags: str) -> RunContext:
        monkeypatch.setattr("sys.argv", ["lerobot-train", *map(str, flags)])
        return RunContext.current(small_maze_meta)

    return find


@pytest.mark.parametrize(
    "flags",
    [["--dataset.eval_split=0.3"], ["--dataset.episodes=[5, 1, 2, 0]", "--dataset.eval_split=0.4"], []],
)
def test_the_episodes_to_train_on_are_lerobots(small_maze, context, flags):
    """What is read from the command line beside the datasets that LeRobot makes of it."""
    values = {key: yaml.safe_load(value) for key, value in (f.split(".", 1)[1].split("=") for f in flags)}
    dataset = DatasetConfig("local/small_maze", root=str(small_maze), **values)
    config = TrainPipelineConfig(dataset, policy=make_policy_config("zbc", device="cpu", push_to_hub=False))
    expected, _ = make_train_eval_datasets(config)
    assert context(*flags) == RunContext(tuple(sorted(expected.episodes or ALL)), resuming=False)


def test_of_several_flags_the_last_counts(context):
    """As in LeRobot's parser, in either way of writing them; null takes all, whatever the file says."""
    several = ["--dataset.episodes=[0]", "--dataset.episodes", "[1, 2]", "--steps=3"]
    assert context(*several).episodes == (1, 2)
    assert context(*several, "--dataset.episodes=[4]").episodes == (4,)
    assert context(*several, "--dataset.episodes=null").episodes == ALL


@pytest.mark.parametrize("ending", ["json", "yaml"])
def test_a_configuration_file_counts_where_flags_say_nothing(context, tmp_path, ending):
    """Episodes, split and resume of a file, or of a folder with LeRobot's; flags go before it."""
    file = tmp_path / f"train_config.{ending}"
    content = {"dataset": {"episodes": [4, 0, 2, 5], "eval_split": 0.0}, "resume": True}
    file.write_text(json.dumps(content))
    assert context(f"--config_path={file}") == RunContext((0, 2, 4, 5), resuming=True)
    assert context(f"--config_path={file}", "--resume=false", "--dataset.eval_split=0.5") == RunContext(
        (0, 4), resuming=False
    )
    assert context(f"--config_path={file}", "--dataset.episodes=[3]").episodes == (3,)
    folder = context(f"--config_path={tmp_path}")
    assert folder.episodes == ((0, 2, 4, 5) if ending == "json" else ALL)
    file.write_text("{}")
    assert context(f"--config_path={file}") == RunContext(ALL, resuming=False)


@pytest.mark.parametrize(("flag", "expected"), [("--resume=true", True), ("--resume=False", False)])
def test_resuming_is_told_by_its_flag(context, flag, expected):
    """With and without an equals sign."""
    assert context(flag).resuming is expected
    assert context(*flag.split("=")).resuming is expected


def test_a_configuration_on_the_hub_names_the_episodes(small_maze, context, tmp_path, monkeypatch):
    """--config_path=user/repository, as LeRobot finds it; what is found nowhere is refused."""
    dataset = DatasetConfig("local/small_maze", root=str(small_maze), episodes=[0, 4], eval_split=0.5)
    policy = make_policy_config("zbc", device="cpu", push_to_hub=False)
    TrainPipelineConfig(dataset, policy=policy).save_pretrained(tmp_path)
    flags = ["--config_path=some/run", "--dataset.eval_split=0"]
    with pytest.raises(ValueError, match="config_path='some/run': found neither here nor on the Hub"):
        context(*flags)
    monkeypatch.setattr(
        "lerobot.configs.train.hf_hub_download", lambda filename, **_: str(tmp_path / filename)
    )
    assert context(*flags) == RunContext((0, 4), resuming=False)


def test_what_a_program_says_counts_against_its_command_line(small_maze_meta, context):
    """Within the block alone; of all episodes, too."""
    flags = ["--dataset.episodes=[0]", "--resume=true"]
    with running(DatasetConfig("local/small_maze", episodes=[5, 1, 2])):
        assert context(*flags) == RunContext((1, 2, 5), resuming=False)
    with running(DatasetConfig("local/small_maze", eval_split=0.5), resuming=True):
        assert context(*flags) == RunContext((0, 1, 2), resuming=True)
    assert context(*flags) == RunContext((0,), resuming=True)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--dataset.episodes=[1, 6]"], r"episodes \[6\] do not exist; .* has episodes 0 to 5"),
        (["--dataset.eval_split=1.0"], r"dataset.eval_split=1.0: they leave no episode to train on"),
    ],
)
def test_impossible_choices_are_named(context, flags, message):
    """With key, value and what there is."""
    with pytest.raises(ValueError, match=message):
        context(*flags)


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_a_policy_knows_its_episodes_before_its_first_step(make_tiny_policy, policy_type):
    """Their styles may be drawn, only they are partners, and ν is normalised over them."""
    policy = make_tiny_policy(policy_type, episodes=[0, 2, 5])
    assert policy.data.run == RunContext((0, 2, 5), resuming=False)
    assert policy.styles.trained.tolist() == [1, 0, 1, 0, 0, 1]
    assert set(policy.styles.draw(100).tolist()) == {0, 2, 5}
    if policy_type == "wzbc":
        farthest = max((2, 5), key=lambda j: policy.data.similarity.distance(0, j))
        assert policy.relabel.sampler.nu(0, farthest) == 1


def test_a_run_that_resumes_by_its_file_goes_on_with_its_draws(lerobot_train_command, small_maze, tmp_path):
    """Resume is in the file of a resumed run; LeRobot goes on by it without a flag, and so do the draws."""
    flags = ["--policy.backbone.hidden_dim=16", "--policy.backbone.num_hidden=2", "--save_freq=4", "--seed=5"]
    run = tmp_path / "run"
    lerobot_train_command(*train_flags("wzbc", small_maze, run, 4, *flags))
    file = run / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "resume": True}))
    lerobot_train_command(f"--config_path={file}", "--steps=6")
    weights = load_file(run / "checkpoints" / "last" / "pretrained_model" / "model.safetensors")
    assert torch.equal(weights["relabel.draws.step"], torch.tensor(6))
