"""Playback with feedback, and the evaluation of robustness."""

import json

import numpy as np
import pytest
import torch

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.evaluation.behavior_evaluation import evaluate_behaviors
from lerobot_swr.evaluation.checks.robustness import perturbed
from lerobot_swr.evaluation.metrics import median_interval
from lerobot_swr.evaluation.playback import PlaybackPolicy, playback_checkpoint
from lerobot_swr.evaluation.rollouts import Rollout, run_rollouts
from lerobot_swr.trajectories import load_trajectories

STATE = "observation.state"
ENV = ("--env.type=maze2d", "--env.task=small", "--env.episode_length=80")


@pytest.fixture(scope="module")
def demonstrations(small_maze_meta):
    """The small maze's demonstrations."""
    return load_trajectories(small_maze_meta, [STATE, "action"])


def test_playback_repeats_its_demonstration(demonstrations):
    """From its own start, step by step: the demonstration's states and its length."""
    env = Maze2DEnvConfig(task="small", episode_length=80)
    checkpoint = playback_checkpoint(demonstrations, "fixed")
    rollouts = run_rollouts(checkpoint, env, env.behavior_rule(), 6, 6, seed=0)
    assert [rollout.style_episode for rollout in rollouts] == list(range(6))
    for rollout in rollouts:
        demonstrated = demonstrations.episode(rollout.style_episode)
        assert rollout.success
        assert rollout.behavior == env.behavior_rule()(demonstrated)
        assert abs(rollout.length - env.steps_to_end(demonstrated)) <= 1
        path = demonstrated[STATE][: rollout.length + 1]
        np.testing.assert_allclose(rollout.observations[STATE][: len(path)], path, atol=0.01)


def test_rollouts_do_not_depend_on_those_before_them(demonstrations):
    """Fewer rollouts than styles, each style once: the same styles again with the same seed."""
    env = Maze2DEnvConfig(task="small", episode_length=20)
    checkpoint = playback_checkpoint(demonstrations, "stratified")
    drawn = [
        [r.style_episode for r in run_rollouts(checkpoint, env, env.behavior_rule(), 4, 3, seed=1)]
        for _ in range(3)
    ]
    assert drawn[0] == drawn[1] == drawn[2]
    assert len(set(drawn[0])) == 4


def test_playback_comes_back_where_blind_replay_does_not(demonstrations):
    """Pushed aside, playback ends within a step of where the undisturbed one does; open loop stays aside."""
    policy = PlaybackPolicy(demonstrations, "fixed")
    policy.reset()
    states = torch.from_numpy(demonstrations.columns[STATE][demonstrations.starts]) + 0.05
    blind = states.clone()
    for t in range(30):
        states = states + 0.02 * policy.select_action({STATE: states})
        rows = torch.from_numpy(demonstrations.starts + t)
        blind = blind + 0.02 * torch.from_numpy(demonstrations.columns["action"])[rows]

    def distance(points: torch.Tensor) -> float:
        ways = [torch.from_numpy(e[STATE]) for e in demonstrations.episodes()]
        return max(float((w - p).norm(dim=1).min()) for w, p in zip(ways, points, strict=True))

    assert distance(states) < 0.02
    assert distance(blind) > 0.03


def test_the_command_evaluates_every_perturbation(run_command, small_maze, tmp_path):
    """--check.type=robustness with the baseline: one row per perturbation, none first, each style once."""
    flags = (
        "--baseline=playback",
        "--check.type=robustness",
        "--n_episodes=6",
        f"--dataset.root={small_maze}",
    )
    run_command(eval_command.main, *flags, f"--output_dir={tmp_path}", *ENV)
    result = json.loads((tmp_path / "robustness.json").read_text())
    names = [cell["perturbation"] for cell in result["cells"]]
    assert names == ["as it is", *Maze2DEnvConfig(task="small").perturbations()]
    assert result["style_sampling"] == "stratified"
    assert result["provenance"]["policy"] == "playback"
    for cell in result["cells"]:
        low, high = cell["success_interval"]["low"], cell["success_interval"]["high"]
        assert low <= cell["success_rate"] <= high
        assert cell["env"] == perturbed(Maze2DEnvConfig(task="small"))[cell["perturbation"]]
        assert (cell["l1_floor"], cell["l1_floor_band"]["high"]) == (0, 0)  # each style once
    undisturbed = result["cells"][0]
    assert (undisturbed["success_rate"], undisturbed["style_match"], undisturbed["l1"]) == (1, 1, 0)


def test_an_interrupted_evaluation_keeps_what_it_has(run_command, small_maze, tmp_path, monkeypatch):
    """The second perturbation fails: the first one's results are in the file, with their provenance."""
    calls = []

    def fail_later(*args, **kwargs):
        calls.append(args)
        if len(calls) == 2:
            raise RuntimeError("power cut")
        return run_rollouts(*args, **kwargs)

    monkeypatch.setattr("lerobot_swr.evaluation.checks.robustness.run_rollouts", fail_later)
    flags = (
        "--baseline=playback",
        "--check.type=robustness",
        "--n_episodes=3",
        f"--dataset.root={small_maze}",
    )
    with pytest.raises(RuntimeError, match="power cut"):
        run_command(eval_command.main, *flags, f"--output_dir={tmp_path}", *ENV)
    result = json.loads((tmp_path / "robustness.json").read_text())
    assert [cell["perturbation"] for cell in result["cells"]] == ["as it is"]
    assert result["provenance"]["seed"] == 1000
    assert [path.name for path in tmp_path.iterdir()] == ["robustness.json"]


def test_only_the_given_episodes_are_played_and_compared_with(
    run_command, small_maze, demonstrations, tmp_path
):
    """--dataset.episodes: no other demonstration is known to the baseline, nor in the histogram."""
    shown = [Maze2DEnvConfig(task="small").behavior_rule()(episode) for episode in demonstrations.episodes()]
    chosen = [shown.index("10"), shown.index("20")]
    flags = ("--baseline=playback", "--n_episodes=8", f"--dataset.root={small_maze}", *ENV)
    more = (f"--dataset.episodes={chosen}", "--style_sampling=stratified")
    run_command(eval_command.main, *flags, *more, f"--output_dir={tmp_path}")
    result = json.loads((tmp_path / "behaviors.json").read_text())
    assert sorted(episode["style_episode"] for episode in result["episodes"]) == sorted(chosen * 4)
    assert result["reference_histogram"] == {"10": 0.5, "20": 0.5}
    assert (result["style_fidelity"], result["l1"]) == (1, 0)
    run_command(eval_command.main, *flags, *more, "--check.type=robustness", f"--output_dir={tmp_path}")
    undisturbed = json.loads((tmp_path / "robustness.json").read_text())["cells"][0]
    assert (undisturbed["style_match"], undisturbed["l1"], undisturbed["l1_floor"]) == (1, 0, 0)


def test_playback_of_some_demonstrations_is_that_of_a_dataset_of_them(demonstrations):
    """The others leave no trace in its actions."""
    some = PlaybackPolicy(demonstrations, "fixed", [1, 3])
    alone = PlaybackPolicy(demonstrations.subset([1, 3]), "fixed")
    states = torch.from_numpy(demonstrations.columns[STATE][demonstrations.starts]) + 0.03
    for policy in (some, alone):
        policy.reset()
    actions = [policy.select_action({STATE: states}) for policy in (some, alone)]
    assert some.styles.active.tolist() == [1, 3] * 3
    assert torch.equal(*actions)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--check.type=counterfactual", "--n_episodes=7", *ENV), ("--n_episodes", "'counterfactual'")),
        (("--check.type=counterfactual", "--dataset.episodes=[1]", *ENV), ("--dataset.episodes",)),
        (("--check.type=blend", "--style_sampling=fixed", *ENV), ("--style_sampling", "'blend'")),
        (("--check.type=blend", "--policy.style_sampling=fixed", *ENV), ("--policy.style_sampling",)),
        (("--check.type=length", "--behavior_rule=a:b", *ENV), ("--behavior_rule", "'length'")),
        (("--check.type=offline", *ENV), ("'offline'", "--env.type")),
        (("--check.type=replay", *ENV), ("'replay'", "--policy.path")),
        (("--style_sampling=fixed", "--policy.style_sampling=uniform", *ENV), ("--policy.style_sampling",)),
        (("--baseline=playback", "--policy.type=zbc", *ENV), ("baseline='playback'", "--policy.*")),
        (("--check.type=robustness",), ("'robustness'", "--env.type")),
    ],
)
def test_flags_without_effect_are_refused(run_command, small_maze, tmp_path, capsys, flags, named):
    """The error names the flag and the check, before anything is loaded."""
    path = () if "--baseline=playback" in flags else ("--policy.path=x",)
    with pytest.raises(SystemExit):
        run_command(
            eval_command.main,
            *flags,
            *path,
            f"--dataset.root={small_maze}",
            f"--output_dir={tmp_path / 'out'}",
        )
    error = capsys.readouterr().err
    assert all(flag in error for flag in named)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--baseline=rewind", *ENV), "baseline='rewind': expected 'playback' or 'replay'"),
        (("--baseline=playback", "--policy.path=x", *ENV), "leave out --policy.path"),
        (("--baseline=playback",), "acts in an environment"),
        (("--baseline=playback", "--check.type=blend", *ENV), "check.type='blend' does not allow"),
        (("--baseline=playback", "--check.type=length", "--check.band=[3]", *ENV), "check.band=[3]"),
    ],
)
def test_what_the_baseline_cannot_do_is_told(run_command, small_maze, tmp_path, capsys, flags, message):
    """One line that names the flag."""
    with pytest.raises(SystemExit):
        run_command(eval_command.main, *flags, f"--dataset.root={small_maze}", f"--output_dir={tmp_path}")
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flag", "instead"),
    [
        ("--robustness=true", "--check.type=robustness"),
        ("--counterfactual=40", "--check.type=counterfactual --check.starts=40"),
        ("--blend=40", "--check.type=blend --check.pairs=40"),
        ("--length_band=[70,80]", "--check.type=length --check.band=[70,80]"),
    ],
)
def test_former_flags_tell_what_they_became(run_command, capsys, flag, instead):
    """One line, with what to write."""
    with pytest.raises(SystemExit):
        run_command(eval_command.main, flag, "--policy.path=x", "--dataset.root=y", *ENV)
    error = capsys.readouterr().err
    assert error.strip().count("\n") == 0
    assert f"{flag.partition('=')[0]} became a check: write {instead}" in error


def test_only_doors_ahead_of_the_start_are_expected():
    """A start beyond a wall cannot pass its door; D3IL expects all of the behaviour."""
    env = Maze2DEnvConfig(task="medium")
    starts = {0.1: "6410", 0.3: "410", 0.6: "10", 0.8: "0"}
    for y, expected in starts.items():
        assert env.expected_behavior("6410", {STATE: np.array([[0.5, y]])}) == expected
    assert D3ILEnvConfig().expected_behavior("top-mid-bottom", {}) == "top-mid-bottom"


def test_style_match_and_length_error_follow_the_requested_demonstrations():
    """Recomputed by hand: the length error is over successes that show what was asked for."""

    def rollout(y, behavior, success, length, episode):
        return Rollout({STATE: np.array([[0.5, y]])}, behavior, success, length, float(success), episode)

    rollouts = [
        rollout(0.1, "6410", True, 50, 0),  # as asked, 2 steps longer
        rollout(0.3, "410", True, 40, 0),  # as far as possible, 8 steps shorter
        rollout(0.1, "7420", True, 48, 0),  # another way
        rollout(0.1, "64", False, 200, 0),  # a failure
    ]
    result = evaluate_behaviors(
        rollouts,
        ["6410", "7420"],
        "fixed",
        demonstrated_lengths=[48, 60],
        env_cfg=Maze2DEnvConfig(task="medium"),
    )
    assert result.style_fidelity == 0.5
    assert result.style_fidelity_interval.low < 0.5 < result.style_fidelity_interval.high
    assert result.length_error == 5.0
    assert (result.length_error_interval.low, result.length_error_interval.high) == (2.0, 8.0)


def test_the_interval_of_a_median_covers_it():
    """In about 95 % of samples from a known distribution."""
    rng = np.random.default_rng(0)
    intervals = [median_interval(rng.exponential(size=80)) for _ in range(200)]
    covered = np.mean([interval.low <= np.log(2) <= interval.high for interval in intervals])
    assert 0.88 <= covered <= 0.995
