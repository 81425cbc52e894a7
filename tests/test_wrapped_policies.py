"""LeRobot's contracts for a policy, of styles over its own policies and over a plugin's."""

import copy
import json
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors, pretrained
from lerobot.utils.constants import ACTION, DONE, REWARD
from odd_datasets import PLAIN, arcs, feature, write
from styled_policies import KINDS, batch_of, metadata_of, observed

from lerobot_swr.policies.backbones.wrapped_policy import WrappedPolicy
from lerobot_swr.policies.vector_pipelines import FloatVectorsProcessorStep
from lerobot_swr.styles.request import StyleRequest

PLACES = {"act": "environment_state", "diffusion": "environment_state", "toy": "state", "smolvla": "state"}
CHUNK = 4
every_kind = pytest.mark.parametrize("kind", KINDS)


def plain_config(policy):
    """The backbone's configuration with the dataset's features, as LeRobot would have it without styles."""
    plain = copy.deepcopy(policy.config.backbone)
    plain.input_features, plain.output_features = policy.config.input_features, policy.config.output_features
    return plain


@every_kind
@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_a_batch_teaches_network_and_styles_and_stays_as_it_was(make_styled, data_of, kind, policy_type):
    """The loss is a scalar, what is logged are numbers, and only styles that are taught have a gradient."""
    policy = make_styled(policy_type, kind, data_of(kind)).train()
    assert policy.config.style_key == PLACES[kind]
    batch = batch_of(policy, data_of(kind))
    before = {
        key: value.clone() if isinstance(value, torch.Tensor) else value for key, value in batch.items()
    }
    loss, numbers = policy.forward(batch)
    loss.backward()
    assert loss.shape == ()
    assert all(isinstance(value, int | float) for value in numbers.values())
    assert batch.keys() == before.keys()
    assert all(torch.equal(v, before[k]) for k, v in batch.items() if isinstance(v, torch.Tensor))
    moved = policy.styles.embedding.weight.grad.abs().sum(dim=1) > 0
    assert moved.any()
    if policy_type == "zbc":
        assert set(moved.nonzero().flatten().tolist()) <= set(batch["episode_index"].tolist())
    assert any(p.grad is not None and p.grad.any() for p in policy.backbone.parameters())


@every_kind
def test_the_loss_of_each_frame_is_known(make_styled, data_of, kind):
    """``reduction="none"``: (B,), of which the mean is that of the batch where all frames weigh alike."""
    policy = make_styled("zbc", kind, data_of(kind), balance_episodes=False).eval()
    batch = batch_of(policy, data_of(kind), size=4)
    batch.pop("action_is_pad", None)
    batch["action_is_pad"] = torch.zeros(batch[ACTION].shape[:2], dtype=torch.bool)
    with torch.no_grad():
        losses, _ = policy.forward(batch, reduction="none")
        mean, _ = policy.forward(batch)
    assert losses.shape == (4,)
    if kind != "diffusion":  # which draws other noise for a single frame
        assert torch.allclose(losses.mean(), mean, rtol=1e-4)


@every_kind
def test_a_checkpoint_acts_as_the_policy_did(make_styled, data_of, kind, tmp_path):
    """Weights, chunk and actions are the same; config.json names the backbone, without features."""
    policy = make_styled("zbc", kind, data_of(kind)).eval()
    policy.save_pretrained(tmp_path)
    stored = json.loads((tmp_path / "config.json").read_text())
    assert stored["backbone"]["type"] == kind
    assert not stored["backbone"]["input_features"]
    assert stored["input_features"].keys() == policy.config.input_features.keys()
    again = type(policy).from_pretrained(tmp_path)
    for key, value in policy.state_dict().items():
        assert torch.equal(value, again.state_dict()[key])
    batch = observed(policy, data_of(kind))
    acted = []
    for each in (policy, again):
        each.reset()
        torch.manual_seed(3)
        acted.append(torch.stack([each.select_action(dict(batch)) for _ in range(5)]))
    assert torch.equal(*acted)
    assert acted[0].shape == (5, 3, 2)


@every_kind
def test_chunks_have_the_backbone_s_length(make_styled, data_of, kind):
    """(B, K, A), of a batch as training brings it."""
    policy = make_styled("zbc", kind, data_of(kind)).eval()
    policy.reset()
    batch = batch_of(policy, data_of(kind), size=3)
    assert policy.predict_action_chunk(batch).shape == (3, CHUNK, 2)


@every_kind
def test_optimizer_and_schedule_are_the_backbone_s(make_styled, data_of, kind):
    """Its preset and groups; styles have an absolute rate and no decay; every parameter is there once."""
    policy = make_styled("zbc", kind, data_of(kind))
    plain = plain_config(policy)
    assert policy.config.get_optimizer_preset() == plain.get_optimizer_preset()
    assert policy.config.get_scheduler_preset() == plain.get_scheduler_preset()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    *network, styles = optimizer.param_groups
    assert (styles["lr"], styles["weight_decay"]) == (5e-3, 0.0)
    assert styles["params"] == [policy.styles.embedding.weight]
    assert network[0]["lr"] == plain.optimizer_lr
    held = [p for group in optimizer.param_groups for p in group["params"]]
    assert len(held) == len(set(held))
    assert {p for p in policy.parameters() if p.requires_grad} <= set(held)
    assert make_styled("zbc", kind, data_of(kind), style_lr=0.25).get_optim_params()[-1]["lr"] == 0.25


@every_kind
def test_windows_and_what_else_lerobot_asks_are_the_backbone_s(make_styled, data_of, kind):
    """Delta indices, normalisation, and options that LeRobot reads where a policy has them."""
    config = make_styled("zbc", kind, data_of(kind)).config
    for name in ("observation_delta_indices", "action_delta_indices", "normalization_mapping", "n_obs_steps"):
        assert getattr(config, name) == getattr(config.backbone, name), name
    for name in (
        "drop_n_last_frames",
        "dtype",
        "chunk_size",
        "n_action_steps",
        "rtc_config",
        "compile_model",
    ):
        assert hasattr(config, name) == hasattr(config.backbone, name), name
        assert getattr(config, name, None) == getattr(config.backbone, name, None)
    if hasattr(config, "compile_model"):  # lerobot-rollout sets it
        config.compile_model = True
        assert config.backbone.compile_model


@every_kind
def test_processors_are_the_backbone_s(make_styled, data_of, kind):
    """The same steps, and one that makes vectors; batches come out as the plain policy's do."""
    policy = make_styled("zbc", kind, data_of(kind))
    stats = metadata_of(data_of(kind)).stats
    ours, theirs = (
        make_pre_post_processors(config, dataset_stats=stats)
        for config in (policy.config, plain_config(policy))
    )
    for one, other in zip(ours, theirs, strict=True):
        steps = [type(step) for step in one.steps if not isinstance(step, FloatVectorsProcessorStep)]
        assert steps == [type(step) for step in other.steps]
    action = torch.tensor([[0.3, -0.2], [0.1, 0.4]])
    assert torch.equal(ours[1](action.clone()), theirs[1](action.clone()))


@every_kind
def test_a_style_is_kept_across_chunks_and_a_request_counts_from_the_next(make_styled, data_of, kind):
    """Against the plain policy's own actions under the one style, then under the other."""
    policy = make_styled("zbc", kind, data_of(kind)).eval()
    batch = observed(policy, data_of(kind), size=1)
    seen = []
    inner = policy.backbone.policy
    select, place = inner.select_action, policy.backbone.place

    def note(styled, **options):
        seen.append(styled[place.key][..., -policy.config.style_dim :].clone())
        return select(styled, **options)

    with patch.object(inner, "select_action", note):
        policy.reset()
        policy.styles.request([1])
        for _ in range(5):
            policy.select_action(dict(batch))
        policy.styles.request([2])
        for _ in range(5):
            policy.select_action(dict(batch))
    weight = policy.styles.embedding.weight
    assert all(torch.equal(style, weight[1:2]) for style in seen[:5])
    assert all(torch.equal(style, weight[2:3]) for style in seen[5:])


@pytest.mark.parametrize("ask", ["select_action", "predict_action_chunk"])
def test_histories_take_on_a_new_style(make_styled, small_maze, ask):
    """A diffusion policy's remembered observations have the style that its next chunk is planned for."""
    policy = make_styled("zbc", "diffusion", small_maze).eval()
    policy.reset()
    policy.styles.request([1])
    policy.select_action(observed(policy, small_maze, size=1))
    policy.styles.request([2])
    getattr(policy, ask)(observed(policy, small_maze, size=1, row=1))
    history = policy.backbone.policy._queues["observation.environment_state"]
    z = policy.styles.embedding.weight[2:3]
    assert all(torch.equal(remembered[:, -policy.config.style_dim :], z) for remembered in history)
    assert len(history) == 2


@pytest.mark.parametrize("kind", ["beso", "ddpm_gpt", "ddpm_act", "tdmpc"])
def test_policies_that_look_at_their_dataset_or_at_rewards_take_styles(make_styled, rewarded_arcs, kind):
    """This package's baselines, and a policy that learns values."""
    policy = make_styled("zbc", kind, rewarded_arcs).train()
    policy.forward(batch_of(policy, rewarded_arcs))[0].backward()
    assert policy.styles.embedding.weight.grad.abs().sum() > 0


@pytest.fixture(scope="module")
def rewarded_arcs(tmp_path_factory):
    """Folder of a dataset with rewards."""

    def frame(i, t, n):
        return {**arcs(i, t, n), REWARD: np.array([t / n], np.float32), DONE: np.array([t == n - 1])}

    features = {**PLAIN, REWARD: feature(1), DONE: feature(1, dtype="bool")}
    return write(tmp_path_factory.mktemp("rewarded") / "arcs", features, frame)


def test_episodes_that_the_sampler_never_shows_get_no_style(make_styled, tmp_path, caplog):
    """The others count alike over the frames that it shows."""
    root = write(tmp_path / "short", lengths=(2, 3, 4, 8))
    policy = make_styled("zbc", "toy", root)
    assert policy.config.drop_n_last_frames == 3
    assert policy.styles.trained.tolist() == [0, 0, 1, 1]
    assert "episodes [0, 1] have no more than 3 frames" in caplog.text
    assert (policy.balance.factors[2:] * torch.tensor([1, 5])).tolist() == [3, 3]
    with pytest.raises(ValueError, match=r"no episode has more than 3 frames.* drop_n_last_frames=0"):
        make_styled("zbc", "toy", root, episodes=[0, 1])


def test_similarity_may_compare_what_the_network_does_not_see(make_styled, tmp_path):
    """Any column of numbers of the dataset, the simulator's state beside the cameras, for one."""

    def frame(i, t, n):
        return {**arcs(i, t, n), "simulator.state": np.array([i % 2], np.float32)}

    root = write(tmp_path / "arcs", {**PLAIN, "simulator.state": feature(1)}, frame)
    policy = make_styled("wzbc", "toy", root, similarity_keys=["simulator.state"])
    assert "simulator.state" not in policy.config.input_features
    neighbours = policy.styles.table.neighbours[:, 0] % 2
    assert neighbours.tolist() == [0, 1, 0, 1]
    with pytest.raises(ValueError, match=r"simulator\.nothing are no numbers of .* simulator\.state"):
        make_styled("wzbc", "toy", root, similarity_keys=["simulator.nothing"])


def test_a_rollout_with_more_environments_needs_a_reset(make_styled, small_maze):
    """Style and queue are reset together; without, LeRobot's queue would silently give old actions."""
    policy = make_styled("zbc", "act", small_maze).eval()
    policy.reset()
    policy.select_action(observed(policy, small_maze, size=2))
    with pytest.raises(ValueError, match=r"call policy\.reset"):
        policy.select_action(observed(policy, small_maze, size=3))
    policy.reset()
    assert policy.select_action(observed(policy, small_maze, size=3)).shape == (3, 2)


@pytest.mark.parametrize("kind", ["act", "smolvla"])
def test_it_is_pushed_to_the_hub_with_its_table(make_styled, data_of, kind):
    """Everything that LeRobot uploads is there, and what this package puts beside it; offline."""
    policy = make_styled("zbc", kind, data_of(kind), repo_id="me/styled")
    cfg = SimpleNamespace(dataset=SimpleNamespace(repo_id="me/data"), save_pretrained=lambda path: None)
    names = []

    class Api:
        """What LeRobot calls."""

        def create_repo(self, **options):
            """The name."""
            return SimpleNamespace(repo_id="me/styled")

        def upload_folder(self, folder_path, **options):
            """What is uploaded."""
            names.extend(path.name for path in folder_path.iterdir())
            return SimpleNamespace(repo_url=SimpleNamespace(url="there"))

    card = SimpleNamespace(save=lambda path: None, text="")
    with (
        patch.object(pretrained, "HfApi", Api),
        patch.object(type(policy.styles.table), "upload", lambda *args: names.append("table")),
        patch("huggingface_hub.HfApi.upload_file", lambda api, path_in_repo, **_: names.append(path_in_repo)),
        patch.object(type(policy), "generate_model_card", lambda *args, **options: card),
    ):
        policy.push_model_to_hub(cfg)
    assert {"table", "config.json", "model.safetensors"} <= set(names)


def test_what_a_plugin_does_is_done(make_styled, small_maze):
    """``update`` after each step, its numbers in the log, its frames left out at an episode's end."""
    policy = make_styled("zbc", "toy", small_maze).train()
    _, numbers = policy.forward(batch_of(policy, small_maze))
    assert numbers["toy_error"] > 0
    policy.update()
    assert policy.backbone.policy.updates == 1
    assert policy.config.drop_n_last_frames == 3
    assert isinstance(policy.backbone, WrappedPolicy)
    assert not policy.supports_rtc()


def test_random_numbers_are_those_of_the_step(make_styled, small_maze):
    """A policy's noise depends on seed and step alone, and the global generator is left alone."""
    losses = []
    for disturbance in (0, 3):
        policy = make_styled("zbc", "diffusion", small_maze).train()
        batch = batch_of(policy, small_maze)
        torch.rand(disturbance)
        state = torch.get_rng_state()
        losses.append([policy.forward(batch)[0].item() for _ in range(3)])
        assert torch.equal(torch.get_rng_state(), state)
    assert losses[0] == losses[1]
    assert len(set(losses[0])) == 3


def test_smolvla_plans_in_real_time(make_styled, camera_arcs):
    """It supports RTC, which is set up by the options that LeRobot's rollout gives the configuration."""
    from lerobot.policies.rtc.configuration_rtc import RTCConfig
    from lerobot.rollout.inference.rtc import supports_rtc_inference

    policy = make_styled("zbc", "smolvla", camera_arcs).eval()
    assert supports_rtc_inference(policy)
    policy.config.rtc_config = RTCConfig(execution_horizon=2)
    policy.init_rtc_processor()
    assert policy.backbone.policy.rtc_processor is not None
    policy.reset()
    batch = observed(policy, camera_arcs, size=1)
    before = policy.predict_action_chunk(batch, inference_delay=0, prev_chunk_left_over=None)
    after = policy.predict_action_chunk(batch, inference_delay=1, prev_chunk_left_over=before[0, 1:3])
    assert before.shape == after.shape == (1, 4, 2)


def test_bc_over_a_policy_is_that_policy(make_styled, small_maze):
    """Without styles the network sees the dataset's features alone."""
    policy = make_styled("bc", "act", small_maze)
    assert policy.backbone.place is None
    assert policy.backbone.policy.config.input_features == policy.config.input_features
    assert PreTrainedConfig.get_choice_class("act") is type(policy.config.backbone)


def test_styles_can_be_asked_for_as_vectors(make_styled, small_maze):
    """Blends go through a chunking backbone, too."""
    policy = make_styled("zbc", "act", small_maze).eval()
    with policy.styles.requested(StyleRequest(vectors=torch.randn(1, 10))):
        policy.reset()
        assert policy.select_action(observed(policy, small_maze, size=2)).shape == (2, 2)


def test_adapters_leave_the_network_and_train_the_styles_whole(make_styled, small_maze, tmp_path):
    """PEFT on the modules that are named; of a checkpoint, since LeRobot loads adapters on one."""
    pytest.importorskip("peft", reason="adapters need peft: pip install 'lerobot_policy_swr[vla]'")
    policy = make_styled("zbc", "act", small_maze)
    with pytest.raises(ValueError, match=r"policy\.pretrained_path"):
        policy.wrap_with_peft(peft_cli_overrides={"target_modules": ["linear1"], "r": 2})
    policy.config.pretrained_path = tmp_path
    whole = {"target_modules": ["linear1"], "r": 2, "full_training_modules": ["action_head"]}
    adapted = policy.wrap_with_peft(peft_cli_overrides=whole)
    batch = batch_of(policy, small_maze)
    adapted.forward(batch)[0].backward()
    moved = [name for name, p in adapted.named_parameters() if p.grad is not None and p.grad.any()]
    for part in ("lora", "styles.embedding.modules_to_save", "action_head.modules_to_save"):
        assert any(part in name for name in moved), part
    assert all("lora" in name or "modules_to_save" in name for name in moved)


def test_smolvla_names_its_modules_for_adapters(make_styled, camera_arcs):
    """Its pattern is one of names within the style policy."""
    import re

    policy = make_styled("zbc", "smolvla", camera_arcs)
    pattern = policy._get_default_peft_targets()["target_modules"]
    names = [name for name, _ in policy.named_modules() if re.fullmatch(pattern, name)]
    assert any(name.endswith("q_proj") for name in names)
    assert "backbone.policy.model.state_proj" in names
