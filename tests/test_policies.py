"""The policies bc, zbc and wzbc as LeRobot sees them."""

import copy
import importlib.metadata
import json
import logging

import numpy as np
import pandas as pd
import pytest
import torch
from conftest import make_batch, save_checkpoint
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config

from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.policies.modeling_swr import ZBCPolicy
from lerobot_swr.run_context import RunContext, running

STYLE_POLICIES = ("zbc", "wzbc")


def gradients(policy, batch):
    policy.train()
    policy.zero_grad()
    loss, figures = policy.forward(batch)
    loss.backward()
    return loss.item(), {name: p.grad for name, p in policy.named_parameters()}, figures


def drawn_pairs(policy, batch):
    """The pairs that the policy's next training step will draw."""
    uniforms = copy.deepcopy(policy.relabel.draws).uniforms(1, len(batch["episode_index"]))
    return policy.relabel.sampler.draw(batch["episode_index"], uniforms)


def reload(policy, meta, folder, **overrides):
    save_checkpoint(policy, meta, folder)
    flags = [f"--{key}={value}" for key, value in overrides.items()]
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=flags)
    return get_policy_class(config.type).from_pretrained(folder, config=config)


def train_briefly(policy, steps=20, seed=0):
    torch.manual_seed(seed)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for step in range(steps):
        loss, _ = policy.forward(make_batch(seed=step))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    return policy.eval()


def test_lerobot_discovers_the_distribution_by_its_exact_name():
    """The metadata name is the importable shim's, underscores and all."""
    names = [d.metadata["Name"] for d in importlib.metadata.distributions()]
    assert "lerobot_policy_swr" in names
    assert {"bc", "zbc", "wzbc"} <= set(PreTrainedConfig.get_known_choices())


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_always_relabelling_sends_no_gradient_into_any_style(make_tiny_policy, partner_sampling):
    """p = 1: the network learns, the styles' gradient is exactly zero (stop-gradient of algorithm 1)."""
    policy = make_tiny_policy("wzbc", p=1.0, partner_sampling=partner_sampling)
    _, grads, _ = gradients(policy, make_batch())
    style = grads.pop("styles.embedding.weight")
    assert style is None or (style == 0).all()
    assert all((grad != 0).any() for grad in grads.values())


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_styles_learn_from_their_own_frames_alone(make_tiny_policy, partner_sampling):
    """The style gradient of a mixed batch equals that of its own-style frames, computed by hand."""
    policy = make_tiny_policy(
        "wzbc", beta=1.0, p=0.5, balance_episodes=False, partner_sampling=partner_sampling
    )
    batch = make_batch()
    pairs = drawn_pairs(policy, batch)
    _, grads, _ = gradients(policy, batch)
    assert 0 < pairs.relabelled.sum() < len(pairs.relabelled)
    policy.zero_grad()
    own = {key: value[~pairs.relabelled] for key, value in batch.items()}
    predicted = policy.backbone(own, policy.styles.embedding(own["episode_index"]))
    errors = ((predicted - own["action"]) ** 2).mean(dim=1)
    (errors * pairs.weights[~pairs.relabelled]).sum().div(len(pairs.relabelled)).backward()
    torch.testing.assert_close(policy.styles.embedding.weight.grad, grads["styles.embedding.weight"])


def test_without_relabelling_wzbc_is_zbc_bit_for_bit(make_tiny_policy):
    """p = 0: same initial weights, same weights after training."""
    zbc, wzbc = make_tiny_policy("zbc"), make_tiny_policy("wzbc", p=0.0)
    train_briefly(zbc)
    train_briefly(wzbc)
    for name, value in zbc.state_dict().items():
        assert torch.equal(value, wzbc.state_dict()[name]), name


def test_without_temperature_relabelled_frames_count_fully(make_tiny_policy):
    """β = 0: every weight is 1, so the mean weight is the share of relabelled frames over p."""
    policy = make_tiny_policy("wzbc", beta=0.0, p=1.0, balance_episodes=False)
    _, _, figures = gradients(policy, make_batch())
    assert figures["mean_weight"] == pytest.approx(1)
    assert figures["effective_demos"] == pytest.approx(6)


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_the_logged_figures_are_what_they_name(make_tiny_policy, partner_sampling):
    """Own-style loss, relabelled loss and mean weight against the full sums over all pairs of episodes."""
    policy = make_tiny_policy(
        "wzbc", beta=1.0, p=0.5, partner_sampling=partner_sampling, balance_episodes=False
    )
    batch = make_batch(n_frames=60_000)
    _, figures = policy.train().forward(batch)

    distances = policy.data.similarity.distance(np.arange(6)[:, None], np.arange(6))
    weights = np.exp(-distances / distances.max(axis=1, keepdims=True))
    frames = make_batch(n_frames=600)
    errors = torch.stack(
        [
            (policy.backbone(frames, policy.styles.embedding.weight[j].expand(600, -1)) - frames["action"])
            .square()
            .mean(dim=1)
            for j in range(6)
        ],
        dim=1,
    ).detach()  # (frames, styles)
    own = torch.nn.functional.one_hot(frames["episode_index"], 6).bool()
    w = torch.from_numpy(weights)[frames["episode_index"]]
    assert figures["own_style_loss"] == pytest.approx(errors[own].mean().item(), rel=0.1)
    assert figures["relabelled_loss"] == pytest.approx((w * errors)[~own].mean().item(), rel=0.1)
    assert figures["mean_weight"] == pytest.approx(w[~own].mean().item(), rel=0.02)
    assert policy.forward(batch)[0].ndim == 0


def test_balanced_frames_count_every_episode_alike(make_tiny_policy, small_maze_meta):
    """Frame losses are weighted by mean length / length."""
    lengths = np.array(small_maze_meta.episodes["length"])
    batch = make_batch()
    plain = make_tiny_policy("bc", balance_episodes=False).forward(batch, reduction="none")[0]
    balanced = make_tiny_policy("bc").forward(batch, reduction="none")[0]
    expected = lengths.mean() / lengths[batch["episode_index"]]
    np.testing.assert_allclose((balanced / plain).detach(), expected, rtol=1e-5)


@pytest.mark.parametrize("policy_type", ["bc", *STYLE_POLICIES])
def test_saving_and_loading_keeps_the_actions(make_tiny_policy, small_maze_meta, tmp_path, policy_type):
    """The same observations and random state give the same actions."""
    policy = train_briefly(make_tiny_policy(policy_type))
    loaded = reload(policy, small_maze_meta, tmp_path / "checkpoint")
    batch = make_batch(10)
    for candidate in (policy, loaded):
        candidate.reset()
    torch.manual_seed(5)
    expected = policy.select_action(batch)
    torch.manual_seed(5)
    assert torch.equal(loaded.select_action(batch), expected)
    assert torch.equal(loaded.predict_action_chunk(batch)[:, 0], expected)


@pytest.mark.parametrize("policy_type", STYLE_POLICIES)
def test_styles_are_constant_in_an_episode_and_independent_across_environments(make_tiny_policy, policy_type):
    """Each environment acts with its one style, drawn for itself, whatever the others do."""
    policy = train_briefly(make_tiny_policy(policy_type))
    observations = make_batch(64)
    policy.reset()
    policy.select_action(observations)
    styles = policy.styles.active.clone()
    for seed in range(3):
        step = make_batch(64, seed=seed)
        expected = policy.backbone(step, policy.styles.embedding(styles))
        torch.testing.assert_close(policy.select_action(step), expected)
    assert torch.equal(policy.styles.active, styles)
    assert len(styles.unique()) == 6
    policy.reset()
    policy.select_action(observations)
    assert not torch.equal(policy.styles.active, styles)


def test_inference_options_are_flags_of_the_loaded_policy(make_tiny_policy, small_maze_meta, tmp_path):
    """A loaded checkpoint takes style_sampling and style_episodes."""
    policy = train_briefly(make_tiny_policy("zbc"))
    loaded = reload(policy, small_maze_meta, tmp_path / "c", style_sampling="fixed", style_episodes="[3,1]")
    loaded.reset()
    loaded.select_action(make_batch(3))
    assert loaded.styles.active.tolist() == [3, 1, 3]


def test_only_trained_episodes_are_drawn_after_loading(make_tiny_policy, small_maze_meta, tmp_path):
    """The checkpoint remembers on which episodes it was made to train."""
    policy = make_tiny_policy("wzbc", episodes=[0, 1, 2, 3])
    loaded = reload(policy, small_maze_meta, tmp_path / "c")
    loaded.reset()
    loaded.select_action(make_batch(200))
    assert set(loaded.styles.active.tolist()) == {0, 1, 2, 3}


def test_fine_tuning_on_other_data_keeps_the_network_and_starts_new_styles(
    make_tiny_policy, small_maze_meta, tmp_path, caplog
):
    """Another dataset, of another size: network kept, cookbook new, a message says so."""
    policy = train_briefly(make_tiny_policy("zbc"))
    save_checkpoint(policy, small_maze_meta, tmp_path / "c")
    write_dataset(_recipe("other", "small", {"20": 3}, steady), tmp_path / "other", seed=9)
    config = PreTrainedConfig.from_pretrained(tmp_path / "c")
    config.pretrained_path = tmp_path / "c"
    with caplog.at_level(logging.WARNING):
        tuned = make_policy(config, ds_meta=LeRobotDatasetMetadata("local/other", root=tmp_path / "other"))
    assert "3 new styles" in caplog.text
    assert len(tuned.styles) == 3
    assert tuned.styles.trained.tolist() == [1, 1, 1]
    assert torch.equal(tuned.backbone.head.weight, policy.backbone.head.weight)


@pytest.mark.parametrize("policy_type", STYLE_POLICIES)
def test_frames_of_episodes_that_are_left_out_are_refused(make_tiny_policy, policy_type):
    """They would get a style that is never drawn; the message names them and the way to train on them."""
    policy = make_tiny_policy(policy_type, episodes=[0, 1, 2, 3]).train()
    with pytest.raises(ValueError, match=r"episodes \[4, 5\], .*--dataset.episodes .*running"):
        policy.forward(make_batch())


def test_what_was_trained_before_is_still_drawn_after_training_on_others(
    make_tiny_policy, small_maze_meta, tmp_path
):
    """A checkpoint of episodes 0 and 1 that is continued on 1 and 4 has styles of all three."""
    folder = save_checkpoint(make_tiny_policy("zbc", episodes=[0, 1]), small_maze_meta, tmp_path / "c")
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    with running(DatasetConfig("local/small_maze", episodes=[1, 4])):
        tuned = make_policy(config, ds_meta=small_maze_meta)
    assert tuned.data.run == RunContext((1, 4), resuming=False)
    assert tuned.styles.trained.tolist() == [1, 1, 0, 0, 1, 0]


def test_continuing_on_the_same_data_keeps_the_styles(make_tiny_policy, small_maze_meta, tmp_path):
    """A checkpoint with its own dataset is continued, styles and all."""
    policy = train_briefly(make_tiny_policy("wzbc"))
    save_checkpoint(policy, small_maze_meta, tmp_path / "c")
    config = PreTrainedConfig.from_pretrained(tmp_path / "c")
    config.pretrained_path = tmp_path / "c"
    torch.manual_seed(7)
    loaded = make_policy(config, ds_meta=small_maze_meta)
    for name, value in policy.state_dict().items():
        if not name.startswith("relabel.draws."):
            assert torch.equal(value, loaded.state_dict()[name]), name
    assert (loaded.relabel.draws.seed, loaded.relabel.draws.step) == (
        7,
        0,
    )  # a new run draws the numbers of its own seed


def shout(observations) -> str:
    """A behaviour rule: every episode shows the same."""
    return "HEY"


def test_continuing_may_label_the_demonstrations_anew(make_tiny_policy, small_maze_meta, tmp_path, caplog):
    """With another behaviour rule; named filters that no longer apply are dropped with a message."""
    policy = make_tiny_policy("zbc")
    policy.styles.table = policy.styles.table.with_filter("left", "behavior == '10'").with_filter(
        "long", "length > 1"
    )
    folder = save_checkpoint(policy, small_maze_meta, tmp_path / "c")
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.behavior_rule = folder, f"{__name__}:shout"
    tuned = make_policy(config, ds_meta=small_maze_meta)
    assert tuned.styles.table.columns["behavior"] == ["HEY"] * 6
    assert set(tuned.styles.table.filters) >= {"long"}
    with running(DatasetConfig("local/small_maze"), resuming=True):
        resumed = make_policy(config, ds_meta=small_maze_meta)
    assert set(resumed.styles.table.columns["behavior"]) == {"10", "20"}


def test_means_are_over_the_episodes_that_are_trained(make_tiny_policy):
    """The factors of an epoch's frames have mean 1, whatever is left out."""
    policy = make_tiny_policy("zbc", episodes=[0, 3, 5])
    lengths = torch.from_numpy(policy.trajectories.lengths[[0, 3, 5]]).float()
    factors = policy.balance.factors[[0, 3, 5]]
    torch.testing.assert_close((factors * lengths).sum() / lengths.sum(), torch.tensor(1.0))
    torch.testing.assert_close(factors * lengths, lengths.mean().expand(3))


def test_constant_dimensions_are_centred_not_blown_up(make_tiny_policy, small_maze_meta):
    """The goal never moves; its input is 0, not the rounding error of its mean over 1e-8."""
    policy = make_tiny_policy("bc")
    stats = {key: dict(value) for key, value in small_maze_meta.stats.items()}
    stats["observation.environment_state"]["std"] = np.zeros(2)
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=stats)
    goal = torch.tensor([[0.5, 0.92]])
    batch = preprocessor({"observation.state": goal, "observation.environment_state": goal, "action": goal})
    assert batch["observation.environment_state"].abs().max() < 1e-3


def test_the_papers_literal_network_is_one_flag_set():
    """Plain layers, constant learning rate, unit styles, no normalisation."""
    config = make_policy_config(
        "wzbc",
        backbone=MLPConfig(residual=False),
        lr_schedule="constant",
        style_init_scale=1.0,
        style_lr_scale=1.0,
        partner_sampling="uniform",
        normalization_mapping={"STATE": "IDENTITY", "ENV": "IDENTITY", "ACTION": "IDENTITY"},
        device="cpu",
    )
    assert config.get_scheduler_preset() is None
    assert (config.backbone.hidden_dim, config.backbone.num_hidden, config.style_dim) == (128, 10, 10)
    assert (config.beta, config.p, config.optimizer_lr) == (10.0, 0.8, 1e-3)


@pytest.mark.parametrize("steps", [7, 400, 10_000])
def test_the_learning_rate_ends_at_zero_at_the_last_step(make_tiny_policy, steps):
    """Whatever the number of steps."""
    policy = make_tiny_policy("bc")
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    scheduler = policy.config.get_scheduler_preset().build(optimizer, steps)
    assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)
    optimizer.step()
    for _ in range(steps):
        scheduler.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0, abs=1e-12)


def test_the_model_card_says_how_to_install_the_plugin(make_tiny_policy, monkeypatch):
    """Whoever finds the policy on the Hub can run it (the Hub's own check of the card needs the Hub)."""
    monkeypatch.setattr(ModelCard, "validate", lambda card: None)
    card = make_tiny_policy("zbc").generate_model_card("local/small_maze", "zbc", None, None)
    assert "pip install lerobot_policy_swr" in card.text


# --- bad input ---


@pytest.mark.parametrize(
    ("policy_type", "options", "message"),
    [
        ("wzbc", {"p": 1.2}, "p=1.2"),
        ("wzbc", {"beta": -3}, "beta=-3"),
        ("wzbc", {"partner_sampling": "x"}, "partner_sampling='x'"),
        ("wzbc", {"similarity_normalization": "x"}, "normalization='x'"),
        ("zbc", {"style_sampling": "some"}, "style_sampling='some'"),
        ("zbc", {"style_dim": 0}, "style_dim=0"),
        ("zbc", {"style_lr_scale": 0}, "style_lr_scale=0"),
        ("bc", {"hidden_dim": 64}, "give --policy.backbone.hidden_dim=64"),
        ("bc", {"lr_schedule": "linear"}, "lr_schedule='linear'"),
    ],
)
def test_bad_values_are_named_when_the_configuration_is_made(policy_type, options, message):
    """Before a dataset is even looked at."""
    with pytest.raises(ValueError, match=message):
        make_policy_config(policy_type, device="cpu", **options)


def test_unknown_similarity_keys_are_named(make_tiny_policy):
    """The features to choose from are listed."""
    with pytest.raises(ValueError, match=r"similarity_keys=.*: observation.speed are no .*observation.state"):
        make_tiny_policy("wzbc", similarity_keys=["observation.speed"])


def test_a_single_episode_is_too_few_for_wzbc(tmp_path):
    """wzbc says what to do; zbc trains on it."""
    write_dataset(_recipe("one", "small", {"10": 1}, steady), tmp_path / "one")
    meta = LeRobotDatasetMetadata("local/one", root=tmp_path / "one")
    with pytest.raises(ValueError, match=r"single episode.*--policy.type=zbc"):
        make_policy(make_policy_config("wzbc", device="cpu"), ds_meta=meta)
    assert len(make_policy(make_policy_config("zbc", device="cpu"), ds_meta=meta).styles) == 1


def test_a_dataset_without_state_is_refused(small_maze_meta):
    """The missing feature is named."""
    config = make_policy_config("zbc", device="cpu")
    features = dict(small_maze_meta.features)
    del features["observation.state"]
    meta = LeRobotDatasetMetadata("local/small_maze", root=small_maze_meta.root)
    meta.info["features"] = features
    with pytest.raises(ValueError, match=r"needs the feature 'observation.state'"):
        make_policy(config, ds_meta=meta)


def test_nan_states_are_refused_before_training(small_maze, tmp_path):
    """Also for data of any other source: the parquet file is edited here."""
    import shutil

    root = tmp_path / "broken"
    shutil.copytree(small_maze, root)
    file = next((root / "data").rglob("*.parquet"))
    table = pd.read_parquet(file)
    table.at[10, "observation.state"] = np.array([np.nan, 0.0], dtype=np.float32)
    table.to_parquet(file)
    meta = LeRobotDatasetMetadata("local/broken", root=root)
    with pytest.raises(ValueError, match=r"'observation.state' is NaN.*episode 0, frame 10"):
        make_policy(make_policy_config("bc", device="cpu"), ds_meta=meta)


@pytest.mark.parametrize("damage", ["truncated", "missing tensor", "other size"])
def test_a_damaged_checkpoint_is_an_error(make_tiny_policy, small_maze_meta, tmp_path, damage):
    """Weights that are cut off, incomplete or of another shape are never silently replaced by random ones."""
    policy = make_tiny_policy("zbc")
    folder = save_checkpoint(policy, small_maze_meta, tmp_path / "c")
    weights = folder / "model.safetensors"
    if damage == "truncated":
        weights.write_bytes(weights.read_bytes()[:-100])
    elif damage == "missing tensor":
        from safetensors.torch import load_file, save_file

        tensors = load_file(weights)
        del tensors["styles.embedding.weight"]
        save_file(tensors, weights)
    else:
        config = json.loads((folder / "config.json").read_text())
        config["num_episodes"] = 7
        (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"model.safetensors.*(damaged checkpoint|does not fit)"):
        ZBCPolicy.from_pretrained(folder)


def test_a_style_policy_needs_a_dataset_or_a_checkpoint():
    """From an environment alone there is nothing to have styles of."""
    from lerobot.configs import FeatureType, PolicyFeature

    config = make_policy_config(
        "zbc",
        device="cpu",
        input_features={"observation.state": PolicyFeature(FeatureType.STATE, (2,))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
    )
    with pytest.raises(ValueError, match="one style per episode"):
        ZBCPolicy(config)
