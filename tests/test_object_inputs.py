"""The objects encoder: hand and objects as seen from each other, actions in an object's frame."""

import numpy as np
import pytest
import torch
from test_manner import NAMES, SCENE, STATE, episodes

from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig

ACTION = "action"
ALL_NAMES = {**NAMES, ACTION: ["gripper", "dx", "dy", "dz"]}
DIMENSIONS = {STATE: 4, SCENE: 7}


def normalize(features):
    """Every feature in other units than its own."""
    return {key: 2.0 * value - 0.5 for key, value in features.items()}


def make(names=ALL_NAMES, **options):
    torch.manual_seed(0)
    trajectories, _ = episodes()
    columns = dict(trajectories.columns)
    hand = columns[STATE][:, 1:]
    columns[ACTION] = np.column_stack([np.ones(len(hand)), np.diff(hand, axis=0, append=hand[-1:])])
    columns[ACTION] = columns[ACTION].astype(np.float32)
    config = MLPConfig(16, 2, encoder="objects", **options)
    config.adopt(columns, trajectories.lengths, names)
    backbone = config.make_named(DIMENSIONS, 0, 4, names)
    backbone.fit(columns, normalize)
    return backbone, columns


def moved(columns, angle: float, shift: np.ndarray) -> dict[str, torch.Tensor]:
    """The same frames with hand and box turned about the vertical and shifted together, raw."""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    state, scene = columns[STATE].copy(), columns[SCENE].copy()
    state[:, 1:] = state[:, 1:] @ turn.T + shift
    scene[:, :3] = scene[:, :3] @ turn.T + shift
    w, z = np.cos(angle / 2), np.sin(angle / 2)
    own_w, own_z = columns[SCENE][:, 3], columns[SCENE][:, 6]
    scene[:, 3], scene[:, 6] = w * own_w - z * own_z, w * own_z + z * own_w
    return {STATE: torch.from_numpy(state).float(), SCENE: torch.from_numpy(scene).float()}


def relative_features(backbone, raw) -> torch.Tensor:
    return backbone.encoder(normalize(raw))[:, sum(DIMENSIONS.values()) :]


@pytest.mark.parametrize("multiscale", [True, False])
def test_relative_features_do_not_depend_on_where_the_scene_lies(multiscale):
    """Turning and shifting hand and object together changes the plain observations only."""
    backbone, columns = make(multiscale=multiscale)
    here = {key: torch.from_numpy(columns[key]) for key in (STATE, SCENE)}
    expected = relative_features(backbone, here)
    assert expected.std(dim=0).max() > 0.5
    there = relative_features(backbone, moved(columns, 0.8, np.array([0.3, -0.7, 0.2])))
    torch.testing.assert_close(there, expected, atol=2e-2, rtol=1e-3)


def test_actions_turn_with_the_object():
    """The same outputs, in a turned scene, are the same displacement turned; other dimensions stay."""
    backbone, columns = make()
    scene, outputs = backbone.encoder.scene, torch.randn(len(columns[STATE]), 4)
    here = {key: torch.from_numpy(columns[key]) for key in (STATE, SCENE)}
    first = (backbone.actions(outputs, scene, here) + 0.5) / 2  # raw
    second = (backbone.actions(outputs, scene, moved(columns, 0.8, np.zeros(3))) + 0.5) / 2
    c, s = np.cos(0.8), np.sin(0.8)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float32)
    torch.testing.assert_close(second[:, 1:], first[:, 1:] @ turn.T, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(second[:, 0], first[:, 0])
    assert not bool(backbone.actions.is_target)


def test_actions_that_are_targets_are_seen_from_the_object_about_the_hand():
    """Where an action says where the hand is to go, an output of 0 keeps the hand where it is."""
    backbone, columns = make()
    hand = torch.from_numpy(columns[STATE][:, 1:])
    actions = torch.cat([torch.ones(len(hand), 1), hand + 0.001 * torch.randn_like(hand)], dim=1)
    raw = {key: torch.from_numpy(columns[key]) for key in (STATE, SCENE)}
    scene = backbone.encoder.scene
    backbone.actions.fit(scene, raw, actions, normalize)
    assert bool(backbone.actions.is_target)
    kept = (backbone.actions(torch.zeros(len(hand), 4), scene, raw)[:, 1:] + 0.5) / 2
    torch.testing.assert_close(kept, hand, atol=1e-5, rtol=1e-5)


def test_raw_observations_are_recovered():
    """From whatever normalisation the policy has."""
    backbone, columns = make()
    raw = {key: torch.from_numpy(columns[key]) for key in (STATE, SCENE)}
    found = backbone.encoder.scene.raw(normalize(raw))
    for key, value in raw.items():
        torch.testing.assert_close(found[key], value, atol=1e-5, rtol=1e-5)


def test_the_object_that_moves_most_gives_the_frame():
    """Among several; an explicit one wins; names may be given where the dataset has none."""
    _, columns = make()
    lengths = np.array([len(columns[STATE])])
    scene = np.column_stack([columns[SCENE], columns[SCENE]])
    scene[:, 7] += np.linspace(0, 3, len(scene))
    names = {
        **ALL_NAMES,
        SCENE: [f"{thing}.{part[4:]}" for thing in ("goal", "box") for part in NAMES[SCENE]],
    }
    scene[:, :7] = scene[0, :7]
    for given, expected in ((None, "box"), ("goal", "goal")):
        config = MLPConfig(16, 2, encoder="objects", frame=given)
        config.adopt({**columns, SCENE: scene}, lengths, names)
        assert config.frame == expected
    with pytest.raises(ValueError, match="encoder='objects': no object"):
        MLPConfig(encoder="objects").adopt(columns, lengths, {STATE: NAMES[STATE]})


def test_a_policy_with_object_inputs_trains_and_its_checkpoint_acts_alike(
    make_tiny_policy, small_maze_meta, tmp_path
):
    """Names come from the option where the dataset's say nothing, and travel with the checkpoint."""
    from conftest import make_batch, save_checkpoint

    from lerobot_swr.policies.modeling_swr import ZBCPolicy

    names = {STATE: ["x", "y"], SCENE: ["goal.x", "goal.y"], ACTION: ["dx", "dy"]}
    policy = make_tiny_policy("zbc", backbone=MLPConfig(16, 2, encoder="objects"), dimension_names=names)
    assert policy.config.backbone.frame == "goal"
    policy.train()
    loss, _ = policy.forward(make_batch())
    loss.backward()
    policy.eval()
    loaded = ZBCPolicy.from_pretrained(save_checkpoint(policy, small_maze_meta, tmp_path / "c"))
    style = torch.zeros(32, policy.config.style_dim)
    assert torch.equal(loaded.predict(make_batch(), style), policy.predict(make_batch(), style))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"encoder": "boxes"}, "backbone.encoder='boxes'"),
        ({"frame": "box"}, "needs backbone.encoder=objects"),
    ],
)
def test_bad_options_are_told(options, message):
    """By the configuration, before any work."""
    with pytest.raises(ValueError, match=message):
        MLPConfig(**options)
