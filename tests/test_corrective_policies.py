"""Corrective labels in the policies zbc and wzbc: what they learn from, checkpoints, LeRobot's commands."""

import copy
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from conftest import save_checkpoint, train_flags
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config
from safetensors.torch import load_file

from lerobot_swr.configuration import training_episodes, training_on
from lerobot_swr.corrective.inverse_model import fit_inverse_model
from lerobot_swr.corrective.relative_actions import RelativeActions, Units
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_checkpoint, load_reference
from lerobot_swr.evaluation.offline import frame_errors
from lerobot_swr.policies.style_extension import add_demonstrations

STATE, ENV, ACTION = "observation.state", "observation.environment_state", "action"
SMALL = ("--policy.hidden_dim=16", "--policy.num_hidden=2")
LAG = 4


def servo_demonstrations(seed: int):
    """Two joints that follow absolute targets."""
    rng = np.random.default_rng(seed)
    for _ in range(6):
        noise = rng.standard_normal((90, 2))
        targets = np.stack([np.convolve(n, np.ones(15) / 15, "same") for n in noise.T], axis=1).cumsum(axis=0)
        states = np.zeros((90, 2))
        for t in range(1, 90):
            states[t] = states[t - 1] + (targets[t - 1] - states[t - 1]) / LAG
        yield Demonstration({STATE: states.astype(np.float32)}, targets.astype(np.float32))


@pytest.fixture(scope="module")
def servo_dataset(tmp_path_factory) -> Path:
    """Folder of a dataset whose actions are absolute targets."""
    root = tmp_path_factory.mktemp("datasets") / "servo"
    features = {STATE: ("a", "b"), ACTION: ("a", "b")}
    recipe = DatasetRecipe(
        "servo", "Move.", 20, "arm", features, 6, servo_demonstrations, lambda episode: "moved"
    )
    write_dataset(recipe, root)
    return root


def make(root: Path, policy_type: str = "zbc", **options):
    """A small policy on a dataset, in training mode."""
    torch.manual_seed(0)
    options = {"hidden_dim": 16, "num_hidden": 3, "device": "cpu", "push_to_hub": False, **options}
    meta = LeRobotDatasetMetadata(f"local/{root.name}", root=root)
    return make_policy(make_policy_config(policy_type, **options), ds_meta=meta).train(), meta


def batch_of(policy, meta, rows: torch.Tensor) -> dict[str, torch.Tensor]:
    """Frames as LeRobot's loader and preprocessor bring them."""
    trajectories = policy.trajectories
    raw = {key: torch.from_numpy(column)[rows] for key, column in trajectories.columns.items()}
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    prepared = preprocessor({key: raw[key] for key in [*policy.config.observation_keys, ACTION]})
    episodes = np.repeat(np.arange(len(trajectories)), trajectories.lengths)
    keys = [*policy.config.observation_keys, ACTION]
    return {
        **{k: prepared[k] for k in keys},
        "episode_index": torch.from_numpy(episodes)[rows],
        "index": rows,
    }


def every_frame(policy) -> torch.Tensor:
    """All rows of the dataset, shuffled."""
    count = int(policy.trajectories.lengths.sum())
    return torch.randperm(count, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_without_corrective_labels_nothing_is_added(small_maze, policy_type):
    """The default is the paper's: no tensor, no draw and no figure more, the actions the network's."""
    policy, meta = make(small_maze, policy_type)
    assert policy.config.corrective == "none"
    assert policy.corrections is None
    assert not [key for key in policy.state_dict() if "corrections" in key]
    batch = batch_of(policy, meta, every_frame(policy))
    drawn = policy.draw(batch)
    assert "corrective" not in drawn
    assert all(torch.equal(drawn[key], batch[key]) for key in (STATE, ENV, ACTION))
    style = policy.styles.embedding(batch["episode_index"])
    assert torch.equal(policy.predict(batch, style), policy.network(batch, style))


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
@pytest.mark.parametrize("kind", ["noise", "demos"])
def test_half_of_the_frames_are_corrective(small_maze, policy_type, kind):
    """They are no frames of the batch; the others stay what they are without corrective labels."""
    policy, meta = make(small_maze, policy_type, corrective=kind)
    plain, _ = make(small_maze, policy_type)
    batch = batch_of(policy, meta, every_frame(policy))
    drawn, expected = policy.draw(batch), plain.draw(batch)
    corrective = drawn["corrective"]
    assert int(corrective.sum()) == len(corrective) // 2
    for key, value in expected.items():
        assert torch.equal(drawn[key][~corrective], value[~corrective]), key
        assert drawn[key].dtype == value.dtype, key  # float32: not every device has float64
    styles = drawn["style_episode"][corrective]
    assert set(styles.tolist()) == set(range(6))
    if policy_type == "zbc":
        torch.testing.assert_close(drawn["weight"][corrective], policy.frame_weights(styles))
    assert ((drawn[STATE] != batch[STATE]).any(dim=1))[corrective].float().mean() > 0.9


def test_corrective_frames_teach_the_style_of_their_demonstration(small_maze):
    """With almost no noise every one is a frame of the episode whose style it teaches, with its action."""
    policy, meta = make(small_maze, corrective="noise", corrective_scale=1e-7)
    rows = every_frame(policy)
    batch = batch_of(policy, meta, rows)
    drawn = policy.draw(batch)
    demonstrated = batch_of(policy, meta, rows.sort().values)
    for place in drawn["corrective"].nonzero().squeeze(1).tolist():
        own = demonstrated["episode_index"] == drawn["style_episode"][place]
        distances = (demonstrated[STATE][own] - drawn[STATE][place]).norm(dim=1)
        assert distances.min() < 1e-4
        torch.testing.assert_close(
            drawn[ACTION][place], demonstrated[ACTION][own][distances.argmin()], atol=1e-3, rtol=0
        )


def test_wzbc_relabels_corrective_frames_as_it_does_demonstrated_ones(small_maze):
    """Weight W(i, j) of demonstration i beside which a frame lies; no gradient reaches another's style."""
    policy, meta = make(
        small_maze, "wzbc", corrective="noise", corrective_scale=1e-7, p=0.5, partner_sampling="uniform"
    )
    drawn = policy.draw(batch_of(policy, meta, every_frame(policy)))
    corrective, relabelled = drawn["corrective"], drawn["corrective"] & drawn["relabelled"]
    assert float(relabelled.sum() / corrective.sum()) == pytest.approx(0.5, abs=0.1)
    distances = policy.distances()
    nu = distances / distances.max(axis=1, keepdims=True)
    everything = batch_of(policy, meta, every_frame(policy).sort().values)
    for place in corrective.nonzero().squeeze(1).tolist():
        apart = (everything[STATE] - drawn[STATE][place]).norm(dim=1)
        owners = set(everything["episode_index"][apart < 1e-4].tolist())  # several at a shared start
        style = int(drawn["style_episode"][place])
        similarity = {i: np.exp(-policy.config.beta * nu[i, style]) if i != style else 1.0 for i in owners}
        weights = [w * float(policy.frame_weights(torch.tensor([i]))) for i, w in similarity.items()]
        assert np.isclose(float(drawn["weight"][place]), weights, rtol=1e-4).any()
    losses = policy.frame_losses(drawn)
    (gradient,) = torch.autograd.grad(
        losses[relabelled].sum(), policy.styles.embedding.weight, retain_graph=True
    )
    assert not gradient.any()
    (gradient,) = torch.autograd.grad(losses[corrective].sum(), policy.styles.embedding.weight)
    assert gradient.any(dim=1).all()


def test_the_larger_half_of_odd_batches_takes_turns(small_maze):
    """Batches of one frame are corrective every other time, whether drawn singly or together."""
    policy, meta = make(small_maze, corrective="noise")
    policy.draw(batch_of(policy, meta, every_frame(policy)))
    rows = torch.arange(10)
    singly = [bool(policy.draw(batch_of(policy, meta, row[None]))["corrective"]) for row in rows]
    assert sum(singly) == 5
    assert singly == singly[:2] * 5
    together = policy.draw(batch_of(policy, meta, rows), steps=10)["corrective"]
    assert together.tolist() == singly


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "IDENTITY"])
def test_corrective_frames_are_normalised_as_lerobot_normalises(small_maze, mode):
    """Raw labels through LeRobot's own preprocessor are what the policy draws, under every normalisation."""
    mapping = dict.fromkeys(("STATE", "ENV", "ACTION"), mode)
    policy, meta = make(small_maze, corrective="noise", normalization_mapping=mapping)
    corrections = policy.corrections
    drawn = policy.draw(batch_of(policy, meta, every_frame(policy)))
    n, per_frame = int(drawn["corrective"].sum()), corrections.labels.draws_per_frame
    uniforms = corrections.draws.uniforms_at(0, n, per_frame).reshape(n, per_frame)
    raw = corrections.labels.draw(uniforms, np.arange(6))
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    expected = {**raw.observations, ACTION: raw.actions}
    expected = preprocessor({key: torch.from_numpy(value) for key, value in expected.items()})
    for key in (STATE, ENV, ACTION):
        torch.testing.assert_close(drawn[key][drawn["corrective"]], expected[key], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("size", [16, 5])
@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_many_steps_drawn_at_once_are_those_drawn_one_by_one(small_maze, policy_type, size):
    """From the first step on, when partners are still few, and later; bit for bit."""
    one, meta = make(small_maze, policy_type, corrective="demos")
    many = copy.deepcopy(one)
    rows = every_frame(one)[: 10 * size].view(10, size)
    for part in (rows[:6], rows[6:]):
        singly = [one.draw(batch_of(one, meta, step)) for step in part]
        at_once = many.draw(batch_of(many, meta, part.flatten()), len(part))
        for key in ("style_episode", "weight", "corrective", STATE, ACTION):
            assert torch.equal(at_once[key], torch.cat([drawn[key] for drawn in singly])), key


def test_corrective_frames_do_not_depend_on_how_many_are_drawn_together(small_maze, monkeypatch):
    """Blocks bound the memory; they do not change what is drawn."""
    drawn = []
    for block in (256, 7):
        monkeypatch.setattr("lerobot_swr.policies.corrections.BLOCK", block)
        policy, meta = make(small_maze, corrective="demos")
        drawn.append(policy.draw(batch_of(policy, meta, every_frame(policy))))
    for key in ("style_episode", STATE, ACTION):
        torch.testing.assert_close(drawn[0][key], drawn[1][key], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("size", [16, 5, 1])
def test_before_all_episodes_are_seen_only_the_frames_asked_for_are_drawn(servo_dataset, monkeypatch, size):
    """They are those of a whole block; many steps at once are the same as one by one, bit for bit."""
    one, meta = make(servo_dataset, corrective="demos")
    rows = every_frame(one)
    seen = rows[rows < 3 * 90]  # of episodes 0 to 2
    one.draw(batch_of(one, meta, seen))
    many, labels, counts = copy.deepcopy(one), one.corrections.labels, []
    draw = labels.draw
    monkeypatch.setattr(labels, "draw", lambda u, candidates: counts.append(len(u)) or draw(u, candidates))
    steps = seen[: 10 * size].view(10, size)
    singly = [one.draw(batch_of(one, meta, step)) for step in steps]
    at_once = many.draw(batch_of(many, meta, steps.flatten()), len(steps))
    corrective = at_once["corrective"]
    for key in ("style_episode", "weight", STATE, ACTION):
        expected = torch.cat([drawn[key][drawn["corrective"]] for drawn in singly])
        assert torch.equal(at_once[key][corrective], expected), key
    assert sum(counts) == int(corrective.sum())
    per_frame = labels.draws_per_frame
    block = draw(one.corrections.draws.uniforms_at(0, 256, per_frame).reshape(256, per_frame), np.arange(3))
    first = len(seen) // 2
    expected = block.episodes[first : first + sum(counts)].tolist()
    assert at_once["style_episode"][corrective].tolist() == expected


def test_pairs_and_corrective_draws_are_independent(small_maze):
    """The streams of random numbers differ, and each step's differ from the last one's."""
    policy, _ = make(small_maze, "wzbc", corrective="noise")
    pairs, labels = policy.draws.uniforms(2, 500), policy.corrections.draws.uniforms(2, 500)
    assert abs(np.corrcoef(pairs, labels)[0, 1]) < 0.15
    assert abs(np.corrcoef(labels[:500], labels[500:])[0, 1]) < 0.2


def test_figures_count_each_kind_of_frame_for_itself(small_maze):
    """corrective_loss, own_style_loss and relabelled_loss recomputed from the drawn frames' errors."""
    policy, meta = make(small_maze, "wzbc", corrective="demos", p=0.4)
    drawn = policy.draw(batch_of(policy, meta, every_frame(policy)))
    losses = policy.frame_losses(drawn).detach()
    figures = policy.figures(drawn, losses)
    corrective, relabelled = drawn["corrective"], drawn["relabelled"]
    assert figures["corrective_loss"] == pytest.approx(float((losses * corrective).mean() / 0.5), rel=1e-5)
    own = ~corrective & ~relabelled
    assert figures["own_style_loss"] == pytest.approx(float((losses * own).mean() / 0.6 / 0.5), rel=1e-5)
    others = float((losses * (relabelled & ~corrective)).mean() / 0.4 / 0.5)
    assert figures["relabelled_loss"] == pytest.approx(others, rel=1e-5)


# --- Targets ---


def test_absolute_targets_are_learned_relative_to_the_state(servo_dataset):
    """The network's outputs are standardised leads; predictions are the dataset's actions again."""
    policy, meta = make(servo_dataset, corrective="noise")
    assert policy.config.action_targets == [0, 1]
    assert abs(policy.config.inverse_horizon - LAG) <= 1
    batch = batch_of(policy, meta, every_frame(policy))
    drawn = policy.draw(batch)
    own = ~drawn["corrective"]
    leads = policy.trajectories.columns[ACTION] - policy.trajectories.columns[STATE]
    expected = ((leads - leads.mean(axis=0)) / leads.std(axis=0))[batch["index"][own]]
    np.testing.assert_allclose(drawn[ACTION][own], expected, atol=2e-4)
    decoded = policy.corrections.decode(drawn[ACTION], drawn)
    torch.testing.assert_close(decoded[own], batch[ACTION][own], atol=1e-4, rtol=1e-4)
    policy.eval()
    policy.styles.trained.fill_(1)
    assert torch.allclose(policy.draw(batch)[ACTION][own], drawn[ACTION][own])


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
    assert {k for k in stored if k.startswith("corrections.")} == {
        "corrections.draws.seed",
        "corrections.draws.step",
        *(f"corrections.relative.{name}" for name in ("offset", "scale", "state_gain")),
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
    policy, meta = make(servo_dataset, corrective="noise")
    policy.styles.trained[:4] = 1
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
    assert policy.corrections.relative is None


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
    own = ~drawn["corrective"]
    assert torch.equal(drawn[ACTION][own], batch[ACTION][own])
    # Labels lead towards the path by no more than demonstrated, as a policy's that is trained anew.
    anew, _ = make(servo_dataset, corrective="noise")
    anew.corrections.draws.load_state_dict(tuned.corrections.draws.state_dict())
    tuned.corrections.draws.step.zero_()
    anew.corrections.draws.step.zero_()
    labels = [policy.draw(batch) for policy in (tuned, anew)]
    decoded = anew.corrections.decode(labels[1][ACTION], labels[1])
    torch.testing.assert_close(labels[0][ACTION], decoded, atol=1e-4, rtol=1e-4)


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
    own = ~drawn["corrective"] if kind == "demos" else torch.ones(len(batch["index"]), dtype=bool)
    expected = ((leads - leads.mean(axis=0)) / leads.std(axis=0))[batch["index"][own]]
    np.testing.assert_allclose(drawn[ACTION][own], expected, atol=1e-3)


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


# --- Episodes that are left out ---


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


# --- LeRobot's commands ---


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
    assert "corrections.draws.seed" in after
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, atol=1e-6, rtol=0)
