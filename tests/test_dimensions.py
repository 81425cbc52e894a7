"""Datasets, checkpoints and environments of different dimensions meet before any work, in one line."""

import re

import numpy as np
import pytest
from conftest import save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy
from lerobot.policies.factory import get_policy_class, make_policy_config
from odd_datasets import ACTION, STATE, arc, arcs, feature, metadata, write

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.cli import styles as styles_command
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig

SHAPES = {"state": {STATE: 3, ACTION: 2}, "action": {STATE: 2, ACTION: 3}}


@pytest.fixture(scope="module", params=SHAPES)
def wider(request, tmp_path_factory):
    """A dataset with one dimension more in its states or actions, and what is told of it."""
    sizes = SHAPES[request.param]
    root = write(
        tmp_path_factory.mktemp("wider") / request.param,
        {key: feature(size) for key, size in sizes.items()},
        lambda i, t, n: {
            key: np.r_[arc(i, t, n), 0][:size].astype(np.float32) for key, size in sizes.items()
        },
    )
    key = STATE if request.param == "state" else ACTION
    return root, rf"feature '{key}' has shape \[3\], in the checkpoint it has \[2\]"


def trained(policy_type, root, folder):
    """A checkpoint of a small policy with a style for every episode."""
    meta = metadata(root)
    config = make_policy_config(policy_type, backbone=MLPConfig(8, 1), device="cpu", push_to_hub=False)
    policy = make_policy(config, ds_meta=meta)
    return save_checkpoint(policy, meta, folder)


def test_a_dataset_of_other_dimensions_is_refused_in_fine_tuning(plain_arcs, wider, tmp_path):
    """As ``lerobot-train --policy.path`` makes the policy."""
    root, expected = wider
    folder = trained("zbc", plain_arcs, tmp_path / "checkpoint")
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    with pytest.raises(ValueError, match=expected):
        make_policy(config, ds_meta=metadata(root))


@pytest.mark.parametrize("policy_type", ["bc", "zbc"])
def test_a_dataset_of_other_dimensions_is_refused_in_evaluation(
    plain_arcs, wider, tmp_path, run_command, capsys, policy_type
):
    """By the command's one line, without a folder of results."""
    root, expected = wider
    folder = trained(policy_type, plain_arcs, tmp_path / "checkpoint")
    flags = [f"--policy.path={folder}", f"--dataset.root={root}", f"--output_dir={tmp_path / 'out'}"]
    with pytest.raises(SystemExit, match="2"):
        run_command(eval_command.main, *flags)
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith(f"error: dataset.root='{root}'")
    assert re.search(expected, message)
    assert not (tmp_path / "out").exists()


def test_demonstrations_of_other_dimensions_are_not_added(plain_arcs, wider, tmp_path, run_command, capsys):
    """Before anything is encoded; no checkpoint appears."""
    root, expected = wider
    folder = trained("zbc", plain_arcs, tmp_path / "checkpoint")
    flags = [f"--dataset.root={plain_arcs}", f"--add={root}", f"--output_dir={tmp_path / 'new'}"]
    with pytest.raises(SystemExit, match="2"):
        run_command(styles_command.main, folder, *flags)
    assert re.search(expected, capsys.readouterr().err)
    assert not (tmp_path / "new").exists()


def test_an_environment_of_other_dimensions_is_refused(tmp_path, run_command, capsys):
    """A policy of three states sent into a maze, whose observation has two: before any rollout."""
    root = write(
        tmp_path / "data",
        {STATE: feature(3), ACTION: feature(2)},
        lambda i, t, n: {**arcs(i, t, n), STATE: np.r_[arc(i, t, n), t].astype(np.float32)},
    )
    folder = trained("bc", root, tmp_path / "checkpoint")
    flags = [f"--policy.path={folder}", f"--dataset.root={root}", f"--output_dir={tmp_path / 'out'}"]
    with pytest.raises(SystemExit, match="2"):
        run_command(eval_command.main, *flags, "--env.type=maze2d", "--env.task=small")
    message = capsys.readouterr().err
    assert "env.type='maze2d'" in message
    assert "feature 'observation.state' has shape [2], in the checkpoint it has [3]" in message


def test_weights_that_do_not_fit_name_the_feature(plain_arcs, tmp_path):
    """A configuration whose action was changed, as LeRobot does for an environment."""
    folder = trained("bc", plain_arcs, tmp_path / "checkpoint")
    config = PreTrainedConfig.from_pretrained(folder)
    config.output_features[ACTION] = type(config.output_features[ACTION])(
        config.output_features[ACTION].type, (5,)
    )
    with pytest.raises(ValueError, match=r"environment: feature 'action' has shape \[5\], .* it has \[2\]"):
        get_policy_class("bc").from_pretrained(folder, config=config)
