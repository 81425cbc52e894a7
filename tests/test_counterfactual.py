"""The steering checks: requested against shown behaviours, lengths in a band, blends."""

import json

import numpy as np
import pytest
from conftest import make_batch, save_checkpoint
from lerobot.configs import PreTrainedConfig

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.evaluation.checkpoint import load_checkpoint
from lerobot_swr.evaluation.checks.blend import DIFFERENT, SAME, SHARES, draw_pairs, run_blends
from lerobot_swr.evaluation.checks.counterfactual import (
    evaluate_counterfactual,
    format_counterfactual,
    path_distance,
    plan_requests,
)
from lerobot_swr.evaluation.checks.length import evaluate_length_control, frames_after_end
from lerobot_swr.evaluation.rollouts import Rollout, run_rollouts
from lerobot_swr.trajectories import load_trajectories

LABELS = ["a", "a", "b", "c", "a"]


def test_every_behavior_is_requested_once_per_start_and_its_styles_take_turns():
    """The plan against counting."""
    plan = plan_requests([0, 1, 2, 3, 4], LABELS, per_behavior=6, seed=0)
    assert len(plan) == 18
    for start in range(6):
        assert sorted(LABELS[episode] for k, episode in plan if k == start) == ["a", "b", "c"]
    used = [episode for _, episode in plan if LABELS[episode] == "a"]
    assert sorted(used[:3]) == sorted(used[3:]) == [0, 1, 4]
    assert {episode for _, episode in plan_requests([1, 3], LABELS, 2, 0)} == {1, 3}


def test_path_distance_pads_with_the_last_state():
    """By hand: (0, 1, 1) against (0, 3, 5) has squared differences 0, 4, 16."""
    short, long = np.array([[0.0], [1.0]]), np.array([[0.0], [3.0], [5.0]])
    assert path_distance(short, long) == path_distance(long, short) == pytest.approx(np.sqrt(20 / 3))
    assert path_distance(long, long) == 0


def make_rollout(states: list[float], behavior: str, style: int) -> Rollout:
    """A rollout on a line."""
    observations = {"observation.state": np.array(states)[:, None]}
    return Rollout(observations, behavior, True, len(states) - 1, 1.0, style)


def test_the_confusion_matrix_counts_and_distances_are_to_the_requested_demonstration():
    """Three rollouts, one of which shows another behaviour and is nearer to another demonstration."""
    demonstrations = [np.array([[0.0], [1.0]]), np.array([[0.0], [-1.0]])]
    rollouts = [
        make_rollout([0, 1], "right", 0),
        make_rollout([0, -1], "left", 0),
        make_rollout([0, -1], "left", 1),
    ]
    result = evaluate_counterfactual(rollouts, [0, 1, 0], ["right", "left"], demonstrations)
    assert result.confusion == {"right": {"right": 1, "left": 1}, "left": {"left": 1}}
    assert result.control_accuracy == pytest.approx(2 / 3)
    assert result.accuracy_by_behavior == {"right": 0.5, "left": 1.0}
    assert result.distance == pytest.approx(np.sqrt(2) / 3)
    assert result.distance_to_others == pytest.approx(2 * np.sqrt(2) / 3)
    assert result.nearest_is_requested == pytest.approx(2 / 3)
    text = format_counterfactual(result)
    assert "0.500" in text
    assert "0 (right -> left)" in text
    assert '--policy.style_filter="episode not in [0]"' in text


def test_length_control_counts_both_kinds_of_episodes_alike():
    """Rollouts that end 3 steps before their demonstrations stop recording match them exactly."""
    demonstrations = [60, 70, 72, 78, 80, 95]
    perfect = evaluate_length_control([67, 69, 75, 77], demonstrations, (70, 80), after_end=3)
    assert perfect.l1 == 0
    assert perfect.in_band == 1
    assert perfect.n_demonstrations == 4
    assert perfect.reference_histogram == {"70": 0.5, "75": 0.25, "80": 0.25}
    far = evaluate_length_control([100, 101, 69, 68], demonstrations, (70, 80))
    assert far.l1 == 2
    assert far.in_band == 0.5
    with pytest.raises(ValueError, match=r"check\.band=\[1, 2\]: .* 60 to 95 frames"):
        evaluate_length_control([70], demonstrations, (1, 2))


def test_maze_demonstrations_record_frames_after_the_goal(small_maze_meta):
    """The recipe's demonstrator records three frames in the goal disc; the environment ends at the first."""
    trajectories = load_trajectories(small_maze_meta, ["observation.state"])
    assert frames_after_end(trajectories, Maze2DEnvConfig(task="small")) == 3


def test_pairs_are_of_the_kind_they_say():
    """Same or different behaviour, no pair twice."""
    pairs = draw_pairs(range(5), LABELS, 4, seed=0)
    assert sorted(pairs[SAME]) == [(0, 1), (0, 4), (1, 4)]
    assert len(set(pairs[DIFFERENT])) == 4
    assert all(LABELS[i] != LABELS[j] for i, j in pairs[DIFFERENT])


@pytest.fixture
def checkpoint(make_tiny_policy, small_maze_meta, tmp_path):
    """Folder of a tiny policy."""
    policy = make_tiny_policy("zbc")
    policy.train()
    policy.forward(make_batch())
    return save_checkpoint(policy.eval(), small_maze_meta, tmp_path / "checkpoint")


def test_the_commands_write_what_they_measure(checkpoint, small_maze, tmp_path, run_command, capsys):
    """Three ``--check.type``s with their options; each writes its result and its picture."""
    flags = [
        f"--policy.path={checkpoint}",
        "--env.type=maze2d",
        "--env.task=small",
        "--env.episode_length=15",
        f"--dataset.root={small_maze}",
        f"--output_dir={tmp_path / 'out'}",
    ]
    run_command(eval_command.main, *flags, "--check.type=counterfactual", "--check.starts=3")
    run_command(eval_command.main, *flags, "--check.type=blend", "--check.pairs=1")
    run_command(eval_command.main, *flags, "--check.type=length", "--check.band=[1,500]", "--n_episodes=4")
    out = tmp_path / "out"
    counterfactual = json.loads((out / "counterfactual.json").read_text())
    assert counterfactual["n_episodes"] == 6
    assert [e["requested"] for e in counterfactual["episodes"]] == ["10", "20"] * 3
    assert len(json.loads((out / "blend.json").read_text())["episodes"]) == 2 * len(SHARES)
    assert json.loads((out / "length_control.json").read_text())["n_demonstrations"] == 6
    for name in ("counterfactual", "blend", "length_control"):
        assert (out / f"{name}.png").stat().st_size > 1000
    assert "control accuracy" in capsys.readouterr().out


def test_blends_leave_the_policy_as_it_was_and_start_at_its_styles(checkpoint):
    """Share 0 and 1 are the ends' own rollouts; afterwards the cookbook is the policy's own again."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    loaded = load_checkpoint(config)
    original = loaded.policy.styles
    env = Maze2DEnvConfig(task="small", episode_length=10)
    rule = env.behavior_rule()
    result, rollouts = run_blends(loaded, env, rule, ["10"] * 6, 1, 9, seed=0)
    assert loaded.policy.styles is original
    assert result.n_pairs == {SAME: 1}
    for end, rollout in zip(result.episodes[0]["episodes"], (rollouts[0], rollouts[-1]), strict=True):
        original.select([end])
        (own,) = run_rollouts(loaded, env, rule, 1, 1, seed=0)
        paths = [r.observations["observation.state"] for r in (own, rollout)]
        assert np.allclose(*paths, atol=1e-6)
