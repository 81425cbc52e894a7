"""LeRobot's commands on policies with corrective labels: what is refused, resumed and fine-tuned."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import save_checkpoint, train_flags
from corrective_policies import ACTION, STATE, make
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config
from safetensors.torch import load_file

from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.evaluation.checkpoint import load_checkpoint

SMALL = ("--policy.backbone.hidden_dim=16", "--policy.backbone.num_hidden=2")


# --- Refusals ---


def test_the_flag_on_a_plain_checkpoint_is_refused(small_maze, tmp_path):
    """At evaluation it would have no effect."""
    policy, meta = make(small_maze)
    config = PreTrainedConfig.from_pretrained(save_checkpoint(policy, meta, tmp_path))
    config.pretrained_path, config.corrective = tmp_path, "demos"
    with pytest.raises(ValueError, match=r"corrective='demos': this checkpoint was trained without"):
        load_checkpoint(config)


def test_actions_that_states_do_not_explain_are_refused(tmp_path):
    """The error names the R² that was reached and the way out."""
    rng = np.random.default_rng(0)

    def demonstrations(seed: int):
        for _ in range(4):
            states = rng.standard_normal((40, 2)).astype(np.float32)
            yield Demonstration({STATE: states}, rng.standard_normal((40, 2)).astype(np.float32))

    features = {STATE: ("a", "b"), ACTION: ("a", "b")}
    recipe = DatasetRecipe("random", "Move.", 20, "arm", features, 4, demonstrations, lambda episode: "moved")
    write_dataset(recipe, tmp_path / "random")
    with pytest.raises(ValueError, match=r"held-out R² at most -?0\.\d\d, needed 0.8.*corrective=none"):
        make(tmp_path / "random", corrective="noise")


@pytest.mark.parametrize(
    ("options", "message"),
    [({"corrective": "both"}, "corrective='both'"), ({"corrective_scale": 0}, "corrective_scale=0")],
)
def test_bad_values_are_named(small_maze, options, message):
    """Unknown kinds and scales that are none."""
    with pytest.raises(ValueError, match=message):
        make(small_maze, **options)


def test_a_dataset_of_images_alone_is_refused():
    """Corrective labels need states; the error says which feature is missing."""
    from lerobot.configs import FeatureType, PolicyFeature

    config = make_policy_config("zbc", corrective="demos", device="cpu", num_episodes=3)
    config.input_features = {"observation.image": PolicyFeature(type=FeatureType.VISUAL, shape=(3, 8, 8))}
    config.output_features = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,))}
    with pytest.raises(ValueError, match=r"needs the feature 'observation.state'"):
        get_policy_class("zbc")(config)


# --- Training, resuming and fine-tuning ---


def tensors(output_dir: Path, step: int) -> dict[str, torch.Tensor]:
    return load_file(output_dir / "checkpoints" / f"{step:06d}" / "pretrained_model" / "model.safetensors")


@pytest.mark.parametrize(("policy_type", "kind"), [("zbc", "noise"), ("wzbc", "demos")])
def test_a_killed_run_resumes_to_the_same_weights(
    lerobot_train_command, servo_dataset, tmp_path, policy_type, kind
):
    """Uninterrupted: 20 steps. Killed after step 10 and resumed: the same weights, bit for bit."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    flags = [*SMALL, f"--policy.corrective={kind}", "--save_freq=10", "--log_freq=5"]
    lerobot_train_command(*train_flags(policy_type, servo_dataset, whole, 20, *flags))
    shutil.copytree(whole, killed, symlinks=True)
    shutil.rmtree(killed / "checkpoints" / "000020")
    config = killed / "checkpoints" / "000010" / "pretrained_model" / "train_config.json"
    config.write_text(config.read_text().replace(str(whole), str(killed)))
    lerobot_train_command(f"--config_path={config}", "--resume=true")
    expected, resumed = tensors(whole, 20), tensors(killed, 20)
    assert expected.keys() == resumed.keys()
    for name, value in expected.items():
        assert torch.equal(value, resumed[name]), name


def test_a_plain_checkpoint_is_fine_tuned_with_corrective_labels(lerobot_train_command, small_maze, tmp_path):
    """--policy.path with --policy.corrective=noise: the network and the styles are kept."""
    plain, tuned = tmp_path / "plain", tmp_path / "tuned"
    lerobot_train_command(*train_flags("zbc", small_maze, plain, 10, *SMALL))
    flags = [flag for flag in train_flags("zbc", small_maze, tuned, 1) if "policy.type" not in flag]
    checkpoint = plain / "checkpoints" / "000010" / "pretrained_model"
    lerobot_train_command(
        *flags, f"--policy.path={checkpoint}", "--policy.corrective=noise", "--policy.optimizer_lr=1e-9"
    )
    before, after = tensors(plain, 10), tensors(tuned, 1)
    assert "correct.draws.seed" in after
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, atol=1e-6, rtol=0)
