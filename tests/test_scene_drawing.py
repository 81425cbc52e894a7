"""Drawing by scene: styles whose demonstrations began most like the rollout does."""

from collections import Counter

import numpy as np
import pytest
import torch
from conftest import save_checkpoint
from lerobot.configs import PreTrainedConfig

from lerobot_swr.policies.configuration_swr import WZBCConfig
from lerobot_swr.policies.modeling_swr import ZBCPolicy
from lerobot_swr.policies.scene_defaults import adopt_scene_defaults
from lerobot_swr.scene_variation import SceneVariation, scene_variation
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.request import StyleRequest
from lerobot_swr.styles.selection import StyleSelection

FIRST = torch.tensor([[0.0, 0.0, 9.0], [1.0, 0.0, 9.1], [0.0, 10.0, 9.0], [1.0, 10.0, 8.9], [0.5, 5.0, 9.0]])
VARYING = np.array([True, True, False])


def make_cookbook(**options) -> StyleCookbook:
    torch.manual_seed(0)
    cookbook = StyleCookbook(5, 3, 0.1, "scene", scene_dim=3, **options)
    cookbook.scenes.fit(FIRST, VARYING)
    cookbook.trained[:] = 1
    return cookbook


def reload(folder, **options) -> ZBCPolicy:
    flags = [f"--{key}={value}" for key, value in options.items()]
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=flags)
    return ZBCPolicy.from_pretrained(folder, config=config)


def test_the_style_whose_demonstration_began_most_like_now_is_drawn():
    """Each rollout gets the nearest start, every dimension in units of its spread, noise not counted."""
    scene = torch.tensor([[0.1, 1.0, -50.0], [0.9, 8.0, 50.0], [0.5, 5.2, 0.0]])
    cookbook = make_cookbook()
    assert cookbook.draw(3, scene=scene).tolist() == [0, 3, 4]
    units = FIRST.std(dim=0, correction=0)[:2]
    for row in torch.rand(50, 3) * torch.tensor([1.0, 10.0, 9.0]):
        expected = ((FIRST[:, :2] - row[:2]) / units).norm(dim=1).argmin()
        assert cookbook.draw(1, scene=row[None]).tolist() == [int(expected)]


def test_among_the_allowed_styles_the_nearest_is_drawn():
    """A selection, a request of choices and the draw by scene hold together."""
    scene = torch.tensor([[0.4, 3.0, 9.0], [0.3, 9.5, 9.0]])
    cookbook = make_cookbook(selection=StyleSelection(episodes=[2, 4]))
    assert cookbook.draw(2, scene=scene).tolist() == [4, 2]
    cookbook = make_cookbook()
    with cookbook.requested(StyleRequest(choices=[[1, 3], [0, 2]])):
        cookbook.active_styles(4, scene=FIRST[[0, 0, 3, 3]])
    assert cookbook.active.tolist() == [1, 0, 3, 2]


def test_of_several_near_scenes_one_is_drawn_at_random():
    """near_scenes=2 draws each of the two nearest half of the time, and nothing else."""
    cookbook = make_cookbook(near_scenes=2)
    counts = Counter(cookbook.draw(2000, scene=torch.tensor([[0.0, 0.1, 9.0]]).expand(2000, -1)).tolist())
    expected = {0, 4}  # (1, 0) is farther than (.5, 5), in units of the spread
    assert set(counts) == expected
    assert all(abs(count - 1000) < 120 for count in counts.values())


def test_where_scenes_do_not_vary_drawing_by_scene_is_uniform():
    """Without any varying dimension all demonstrations are equally near."""
    cookbook = make_cookbook()
    cookbook.scenes.fit(FIRST, np.zeros(3, dtype=bool))
    counts = Counter(cookbook.draw(5000, scene=torch.zeros(5000, 3)).tolist())
    assert all(abs(counts[i] - 1000) < 150 for i in range(5))


def test_a_style_is_kept_through_the_rollout_and_drawn_anew_on_request():
    """The scene counts when a style is drawn: at first, and again after `end_rollout`."""
    cookbook = make_cookbook()
    cookbook.active_styles(1, scene=FIRST[[0]])
    cookbook.active_styles(1, scene=FIRST[[3]])
    assert cookbook.active.tolist() == [0]
    cookbook.end_rollout()
    cookbook.active_styles(1, scene=FIRST[[3]])
    assert cookbook.active.tolist() == [3]


def test_what_cannot_be_drawn_by_scene_is_told():
    """Without observations, or without first observations of the demonstrations."""
    with pytest.raises(ValueError, match="style_sampling='scene': this needs the observations"):
        make_cookbook().draw(1)
    unknown = StyleCookbook(5, 3, 0.1, "scene", scene_dim=3)
    unknown.trained[:] = 1
    with pytest.raises(ValueError, match="style_sampling='scene': it is not known how"):
        unknown.draw(1, scene=FIRST[:1])


def test_a_checkpoint_knows_how_its_demonstrations_began(make_tiny_policy, small_maze_meta, tmp_path):
    """A loaded policy draws by the batch's own observations, and by a filter's styles only."""
    policy = make_tiny_policy("zbc")
    first = policy.styles.scenes.first.clone()
    starts = policy.data.trajectories.starts
    states = torch.from_numpy(policy.data.trajectories.columns["observation.state"][starts])
    mean, std = (torch.tensor(small_maze_meta.stats["observation.state"][k]) for k in ("mean", "std"))
    torch.testing.assert_close(first[:, :2], ((states - mean) / std).float(), rtol=1e-3, atol=1e-3)
    folder = save_checkpoint(policy, small_maze_meta, tmp_path / "c")
    loaded = reload(folder, style_sampling="scene")
    assert torch.equal(loaded.styles.scenes.first, first)
    loaded.styles.scenes.scale.fill_(1.0)  # as if every dimension varied
    batch = {"observation.state": first[:, :2], "observation.environment_state": first[:, 2:]}
    loaded.select_action(batch)
    apart = (first[loaded.styles.active] - first).abs().max()
    assert apart < 1e-5  # itself, or one that began alike
    some = reload(folder, style_sampling="scene", style_filter="behavior == '20'")
    some.select_action(batch)
    assert {policy.styles.table.columns["behavior"][i] for i in some.styles.active.tolist()} == {"20"}


def test_a_scene_varies_where_starts_differ_by_more_than_noise():
    """Object poses and starts count, a sensor's noise, constants and small jitter do not."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(20, 40, size=50)
    whose = np.repeat(np.arange(50), lengths)
    frames = np.column_stack(
        [
            rng.normal(size=50)[whose],  # a goal
            rng.normal(size=len(whose)),  # noise
            np.full(len(whose), 0.3),  # a constant
            0.01 * rng.normal(size=50)[whose] + np.concatenate([np.linspace(0, 1, n) for n in lengths]),
        ]
    ).astype(np.float32)
    found = scene_variation(frames, lengths, ["goal", "noise", "constant", "path"])
    assert (found.shares > 0).tolist() == [True, False, False, False]
    assert found.shares[0] == pytest.approx(1, abs=0.15)
    assert found.vary
    assert "1 of 4 dimensions of the observation (goal)" in found.describe()
    assert not scene_variation(frames[:, 1:], lengths).vary


@pytest.mark.parametrize("count", [10, 29, 100])
def test_one_reversed_demonstration_makes_no_varying_scene(count: int):
    """A demonstration that was recorded backwards does not change what a fixed start says."""
    rng = np.random.default_rng(0)
    lengths = rng.integers(40, 80, size=count)
    paths = [np.linspace(0, 1, n)[:, None] + 0.002 * rng.normal(size=(n, 1)) for n in lengths]
    assert not scene_variation(np.concatenate(paths), lengths).vary
    paths[3] = paths[3][::-1]
    assert not scene_variation(np.concatenate(paths), lengths).vary


def test_rare_tasks_are_scenes():
    """One of twelve tasks, as ones and zeros, varies although each of them is rare."""
    tasks = np.eye(12)[np.arange(60) % 12]
    found = scene_variation(np.repeat(tasks, 20, axis=0), np.full(60, 20))
    assert found.vary
    assert (found.shares > 0.5).all()


@pytest.mark.parametrize(
    ("vary", "dim", "sampling", "beta"), [(True, 10, "scene", 20.0), (False, 10, "uniform", 10.0)]
)
def test_options_that_are_left_open_are_chosen_by_how_much_scenes_vary(vary, dim, sampling, beta, caplog):
    """One sentence says so; what is given stays, and is commented."""
    variation = SceneVariation(np.array([0.9 if vary else 0.0, 0.0]), ("goal", "x"))
    config = WZBCConfig(style_dim=None, style_sampling=None, beta=None, similarity_frame="box", device="cpu")
    caplog.clear()
    with caplog.at_level("INFO"):
        adopt_scene_defaults(config, variation)
    assert (config.style_dim, config.style_sampling, config.beta) == (dim, sampling, beta)
    (message,) = caplog.messages
    assert f"--policy.style_sampling={sampling}" in message
    given = WZBCConfig(style_dim=7, style_sampling="stratified", beta=5.0, device="cpu")
    with caplog.at_level("INFO"):
        adopt_scene_defaults(given, variation)
    assert (given.style_dim, given.style_sampling, given.beta) == (7, "stratified", 5.0)
    assert ("Recommended: --policy.style_sampling=scene" in caplog.messages[-1]) == vary
