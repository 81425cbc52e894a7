"""What similarity compares: states, the hand's path about an object, features; and styles made of it."""

import numpy as np
import pytest
import torch
from conftest import save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from scipy.spatial.distance import cdist

from lerobot_swr.object_poses import find_poses, hand_of
from lerobot_swr.policies.modeling_swr import ZBCPolicy
from lerobot_swr.similarity import Manner, similarity_by
from lerobot_swr.similarity.manner import hand_path
from lerobot_swr.styles.embedding import MannerEmbedding
from lerobot_swr.styles.extension import add_demonstrations
from lerobot_swr.trajectories import Trajectories

STATE, SCENE = "observation.state", "observation.environment_state"
NAMES = {
    STATE: ["desired_x", "x", "y", "z"],
    SCENE: [f"box.{p}" for p in ("x", "y", "z", "qw", "qx", "qy", "qz")],
}


def turned(path: np.ndarray, angle: float, place: np.ndarray) -> np.ndarray:
    """A path (T, 3) about an object that is turned about the vertical and put somewhere."""
    c, s = np.cos(angle), np.sin(angle)
    return path @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + place


def episodes(n: int = 40, seed: int = 0) -> tuple[Trajectories, np.ndarray]:
    """A box somewhere, turned somehow; the hand goes to its left or its right side, as seen from the box."""
    rng = np.random.default_rng(seed)
    sides = rng.integers(0, 2, size=n)
    lengths = rng.integers(15, 25, size=n)
    states, scenes = [], []
    for side, length in zip(sides, lengths, strict=True):
        angle, place = rng.uniform(-1.5, 1.5), rng.uniform(-1, 1, size=3)
        goal = np.array([0.06 if side else -0.06, 0.01 * rng.normal(), 0.05])
        path = np.linspace(goal * 8, goal, length)
        world = turned(path, angle, place)
        states.append(np.column_stack([np.zeros(length), world]))
        quaternion = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
        scenes.append(np.tile([*place, *quaternion], (length, 1)))
    columns = {
        STATE: np.concatenate(states).astype(np.float32),
        SCENE: np.concatenate(scenes).astype(np.float32),
    }
    return Trajectories(lengths, columns, 10, "boxes"), sides


def test_things_are_found_by_the_names_of_dimensions():
    """Separators, orders and kinds of rotation vary; what has no position is no thing."""
    poses = find_poses(
        {
            STATE: ["gripper", "tool_x", "tool_y", "tool_z", "desired_x"],
            SCENE: [
                *("cube.qx", "cube.qy", "cube.qz", "cube.qw", "cube.x", "cube.y", "cube.z"),
                *("goal/x", "goal/y", "goal/theta", "can_pos_x", "can_pos_y"),
                *("can_quat_w", "can_quat_x", "can_quat_y", "can_quat_z"),
            ],
        }
    )
    assert set(poses) == {"tool", "cube", "goal", "can"}
    assert hand_of(poses) == "tool"
    assert poses["cube"].parts["qw"] == 3
    assert poses["cube"].turns
    assert poses["goal"].parts == {"x": 7, "y": 8, "yaw": 9}
    assert poses["can"].parts == {"x": 10, "y": 11, "qw": 12, "qx": 13, "qy": 14, "qz": 15}


def test_a_path_in_an_objects_frame_does_not_depend_on_where_the_object_lies():
    """The same way of approaching it gives the same path, saturating far away."""
    local = np.linspace([0.5, -0.2, 0.3], [0.02, 0.01, 0.05], 12)
    expected = 0.1 * np.tanh(local / 0.1)
    for angle, place in ((0.0, np.zeros(3)), (1.1, np.array([0.4, -2.0, 0.1])), (-3.0, np.ones(3))):
        world = turned(local, angle, place)
        columns = {
            STATE: np.column_stack([np.zeros(12), world]).astype(np.float32),
            SCENE: np.tile([*place, np.cos(angle / 2), 0, 0, np.sin(angle / 2)], (12, 1)).astype(np.float32),
        }
        np.testing.assert_allclose(hand_path(columns, "box", NAMES), expected, atol=2e-6)


def test_similarity_in_an_objects_frame_sees_the_manner_and_the_states_do_not(tmp_path):
    """The nearest other demonstration shows the same side; over raw states that is chance."""
    trajectories, sides = episodes()
    everyone = np.arange(len(sides))

    def agreement(manner: Manner) -> float:
        nearest, _ = similarity_by(trajectories, manner, tmp_path).nearest(everyone, 1, everyone)
        return float((sides[nearest[:, 0]] == sides).mean())

    assert agreement(Manner((), "box", 0.1, NAMES)) == 1.0
    assert agreement(Manner((STATE, SCENE))) < 0.8


def last_state(episode):
    """The last state, as features of an episode."""
    return episode[STATE][-1, 1:]


def test_a_function_says_what_is_compared(tmp_path):
    """Distances are those of the function's numbers."""
    trajectories, _ = episodes(8)
    manner = Manner((), features="test_manner:last_state")
    ends = np.array([last_state(episode) for episode in trajectories.episodes()])
    found = similarity_by(trajectories, manner, tmp_path).distance(np.zeros(8, dtype=int), np.arange(8))
    np.testing.assert_allclose(found, cdist(ends[:1], ends)[0], rtol=1e-6)
    with pytest.raises(ValueError, match=r"similarity_features='test_manner:episodes'"):
        Manner((), features="test_manner:episodes").of(trajectories)


def test_an_object_that_is_not_there_is_told():
    """With those that were found."""
    trajectories, _ = episodes(2)
    with pytest.raises(ValueError, match=r"similarity_frame='cup': .* by their names: box"):
        Manner((), "cup", 0.1, NAMES).of(trajectories)


def test_embedded_styles_are_principal_coordinates():
    """Their distances are those of the padded states, and the first has a standard deviation of 1."""
    trajectories, sides = episodes()
    compared = Manner((), "box", 0.1, NAMES).of(trajectories)
    longest = int(compared.lengths.max())
    padded = np.stack(
        [np.pad(s, ((0, longest - len(s)), (0, 0)), "edge") for s in compared.states(["manner"])]
    )
    vectors = padded.reshape(len(padded), -1).astype(np.float64)
    embedding = MannerEmbedding(39, longest, 3)
    embedding.fit(compared.joined(["manner"]), compared.lengths, np.arange(40))
    z = embedding.of(compared).numpy()
    assert z[:, 0].std() == pytest.approx(1, rel=1e-4)
    apart, expected = cdist(z, z), cdist(vectors, vectors)
    np.testing.assert_allclose(apart, expected * apart[0, 1] / expected[0, 1], atol=1e-3)
    first = z[:, 0] * np.sign(z[sides == 1, 0].mean())
    assert (first > 0).tolist() == (sides == 1).tolist()


def test_new_demonstrations_are_projected_whatever_their_length():
    """Longer ones are cut, shorter ones padded; the same episode has the same style."""
    trajectories, _ = episodes()
    compared = Manner((), "box", 0.1, NAMES).of(trajectories)
    embedding = MannerEmbedding(2, 12, 3)
    embedding.fit(compared.joined(["manner"]), compared.lengths, np.arange(30))
    both = torch.cat([embedding.of(compared.subset([3, 4])), embedding.of(compared.subset([35]))])
    torch.testing.assert_close(both, embedding.of(compared)[[3, 4, 35]])


def test_a_policy_with_embedded_styles_keeps_them_in_training_and_its_checkpoint(
    make_tiny_policy, small_maze_meta, tmp_path
):
    """No optimizer moves them, noise blurs them in training only, a loaded policy has the same."""
    policy = make_tiny_policy("zbc", style_init="similarity", style_dim=2)
    assert policy.config.has_fixed_styles
    assert policy.config.style_noise == 0.1
    z = policy.styles.embedding.weight.detach().clone()
    assert z[:, 0].std(correction=0) == pytest.approx(1, rel=1e-3)
    trained = {id(p) for group in policy.get_optim_params() for p in group["params"]}
    assert id(policy.styles.embedding.weight) not in trained
    policy.train()
    batch = {
        "observation.state": torch.zeros(64, 2),
        "observation.environment_state": torch.zeros(64, 2),
        "action": torch.zeros(64, 2),
        "episode_index": torch.zeros(64, dtype=torch.int64),
    }
    noise = torch.cat([policy.draw(batch).noise for _ in range(40)])
    assert noise.std().item() == pytest.approx(0.1, rel=0.05)
    assert not torch.equal(noise[:64], noise[64:128])
    loaded = ZBCPolicy.from_pretrained(save_checkpoint(policy, small_maze_meta, tmp_path / "c"))
    assert torch.equal(loaded.styles.embedding.weight, z)
    again = loaded.styles.embedded.of(policy.data.compared)
    torch.testing.assert_close(again, z)


def test_styles_may_be_trained_on_from_the_similarity(make_tiny_policy):
    """A learning rate of their own makes them parameters of the optimizer again."""
    policy = make_tiny_policy(
        "wzbc", style_init="similarity", style_dim=2, style_lr_scale=1.0, style_noise=0.0
    )
    trained = {id(p) for group in policy.get_optim_params() for p in group["params"]}
    assert id(policy.styles.embedding.weight) in trained
    assert policy.blur is None


def test_added_demonstrations_are_projected_at_once(make_tiny_policy, small_maze_meta):
    """The style of an episode that was left out is its place among the others, whatever the network."""
    policy = make_tiny_policy("zbc", episodes=[0, 1, 2, 3], style_init="similarity", style_dim=2)
    projected = policy.styles.embedded.of(policy.data.compared)
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=small_maze_meta.stats)
    with torch.no_grad():
        policy.styles.embedding.weight[5] = 7.0  # as if nobody knew
    added = add_demonstrations(policy, preprocessor, policy.trajectories, policy.trajectories, [5])
    assert added.episodes == [5]
    torch.testing.assert_close(policy.styles.embedding.weight[5], projected[5])
    assert policy.styles.allowed().tolist() == [0, 1, 2, 3, 5]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"style_init": "pca"}, "style_init='pca': expected 'normal' or 'similarity'"),
        ({"style_lr_scale": 0.0}, "style_lr_scale=0"),
        ({"similarity_scale": 0.0}, "similarity_scale=0"),
        ({"similarity_features": "a:b", "similarity_frame": "box"}, "similarity_features='a:b' says all"),
    ],
)
def test_bad_options_are_told(options, message):
    """By the configuration, before any work."""
    with pytest.raises(ValueError, match=message):
        PreTrainedConfig.get_choice_class("zbc")(**options)
