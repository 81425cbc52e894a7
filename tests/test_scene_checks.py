"""Own and new scenes: what ``--scenes`` measures, by policies whose answer is known."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from conftest import make_batch, save_checkpoint
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.evaluation.checkpoint import Checkpoint, load_demonstrations
from lerobot_swr.evaluation.scenes import evaluate_scenes, run_in_scenes
from lerobot_swr.evaluation.swaps import swapped_actions
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.run_context import running
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.trajectories import Trajectories

SCENES = Maze2DEnvConfig(task="scenes")


@pytest.fixture(scope="module")
def two_ways(tmp_path_factory):
    """Folder of twelve demonstrations, each in its own scene."""
    root = tmp_path_factory.mktemp("datasets") / "two_ways"
    write_dataset(get_recipe("scenes_maze-two_ways").with_episodes(12), root, seed=3)
    return root


@pytest.fixture(scope="module")
def demonstrations(two_ways):
    """The same, read."""
    return load_demonstrations(LeRobotDatasetMetadata("local/two_ways", root=two_ways))


class Walker(torch.nn.Module):
    """Walks to the door that its style names, then to the goal: straight by what it sees, or by heart."""

    def __init__(self, trajectories, blind):
        super().__init__()
        self.config = SimpleNamespace(style_sampling="uniform", device="cpu", type="walker")
        self.styles = StyleCookbook(len(trajectories), 1, 1.0)
        self.styles.trained[:] = 1
        rule = SCENES.behavior_rule()
        self._doors = torch.tensor([int(rule(e)[0]) for e in trajectories.episodes()])
        self._scenes = torch.tensor(
            np.stack([e["observation.environment_state"][0] for e in trajectories.episodes()])
        )
        self._blind = blind

    def reset(self):
        """Draw a style next."""
        self.styles.end_rollout()

    def select_action(self, batch):
        """(B, 2) the next step."""
        here, scene = batch["observation.state"], batch["observation.environment_state"]
        self.styles.active_styles(len(here))
        if self._blind:
            scene = self._scenes[self.styles.active]
        door = scene.gather(1, 1 + self._doors[self.styles.active][:, None])[:, 0]
        below, near = here[:, 1] < 0.5, (here[:, 0] - door).abs() < 0.05
        height = torch.where(near, 0.53, 0.46)
        aim = torch.where(below[:, None], torch.stack([door, height], 1), scene[:, :2])
        return ((aim - here) / 0.02).clamp(-1, 1)


class Still(torch.nn.Module):
    """A policy without styles that does not move."""

    def __init__(self, n_actions):
        super().__init__()
        self.config = SimpleNamespace(device="cpu", type="still")
        self._n_actions = n_actions

    def reset(self):
        """Nothing to forget."""

    def select_action(self, batch):
        """(B, A) zeros."""
        return torch.zeros(len(batch["observation.state"]), self._n_actions)


def measured(trajectories, kind, blind, n=24):
    """Figures of a walker."""
    walker = Checkpoint(Walker(trajectories, blind), lambda batch: batch, lambda action: action)
    rule = SCENES.behavior_rule()
    found = run_in_scenes(walker, trajectories, SCENES, rule, kind, n, 10, seed=5)
    demonstrated = [rule(episode) for episode in trajectories.episodes()]
    return found, evaluate_scenes(found, kind, demonstrated, rule, SCENES)


def test_own_scenes_are_those_of_the_styles_and_new_ones_are_the_environments(demonstrations):
    """Rollout with style i begins where demonstration i did; new scenes follow the seed, as replays do."""
    own, _ = measured(demonstrations, "own", blind=False)
    new, _ = measured(demonstrations, "new", blind=False)
    env = SCENES.create_rollout_env(24)
    fresh, _ = env.reset(seed=list(range(5, 29)))
    for k in range(24):
        for found in (own, new):
            assert found.rollouts[k].style_episode == found.episodes[k]
            for key in ("observation.state", "observation.environment_state"):
                begun = [one.observations[key][0] for one in (found.rollouts[k], found.replays[k])]
                np.testing.assert_array_equal(*begun)
        recorded = demonstrations.episode(own.episodes[k])
        for key, name in (("observation.state", "agent_pos"), ("observation.environment_state",) * 2):
            np.testing.assert_array_equal(own.rollouts[k].observations[key][0], recorded[key][0])
            name = name.removeprefix("observation.")
            np.testing.assert_array_equal(new.rollouts[k].observations[key][0], fresh[name][k])


def test_the_check_tells_a_policy_that_looks_from_one_that_remembers(demonstrations):
    """Both succeed where they were taught; in new scenes only who looks does, and replay does not."""
    results = {
        (kind, blind): measured(demonstrations, kind, blind)[1] for kind in ("own", "new") for blind in (0, 1)
    }
    for blind in (0, 1):
        own = results["own", blind]
        assert own.success_rate == own.fidelity == own.replay_success_rate == own.replay_fidelity == 1
    looks, remembers = results["new", 0], results["new", 1]
    assert looks.success_rate == looks.fidelity == 1
    assert remembers.success_rate < 0.4
    assert looks.replay_success_rate < 0.4
    assert looks.success_interval.high == 1 > looks.success_interval.low > 0.8


def test_demonstrations_are_drawn_as_the_policy_draws_styles(demonstrations):
    """Stratified: each once before any again; fixed: in their order; of a policy without styles each once."""
    rule, episodes = SCENES.behavior_rule(), {}
    for sampling in ("stratified", "fixed", None):
        walker = Walker(demonstrations, blind=False)
        walker.config.style_sampling = sampling
        policy = walker if sampling else Still(2)
        checkpoint = Checkpoint(policy, lambda batch: batch, lambda action: action)
        found = run_in_scenes(checkpoint, demonstrations, SCENES, rule, "own", 12, 5, seed=1)
        episodes[sampling] = found.episodes
    assert sorted(episodes["stratified"]) == sorted(episodes[None]) == list(range(12))
    assert episodes["fixed"] == list(range(12)) != episodes["stratified"]


@pytest.mark.parametrize("kind", ["own", "new"])
@pytest.mark.parametrize("policy_type", ["bc", "zbc"])
def test_the_command_reports_success_fidelity_and_blind_replay(
    run_command, two_ways, tmp_path, capsys, kind, policy_type
):
    """In ``behaviors.json`` and in the terminal, also for a policy without styles."""
    meta = LeRobotDatasetMetadata("local/two_ways", root=two_ways)
    options = {"backbone": MLPConfig(16, 3), "device": "cpu", "push_to_hub": False}
    with running(DatasetConfig("local/two_ways")):
        policy = make_policy(make_policy_config(policy_type, **options), ds_meta=meta)
    folder = save_checkpoint(policy, meta, tmp_path / "policy")
    run_command(
        eval_command.main,
        f"--policy.path={folder}",
        "--env.type=maze2d",
        "--env.task=scenes",
        "--env.episode_length=100",
        f"--dataset.root={two_ways}",
        f"--scenes={kind}",
        "--n_episodes=12",
        f"--output_dir={tmp_path / 'out'}",
    )
    written = json.loads((tmp_path / "out" / "behaviors.json").read_text())
    scenes = written["scenes"]
    assert scenes["kind"] == kind
    assert scenes["success_rate"] == written["success_rate"]
    assert (scenes["replay_success_rate"] == 1) == (kind == "own")
    if policy_type == "zbc":
        assert scenes["fidelity"] == written["style_fidelity"]
    assert "blind success" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ["--env.type=maze2d", "--scenes=own"],
            "scenes='own': every episode of env.type='maze2d', env.task='medium'",
        ),
        (["--env.type=maze2d", "--env.task=scenes", "--scenes=old"], "scenes='old': expected 'own' or 'new'"),
        (["--scenes=new"], "--scenes: no effect on check.type='offline'; for rollouts in an environment"),
        (
            ["--env.type=maze2d", "--env.task=scenes", "--scenes=new", "--recorded_starts=true"],
            "--recorded_starts: no effect on check.type='behaviors' with --scenes=new",
        ),
    ],
)
def test_what_cannot_be_measured_is_refused_before_any_work(run_command, two_ways, capsys, flags, message):
    """Tasks with one scene, unknown kinds, and flags that would have no effect."""
    with pytest.raises(SystemExit):
        run_command(eval_command.main, "--policy.path=nowhere", f"--dataset.root={two_ways}", *flags)
    assert message in capsys.readouterr().err


def test_the_arms_contexts_are_scenes(tmp_path):
    """Aligning: an own scene is the recorded place of box and target; blind replay succeeds there."""
    pytest.importorskip("mujoco")
    recipe = get_recipe("d3il_aligning")
    first = next(iter(recipe.demonstrations(0)))
    episode = {**first.observations, "action": first.actions}
    cfg = D3ILEnvConfig(task="aligning", episode_length=len(first.actions) + 5)
    trajectories = Trajectories(np.array([len(first.actions)]), episode, 29, "one")
    checkpoint = Checkpoint(Still(3), lambda batch: batch, lambda action: action)
    rule = cfg.behavior_rule()
    for kind in ("own", "new"):
        found = run_in_scenes(checkpoint, trajectories, cfg, rule, kind, 1, 1, seed=0)
        box = found.rollouts[0].observations["observation.environment_state"][0, :2]
        recorded = episode["observation.environment_state"][0, :2]
        assert np.allclose(box, recorded, atol=1e-3) == (kind == "own")
        assert found.replays[0].success == (kind == "own")
        assert not found.rollouts[0].success


def test_swapping_tells_what_a_network_obeys(make_tiny_policy):
    """Without weights on z only the observation moves the actions, and the other way round."""
    for kept, silent in (("observation", slice(4, None)), ("style", slice(0, 4))):
        policy = make_tiny_policy("zbc", style_init_scale=1.0).eval()
        first = next(layer for layer in policy.backbone.modules() if isinstance(layer, torch.nn.Linear))
        with torch.no_grad():
            first.weight[:, silent] = 0
        moved = swapped_actions(policy, make_batch())
        assert getattr(moved, kept) > 0
        assert moved.style + moved.observation == getattr(moved, kept)
    with pytest.raises(ValueError, match="a 'bc' policy has no styles to swap"):
        swapped_actions(make_tiny_policy("bc"), make_batch())
