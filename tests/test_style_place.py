"""Where a style goes in a policy, and which policies cannot take one."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import make_policy_config

from lerobot_swr.policies.backbones.registry import BackboneConfig, WithoutOptions
from lerobot_swr.policies.backbones.style_place import StylePlace

TEXT = ["pi05", "pi0_fast", "groot", "molmoact2"]


def test_every_registered_policy_is_offered_but_style_policies(monkeypatch):
    """LeRobot's own, our baselines and what plugins register later."""
    known = BackboneConfig.get_known_choices()
    assert known["act"] is WithoutOptions  # nobody has asked for its options
    monkeypatch.setattr("sys.argv", ["lerobot-train", "--policy.backbone.chunk_size=4"])
    known = BackboneConfig.get_known_choices()
    assert {"mlp", "act", "diffusion", "smolvla", "beso", "toy"} <= set(known)
    assert not {"bc", "zbc", "wzbc"} & set(known)
    late = type("LateConfig", (known["act"],), {})
    PreTrainedConfig.register_subclass("late", late)
    try:
        assert BackboneConfig.get_choice_class("late") is late
        assert BackboneConfig.get_choice_name(late) == "late"
    finally:
        del PreTrainedConfig._choice_registry["late"]


@pytest.mark.parametrize(
    ("flags", "offered"),
    [
        (["--policy.type=zbc"], set()),
        (["--policy.backbone.type=act", "--policy.backbone.chunk_size=4"], {"act"}),
        (["--policy.backbone.type", "act"], {"act"}),
        (["--policy.path=a", "--policy.backbone.chunk_size=4"], {"act", "diffusion", "smolvla"}),
    ],
)
def test_flags_are_offered_of_what_the_command_line_is_about(monkeypatch, flags, offered):
    """To make those of all policies takes seconds."""
    monkeypatch.setattr("sys.argv", ["lerobot-train", *flags])
    known = BackboneConfig.get_known_choices()
    found = {name for name in ("act", "diffusion", "smolvla") if known[name] is not WithoutOptions}
    assert found == offered


def test_a_style_extends_an_observation_or_is_one():
    """For single observations and for windows; the batch stays."""
    state, z = torch.zeros(2, 3), torch.ones(2, 4)
    for batch, key, expected in (
        ({"observation.state": state}, "state", (2, 7)),
        ({"observation.state": state}, "environment_state", (2, 4)),
        ({"observation.state": torch.zeros(2, 5, 3)}, "state", (2, 5, 7)),
        ({"observation.state": torch.zeros(2, 5, 3)}, "environment_state", (2, 5, 4)),
    ):
        place = StylePlace(key, 4, extends=f"observation.{key}" in batch)
        styled = place.put(batch, z)
        assert styled[f"observation.{key}"].shape == expected
        assert styled[f"observation.{key}"][..., -4:].eq(1).all()
        assert batch.keys() == {"observation.state"}
        assert batch["observation.state"].shape[-1] == 3


def test_features_with_the_style():
    """In the observation's type, the others as they were."""
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (3,))}
    assert StylePlace("state", 4, True).styled(inputs)["observation.state"].shape == (7,)
    styled = StylePlace("environment_state", 4, False).styled(inputs)
    assert styled["observation.environment_state"] == PolicyFeature(FeatureType.ENV, (4,))
    assert inputs["observation.state"].shape == (3,)


@pytest.mark.parametrize("kind", TEXT)
def test_policies_that_turn_the_state_into_text_are_refused_before_they_are_made(kind):
    """In one line that says why, without their packages."""
    backbone = PreTrainedConfig.get_choice_class(kind)(device="cpu")
    with pytest.raises(ValueError, match=rf"type='{kind}' cannot take a style: .* text") as told:
        make_policy_config("zbc", backbone=backbone, device="cpu")
    assert "\n" not in str(told.value)
    make_policy_config("bc", backbone=backbone, device="cpu")


def test_a_policy_that_cannot_be_made_at_all_is_told_as_that(make_styled, small_maze):
    """Not as one that cannot take a style."""
    with pytest.raises(ValueError, match=r"type='toy' cannot be made: RuntimeError: no room"):
        make_styled("zbc", "toy", small_maze, backbone={"reads": "raises"})


@pytest.mark.parametrize("reads", ["nothing", "rounded"])
def test_a_policy_that_a_style_does_not_reach_is_refused(make_styled, small_maze, reads):
    """Nor one that makes steps of it, which no gradient climbs; both places are named with the reason."""
    with pytest.raises(
        ValueError, match=r"cannot take a style, through observation\.environment_state"
    ) as told:
        make_styled("zbc", "toy", small_maze, backbone={"reads": reads})
    assert "through observation.state: its network does not read it" in str(told.value)
    assert "\n" not in str(told.value)


def test_the_place_can_be_chosen(make_styled, small_maze):
    """ACT has both; a place that does not work is refused."""
    assert make_styled("zbc", "act", small_maze).config.style_key == "environment_state"
    policy = make_styled("zbc", "act", small_maze, style_key="state")
    assert policy.backbone.policy.config.robot_state_feature.shape == (12,)
    with pytest.raises(ValueError, match=r"through observation\.environment_state"):
        make_styled("zbc", "toy", small_maze, style_key="environment_state")
    with pytest.raises(ValueError, match="style_key='latent'"):
        make_policy_config("zbc", style_key="latent", device="cpu")


def test_a_padded_state_has_room_for_so_many_numbers(make_styled, camera_arcs):
    """smolvla's is told with the number that fits."""
    with pytest.raises(ValueError, match=r"style_dim=15: .* max_state_dim=16 .* at most 14"):
        make_styled("zbc", "smolvla", camera_arcs, style_dim=15)


def test_making_a_policy_with_a_style_draws_no_other_weights(make_styled, small_maze):
    """Trying leaves random numbers and buffers as they are, whichever place is found."""
    one = make_styled("zbc", "toy", small_maze)
    other = make_styled("zbc", "toy", small_maze, style_key="state")
    assert torch.equal(one.backbone.policy.layer.weight, other.backbone.policy.layer.weight)


def test_options_of_the_network_are_the_backbone_s():
    """Those of mlp would have no effect, and say so."""
    act = PreTrainedConfig.get_choice_class("act")
    for options, message in (
        ({"optimizer_lr": 0.5}, r"policy.optimizer_lr=0.5: belongs to the backbone 'act'"),
        ({"style_lr_scale": 2.0}, r"policy.style_lr_scale=2.0: .* give --policy.style_lr"),
        ({"corrective": "noise"}, r"policy.corrective='noise', policy.backbone.type='act'"),
        ({"style_lr": 0.0}, r"style_lr=0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            make_policy_config("zbc", backbone=act(device="cpu"), device="cpu", **options)


def test_a_noise_predicting_backbone_is_warned_about(caplog):
    """Such a network hardly listens to a style."""
    diffusion = PreTrainedConfig.get_choice_class("diffusion")
    make_policy_config("zbc", backbone=diffusion(device="cpu", prediction_type="sample"), device="cpu")
    assert "prediction_type" not in caplog.text
    make_policy_config("zbc", backbone=diffusion(device="cpu"), device="cpu")
    assert "--policy.backbone.prediction_type=sample" in caplog.text
