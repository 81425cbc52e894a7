"""What a network with corrective labels outputs, relative actions or actions, anew and fine-tuned."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import save_checkpoint
from corrective_policies import ACTION, LAG, STATE, batch_of, every_frame, make
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from safetensors.torch import load_file

from lerobot_swr.corrective.relative_actions import RelativeActions, Units
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_checkpoint, load_reference
from lerobot_swr.evaluation.checks.offline import frame_errors
from lerobot_swr.run_context import running
from lerobot_swr.styles.extension import add_demonstrations


def test_absolute_targets_are_learned_relative_to_the_state(servo_dataset):
    """The network's outputs are standardised leads; predictions are the dataset's actions again."""
    policy, meta = make(servo_dataset, corrective="noise")
    assert policy.config.action_targets == [0, 1]
    assert abs(policy.config.inverse_horizon - LAG) <= 1
    batch = batch_of(policy, meta, every_frame(policy))
    drawn = policy.draw(batch)
    own = ~drawn.corrective
    leads = policy.trajectories.columns[ACTION] - policy.trajectories.columns[STATE]
    expected = ((leads - leads.mean(axis=0)) / leads.std(axis=0))[batch["index"][own]]
    np.testing.assert_allclose(drawn.batch[ACTION][own], expected, atol=2e-4)
    decoded = policy.relative.decode(drawn.batch[ACTION], drawn.batch[STATE])
    torch.testing.assert_close(decoded[own], batch[ACTION][own], atol=1e-4, rtol=1e-4)
    encoded = policy.relative.encode(batch[ACTION], batch[STATE])
    assert torch.allclose(encoded[own], drawn.batch[ACTION][own])


def test_relative_checkpoints_act_the_same_without_their_dataset(servo_dataset, tmp_path):
    """What translates the outputs is in the checkpoint; nothing of the dataset is."""
    policy, meta = make(servo_dataset, corrective="demos")
    policy.draw(batch_of(policy, meta, every_frame(policy)))
    folder = save_checkpoint(policy, meta, tmp_path)
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    checkpoint = load_checkpoint(config)
    batch = batch_of(policy, meta, torch.arange(50))
    style = policy.styles.embedding(batch["episode_index"])
    assert torch.equal(checkpoint.policy.predict(batch, style), policy.predict(batch, style))
    stored = load_file(folder / "model.safetensors")
    assert {k for k in stored if k.startswith(("correct.", "relative."))} == {
        "correct.draws.seed",
        "correct.draws.step",
        *(f"relative.{name}" for name in ("offset", "scale", "state_gain")),
    }
    saved = json.loads((folder / "config.json").read_text())
    assert saved["inverse_r2"] == policy.config.inverse_r2
    assert len(saved["inverse_r2"]) == 2

    # The evaluation on frames compares actions, not the network's outputs.
    trajectories = load_reference(DatasetSource(root=servo_dataset), checkpoint)
    errors = frame_errors(checkpoint, trajectories).squared["own"]
    whole = batch_of(policy, meta, torch.arange(len(errors)))
    own = policy.predict(whole, policy.styles.embedding(whole["episode_index"]))
    np.testing.assert_allclose(errors, (own - whole[ACTION]).square().detach(), atol=1e-5)


def test_styles_are_encoded_by_the_error_of_actions(servo_dataset):
    """Held-out and added demonstrations: the reported error is that of the policy's actions."""
    with running(DatasetConfig("local/servo", episodes=[0, 1, 2, 3])):
        policy, meta = make(servo_dataset, corrective="noise")
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    added = add_demonstrations(policy, preprocessor, policy.trajectories, policy.trajectories, [5])
    start, length = policy.trajectories.starts[5], policy.trajectories.lengths[5]
    frames = batch_of(policy, meta, torch.arange(start, start + length))
    error = (
        policy.predict(frames, policy.styles.embedding(frames["episode_index"])) - frames[ACTION]
    ).square()
    assert added.errors[0] == pytest.approx(float(error.mean().detach()), rel=1e-4)


def test_relative_actions_can_be_switched_off_and_horizons_set(servo_dataset):
    """--policy.corrective_relative=false, --policy.corrective_horizon."""
    policy, _ = make(servo_dataset, corrective="noise", corrective_relative=False, corrective_horizon=2)
    assert policy.config.action_targets is None
    assert policy.config.inverse_horizon == 2
    assert policy.relative is None


# --- Fine-tuning: what outputs mean ---


def fine_tune(policy, meta, folder: Path, root: Path, **options):
    """A policy that starts from another one's checkpoint, as LeRobot's factory makes it."""
    config = PreTrainedConfig.from_pretrained(save_checkpoint(policy, meta, folder))
    config.pretrained_path = folder
    for key, value in options.items():
        setattr(config, key, value)
    new_meta = LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    return make_policy(config, ds_meta=new_meta).train(), new_meta


def test_a_plain_checkpoint_keeps_predicting_actions(servo_dataset, tmp_path, caplog):
    """Corrective labels on absolute targets, from a network of absolute actions: it stays one."""
    plain, meta = make(servo_dataset)
    tuned, _ = fine_tune(plain, meta, tmp_path, servo_dataset, corrective="noise")
    assert tuned.config.action_targets is None
    assert "keeps the checkpoint's outputs, actions, although" in caplog.text
    assert len(tuned.config.inverse_r2) == 2
    batch = batch_of(tuned, meta, every_frame(tuned))
    style = plain.styles.embedding(batch["episode_index"])
    assert torch.equal(tuned.predict(batch, style), plain.predict(batch, style))
    drawn = tuned.draw(batch)
    own = ~drawn.corrective
    assert torch.equal(drawn.batch[ACTION][own], batch[ACTION][own])
    # Labels lead towards the path by no more than demonstrated, as a policy's that is trained anew.
    anew, _ = make(servo_dataset, corrective="noise")
    anew.correct.draws.load_state_dict(tuned.correct.draws.state_dict())
    tuned.correct.draws.step.zero_()
    anew.correct.draws.step.zero_()
    labels = [policy.draw(batch) for policy in (tuned, anew)]
    decoded = anew.relative.decode(labels[1].batch[ACTION], labels[1].batch[STATE])
    torch.testing.assert_close(labels[0].batch[ACTION], decoded, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", ["none", "demos"])
def test_a_relative_checkpoint_stays_relative(servo_dataset, small_maze, tmp_path, kind):
    """On a dataset of displacements, too; all that is stored tells of the new dataset."""
    relative, meta = make(servo_dataset, corrective="noise")
    tuned, new_meta = fine_tune(relative, meta, tmp_path, small_maze, corrective=kind)
    assert tuned.config.action_targets == [0, 1]
    if kind == "none":
        assert (tuned.config.inverse_r2, tuned.config.inverse_horizon) == (None, None)
    else:
        assert tuned.config.inverse_horizon == 3
        assert tuned.config.inverse_r2 != relative.config.inverse_r2
    columns = tuned.trajectories.columns
    leads = columns[ACTION] - columns[STATE]
    batch = batch_of(tuned, new_meta, every_frame(tuned))
    drawn = tuned.draw(batch)
    own = ~drawn.corrective if kind == "demos" else torch.ones(len(batch["index"]), dtype=bool)
    expected = ((leads - leads.mean(axis=0)) / leads.std(axis=0))[batch["index"][own]]
    np.testing.assert_allclose(drawn.batch[ACTION][own], expected, atol=1e-3)


@pytest.mark.parametrize("relative", [True, False])
def test_a_flag_that_contradicts_the_checkpoint_is_refused(servo_dataset, tmp_path, relative):
    """corrective_relative=true on a network of actions, =false on one of relative actions."""
    policy, meta = make(servo_dataset, corrective="none" if relative else "noise")
    with pytest.raises(ValueError, match=rf"corrective_relative={str(relative).lower()}: the checkpoint's"):
        fine_tune(policy, meta, tmp_path, servo_dataset, corrective="noise", corrective_relative=relative)


def test_relative_actions_of_a_state_that_never_changes():
    """Fine-tuning where a joint rests: its relative action is decoded all the same."""
    rng = np.random.default_rng(0)
    states = np.full((50, 1), 0.7, np.float32)
    actions = rng.normal(0.9, 0.1, (50, 1)).astype(np.float32)
    relative = RelativeActions(1, 1)
    action = Units(np.array([2.0]), np.array([0.3]))
    relative.fit(states, actions, np.array([0]), Units(np.zeros(1), np.zeros(1)), action)
    normalized = torch.from_numpy(action.normalize(actions))
    encoded = relative.encode(normalized, torch.zeros(50, 1))
    assert abs(float(encoded.mean())) < 1e-3
    torch.testing.assert_close(relative.decode(encoded, torch.zeros(50, 1)), normalized)
