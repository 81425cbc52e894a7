"""Backbones as the command line, a style policy and a checkpoint meet them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass

import pytest
import torch
from conftest import make_batch, save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from torch import nn

from lerobot_swr.policies.backbones.backbone import Backbone, squared_errors
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.policies.backbones.registry import BackboneConfig


class Linear(Backbone):
    """Plans two actions, knows the mean of its losses only, and wants a learning rate of its own."""

    def __init__(self, size: int, action_dim: int):
        super().__init__()
        self.layer = nn.Linear(size, action_dim)
        self.planned = None

    def predict_action_chunk(self, batch, style):
        """The same action twice."""
        seen = [batch["observation.state"], batch["observation.environment_state"]]
        action = self.layer(torch.cat(seen if style is None else [*seen, style], dim=1))
        return torch.stack([action, action], dim=1)

    def loss(self, batch, style, weight):
        """Weighted squared error."""
        return (squared_errors(self.predict_action_chunk(batch, style)[:, 0], batch) * weight).mean(), None

    def select_action(self, batch, style):
        """The planned action, if any."""
        if self.planned is None:
            self.planned = list(self.predict_action_chunk(batch, style).unbind(1))
        return self.planned.pop(0)

    def param_groups(self):
        """One group."""
        return [{"params": list(self.parameters()), "lr": 0.5}]

    def reset(self):
        """Plan anew."""
        self.planned = None


@dataclass
class LinearConfig(BackboneConfig):
    """Has no options."""

    def make(self, observations: Mapping[str, int], style_dim: int, action_dim: int) -> Linear:
        """A new layer."""
        return Linear(sum(observations.values()) + style_dim, action_dim)


@pytest.fixture
def linear(monkeypatch):
    """The backbone ``linear``, registered."""
    monkeypatch.setattr(BackboneConfig, "_choice_registry", dict(BackboneConfig._choice_registry))
    BackboneConfig.register_subclass("linear", LinearConfig)


@pytest.mark.parametrize("policy_type", ["bc", "zbc", "wzbc"])
def test_any_backbone_can_be_put_under_a_style_policy(linear, make_tiny_policy, policy_type):
    """It is trained, plans, is reset with the rollout, and names its own learning rate."""
    policy = make_tiny_policy(policy_type, backbone=LinearConfig()).train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    assert [group["lr"] for group in optimizer.param_groups] == [0.5, 5e-3][: len(optimizer.param_groups)]
    loss, numbers = policy.forward(make_batch())
    loss.backward()
    assert numbers == {}
    assert policy.backbone.layer.weight.grad.any()
    with pytest.raises(ValueError, match="'linear' knows the mean only"):
        policy.forward(make_batch(), reduction="none")
    policy.eval().reset()
    first = policy.select_action(make_batch(3))
    assert torch.equal(policy.select_action(make_batch(3, seed=2)), first)
    policy.reset()
    assert policy.backbone.planned is None
    assert policy.predict_action_chunk(make_batch(3)).shape == (3, 2, 2)


def test_a_checkpoint_knows_its_backbone(make_tiny_policy, small_maze_meta, tmp_path):
    """Type and options are in config.json, and a flag can change what is none of the network's business."""
    folder = save_checkpoint(make_tiny_policy("zbc", backbone=MLPConfig(24, 2)), small_maze_meta, tmp_path)
    stored = json.loads((folder / "config.json").read_text())["backbone"]
    plain = {"encoder": "plain", "frame": None, "multiscale": True}
    assert stored == {"type": "mlp", "hidden_dim": 24, "num_hidden": 2, "residual": True, **plain}
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=["--style_sampling=stratified"])
    assert config.backbone == MLPConfig(24, 2)
    assert config.style_sampling == "stratified"


def test_options_of_version_0_1_are_told_what_they_became():
    """In one line, with the values that were given."""
    with pytest.raises(ValueError, match=r"policy.hidden_dim, policy.residual: .*backbone now; give") as told:
        make_policy_config("zbc", hidden_dim=64, residual=False, device="cpu")
    assert str(told.value).endswith("--policy.backbone.hidden_dim=64 --policy.backbone.residual=false")
    with pytest.raises(ValueError, match=r"backbone\.num_hidden=0: expected at least 1"):
        MLPConfig(num_hidden=0)


def test_a_checkpoint_of_version_0_1_is_refused(make_tiny_policy, small_maze_meta, tmp_path, capsys):
    """In one line that says so."""
    folder = save_checkpoint(make_tiny_policy("zbc"), small_maze_meta, tmp_path)
    stored = json.loads((folder / "config.json").read_text())
    del stored["backbone"]
    stored |= {"hidden_dim": 16, "num_hidden": 3, "residual": True}
    (folder / "config.json").write_text(json.dumps(stored))
    with pytest.raises(Exception, match="Couldn't instantiate class"):
        PreTrainedConfig.from_pretrained(folder)
    told = capsys.readouterr().err.strip().splitlines()  # LeRobot's own messages, too
    assert [line for line in told if line.startswith("error:")] == [
        "error: this zbc checkpoint was made by version 0.1, which this version does not read: train the "
        "policy anew, or use it with lerobot_policy_swr 0.1"
    ]


def test_a_backbone_of_a_checkpoint_is_made_again(make_tiny_policy, small_maze_meta, tmp_path):
    """Fine-tuning goes on with the same network."""
    policy = make_tiny_policy("bc", backbone=MLPConfig(24, 2, residual=False))
    config = PreTrainedConfig.from_pretrained(save_checkpoint(policy, small_maze_meta, tmp_path))
    config.pretrained_path = tmp_path
    again = make_policy(config, ds_meta=small_maze_meta)
    for name, value in policy.backbone.state_dict().items():
        assert torch.equal(value, again.backbone.state_dict()[name])
