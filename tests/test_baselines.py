"""The baselines ddpm_gpt, ddpm_act and beso as LeRobot sees them."""

import copy
import sys

import pytest
import torch
from conftest import OBSERVATIONS, WINDOW, make_windows, save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.factory import get_policy_class, make_policy_config
from safetensors.torch import load_file

from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.policies import baselines
from lerobot_swr.policies.baselines.averaging import moving_average
from lerobot_swr.trajectories import load_trajectories

BASELINES = ("ddpm_gpt", "ddpm_act", "beso")


def network_output(policy, batch):
    """What the network says of a batch's actions at one noise level."""
    level = torch.full((len(batch["action"]),), 0.5 if policy.name == "beso" else 1)
    with torch.no_grad():
        return policy.network(
            policy.encoder(batch), batch["action"], level, batch["observation.state_is_pad"]
        )


def train_briefly(policy, steps=5):
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for step in range(steps):
        loss, _ = policy.forward(make_windows(policy_type=policy.name, seed=step))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
    return policy.eval()


# --- what the networks see ---


@pytest.mark.parametrize("policy_type", BASELINES)
@pytest.mark.parametrize("n_pads", [1, 3])
def test_padded_steps_do_not_change_the_loss(make_baseline, policy_type, n_pads):
    """Whatever stands before the episode's start or after its end, nothing is learned from it."""
    policy = make_baseline(policy_type)
    batch = make_windows(policy_type=policy_type, n_pads=n_pads)
    other = {key: value.clone() for key, value in batch.items()}
    for key in OBSERVATIONS:
        other[key][batch["observation.state_is_pad"]] = 7.0
    other["action"][batch["action_is_pad"]] = -7.0
    expected, found = (policy.forward(b, reduction="none")[0] for b in (batch, other))
    torch.testing.assert_close(found, expected)
    assert expected.mean() == pytest.approx(policy.forward(batch)[0].item())
    assert (policy.forward(make_windows(policy_type=policy_type), reduction="none")[0] != expected).all()


@pytest.mark.parametrize("policy_type", BASELINES)
@pytest.mark.parametrize("n_pads", [1, 3])
def test_a_padded_window_is_seen_as_the_shorter_one(make_baseline, policy_type, n_pads):
    """An episode's first steps look the same with padding before them and without."""
    policy = make_baseline(policy_type)
    batch = make_windows(policy_type=policy_type)
    batch["observation.state_is_pad"][:, :n_pads] = True
    shorter = {key: batch[key][:, n_pads:] for key in (*OBSERVATIONS, "observation.state_is_pad")}
    actions = batch["action"] if policy_type == "ddpm_act" else batch["action"][:, n_pads:]
    found = network_output(policy, batch)[:, -actions.shape[1] :]
    torch.testing.assert_close(found, network_output(policy, {**shorter, "action": actions}))


@pytest.mark.parametrize("policy_type", BASELINES)
@pytest.mark.parametrize("step", [1, 3])
def test_no_action_depends_on_later_steps(make_baseline, policy_type, step):
    """A changed action changes its own prediction and later ones alone; in a GPT an observation too."""
    policy = make_baseline(policy_type)
    batch = make_windows(policy_type=policy_type)
    expected = network_output(policy, batch)
    for key in ("action",) if policy_type == "ddpm_act" else ("action", "observation.state"):
        changed = {**batch, key: batch[key].clone()}
        changed[key][:, step] += 1
        differs = (network_output(policy, changed) - expected).abs().amax(dim=(0, 2)) > 1e-4
        assert differs.tolist() == [i >= step for i in range(expected.shape[1])], key


@pytest.mark.parametrize("policy_type", BASELINES)
def test_every_observation_and_the_noise_level_count(make_baseline, policy_type):
    """The last prediction depends on each step of the window, and on the level."""
    policy = make_baseline(policy_type)
    batch = make_windows(policy_type=policy_type)
    expected = network_output(policy, batch)[:, -1]
    for step in range(WINDOW):
        changed = {**batch, OBSERVATIONS[0]: batch[OBSERVATIONS[0]].clone()}
        changed[OBSERVATIONS[0]][:, step] += 1
        assert ((network_output(policy, changed)[:, -1] - expected).abs() > 1e-4).any()
    other_level = policy.network(
        policy.encoder(batch), batch["action"], torch.full((32,), 3.0), batch["observation.state_is_pad"]
    )
    assert ((other_level[:, -1] - expected).abs() > 1e-4).any()


@pytest.mark.parametrize("policy_type", BASELINES)
def test_training_and_inference_see_the_same_network(make_baseline, policy_type):
    """PyTorch runs other kernels in training; masks, padding and layers are those of inference."""
    policy = make_baseline(policy_type, attention_dropout=0.0, residual_dropout=0.0)
    batch = make_windows(policy_type=policy_type, n_pads=2)
    expected = network_output(policy, batch)
    level = torch.full((32,), 0.5 if policy_type == "beso" else 1)
    found = policy.train().network(
        policy.encoder(batch), batch["action"], level, batch["observation.state_is_pad"]
    )
    kept = ~batch["action_is_pad"]
    torch.testing.assert_close(found[kept], expected[kept], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("policy_type", BASELINES)
def test_dropout_is_where_it_was_published(make_baseline, policy_type):
    """Attention has its own; feed-forward blocks have none inside."""
    policy = make_baseline(policy_type, attention_dropout=0.4, residual_dropout=0.3)
    layers = [m for m in policy.network.modules() if hasattr(m, "linear1")]
    assert layers
    for layer in layers:
        assert (layer.self_attn.dropout, layer.dropout.p, layer.dropout1.p, layer.dropout2.p) == (
            *(0.4, 0.0, 0.3, 0.3),
        )


# --- the moving average ---


def test_the_average_follows_the_published_rule():
    """Against the recursion on a single weight, warm-up included."""
    network = torch.nn.Linear(1, 1, bias=False)
    average = moving_average(network, decay=0.5)
    expected = None
    for n in range(1, 12):
        with torch.no_grad():
            network.weight.fill_(n**2)
        average.update_parameters(network)
        keep = min(0.5, (1 + n) / (10 + n))
        expected = n**2 if expected is None else keep * expected + (1 - keep) * n**2
        assert average.module.weight.item() == pytest.approx(expected)


@pytest.mark.parametrize("policy_type", BASELINES)
def test_the_average_acts_and_is_not_trained(make_baseline, policy_type):
    """Actions do not depend on the trained weights; the optimizer does not know the average."""
    policy = train_briefly(make_baseline(policy_type))
    trained = {id(p) for p in policy.get_optim_params()}
    assert trained == {id(p) for p in policy.parameters() if p.requires_grad}
    assert not trained & {id(p) for p in policy.average.parameters()}

    def act():
        torch.manual_seed(0)
        policy.reset()
        return policy.select_action({key: torch.ones(3, 2) for key in OBSERVATIONS})

    expected = act()
    with torch.no_grad():
        policy.network.head.weight.add_(1)
    assert torch.equal(act(), expected)
    with torch.no_grad():
        policy.average.module.head.weight.add_(1)
    assert not torch.equal(act(), expected)


@pytest.mark.parametrize("policy_type", BASELINES)
def test_a_checkpoint_holds_weights_and_average_and_acts_alike(
    make_baseline, small_maze_meta, tmp_path, policy_type
):
    """Saved, loaded: both sets of weights, the number of updates, the bounds and the actions."""
    policy = train_briefly(make_baseline(policy_type))
    save_checkpoint(policy, small_maze_meta, tmp_path / "c")
    saved = load_file(tmp_path / "c" / "model.safetensors")
    assert torch.equal(saved["average.module.head.weight"], policy.average.module.head.weight)
    assert not torch.equal(saved["average.module.head.weight"], saved["network.head.weight"])
    assert saved["average.n_averaged"] == 5
    config = PreTrainedConfig.from_pretrained(tmp_path / "c")
    loaded = get_policy_class(policy_type).from_pretrained(tmp_path / "c", config=config)
    for name, value in policy.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name
    actions = []
    for candidate in (policy, loaded):
        torch.manual_seed(5)
        candidate.reset()
        actions.append(
            [candidate.select_action({key: torch.ones(3, 2) for key in OBSERVATIONS}) for _ in range(6)]
        )
    assert torch.equal(torch.stack(actions[0]), torch.stack(actions[1]))


def test_on_other_data_the_bounds_are_new(make_baseline, small_maze_meta, tmp_path):
    """Fine-tuning normalises by the new dataset's statistics, so the checkpoint's bounds mean nothing."""
    save_checkpoint(make_baseline("beso"), small_maze_meta, tmp_path / "c")
    write_dataset(_recipe("other", "small", {"20": 2}, steady), tmp_path / "other", seed=3)
    meta = LeRobotDatasetMetadata("local/other", root=tmp_path / "other")
    config = PreTrainedConfig.from_pretrained(tmp_path / "c")
    tuned = get_policy_class("beso").from_pretrained(tmp_path / "c", config=config, dataset_meta=meta)
    actions = load_trajectories(meta, ["action"]).columns["action"]
    expected = (actions.max(axis=0) - meta.stats["action"]["mean"]) / meta.stats["action"]["std"]
    torch.testing.assert_close(tuned.action_high, torch.from_numpy(expected).float(), rtol=1e-4, atol=1e-6)


# --- draws ---


@pytest.mark.parametrize("policy_type", BASELINES)
def test_a_steps_draws_depend_on_the_step_alone(make_baseline, policy_type):
    """Noise, levels and dropout: the same after other use of torch's generator, which is left as it was."""
    policy = make_baseline(policy_type).train()
    batch = make_windows(policy_type=policy_type)
    twin = copy.deepcopy(policy)
    first = policy.forward(batch)[0]
    torch.manual_seed(99)
    before = torch.get_rng_state()
    assert torch.equal(twin.forward(batch)[0], first)
    assert torch.equal(torch.get_rng_state(), before)
    assert not torch.equal(twin.forward(batch)[0], first)


def test_the_held_out_loss_is_the_averages_and_draws_alike_every_time(make_baseline):
    """Taking it neither changes the loss nor what the next step draws."""
    policy = train_briefly(make_baseline("ddpm_gpt"))
    step = policy.draws.step.clone()
    batch = make_windows(policy_type="ddpm_gpt")
    loss = policy.forward(batch)[0]
    with torch.no_grad():
        policy.network.head.weight.add_(1)
    assert torch.equal(policy.forward(batch)[0], loss)
    assert torch.equal(policy.draws.step, step)


# --- bad input ---


@pytest.mark.parametrize(
    ("policy_type", "options", "message"),
    [
        ("ddpm_gpt", {"n_layers": 0}, "n_layers=0"),
        ("ddpm_gpt", {"dim_model": 70}, "dim_model=70: .*n_heads=4"),
        ("ddpm_gpt", {"attention_dropout": 1.0}, "attention_dropout=1.0"),
        ("ddpm_gpt", {"n_obs_steps": 0}, "n_obs_steps=0"),
        ("ddpm_act", {"chunk_size": 0}, "chunk_size=0"),
        ("ddpm_act", {"ema_decay": -0.1}, "ema_decay=-0.1"),
        ("beso", {"sigma_min": 2.0}, "sigma_min=2.0: .*sigma_max=1.0"),
        ("beso", {"sigma_data": 0.0}, "sigma_data=0.0"),
        ("beso", {"sigma_min": 1e-5}, "sigma_min=1e-05: .*0.0005"),
        ("beso", {"denoising_steps": 0}, "denoising_steps=0"),
    ],
)
def test_bad_values_are_named_when_the_configuration_is_made(policy_type, options, message):
    """Before a dataset is even looked at."""
    with pytest.raises(ValueError, match=message):
        make_policy_config(policy_type, device="cpu", **options)


def test_without_diffusers_the_extra_is_named(monkeypatch):
    """When the policy's class is asked for; configurations work without it."""
    for module in [name for name in sys.modules if name.startswith("lerobot_swr.policies.baselines.")]:
        if not module.endswith("configuration_baselines"):
            monkeypatch.delitem(sys.modules, module)
    monkeypatch.delattr(baselines, "dependencies")
    monkeypatch.setitem(sys.modules, "diffusers.schedulers.scheduling_ddpm", None)
    config = make_policy_config("beso", device="cpu")
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'lerobot_policy_swr\[baselines\]'"):
        get_policy_class(config.type)
