"""Rollouts of the baselines: history, chunks, environments that do not see each other."""

import numpy as np
import pytest
import torch
from conftest import CHUNK, OBSERVATIONS, WINDOW, make_windows
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.policies.factory import make_policy_config

from lerobot_swr.policies.baselines.history import ObservationHistory

BASELINES = ("ddpm_gpt", "ddpm_act", "beso")


def generators(seeds):
    return [torch.Generator().manual_seed(int(seed)) for seed in seeds]


@pytest.mark.parametrize("policy_type", BASELINES)
def test_a_batch_of_one_is_a_row_of_a_larger_batch(make_baseline, policy_type):
    """Environments do not see each other, each has noise of its own."""
    policy = make_baseline(policy_type)
    history = make_windows(policy_type=policy_type)
    window = {
        **{key: history[key] for key in OBSERVATIONS},
        "is_pad": torch.arange(WINDOW).expand(32, -1) < 2,
    }
    policy.reset()
    drawn = policy.sample(window, generators(range(32)))
    assert drawn.shape == (32, CHUNK if policy_type == "ddpm_act" else 1, 2)
    assert len(drawn[:, 0].unique(dim=0)) > 16  # not all: some are clipped
    for row in (0, 17):
        policy.reset()
        alone = policy.sample({key: value[row : row + 1] for key, value in window.items()}, generators([row]))
        torch.testing.assert_close(alone, drawn[row : row + 1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("policy_type", BASELINES)
def test_a_finished_environment_does_not_disturb_the_others(make_baseline, policy_type):
    """The first environment starts anew in the middle; the second one's actions stay the same."""
    policy = make_baseline(policy_type)

    def actions_of_the_second(jump: float) -> torch.Tensor:
        torch.manual_seed(3)
        policy.reset()
        steps = []
        for step in range(12):
            observations = make_windows(n_windows=2, seed=step)
            now = {key: observations[key][:, 0].clone() for key in OBSERVATIONS}
            if step > 4:
                now[OBSERVATIONS[0]][0] += jump
            steps.append(policy.select_action(now)[1])
        return torch.stack(steps)

    torch.testing.assert_close(actions_of_the_second(0.0), actions_of_the_second(5.0), rtol=1e-4, atol=1e-4)


def test_the_history_is_what_the_dataset_gives(small_maze):
    """Fed frame by frame, window and padding equal those of LeRobot's dataset, from the first frame on."""
    meta = LeRobotDatasetMetadata("local/small_maze", root=small_maze)
    timestamps = resolve_delta_timestamps(make_policy_config("beso", device="cpu"), meta)
    dataset = LeRobotDataset("local/small_maze", root=small_maze, delta_timestamps=timestamps)
    history = ObservationHistory(OBSERVATIONS, WINDOW)
    for episode in (0, 1):
        history.clear()
        first = meta.episodes[episode]["dataset_from_index"]
        for index in range(first, first + 8):
            frame = dataset[index]
            history.push({key: frame[key][-1][None] for key in OBSERVATIONS})
            window = history.window()
            for key in OBSERVATIONS:
                assert torch.equal(window[key][0], frame[key])
            assert torch.equal(window["is_pad"][0], frame["observation.state_is_pad"])


def test_the_number_of_environments_is_fixed_within_a_rollout(make_baseline):
    """The error says what to do."""
    policy = make_baseline("beso")
    frames = {key: torch.zeros(4, 2) for key in OBSERVATIONS}
    policy.select_action(frames)
    with pytest.raises(ValueError, match=r"batch of 3 .* rollout of 4 .*policy.reset\(\)"):
        policy.select_action({key: value[:3] for key, value in frames.items()})
    policy.reset()
    assert policy.select_action({key: value[:3] for key, value in frames.items()}).shape == (3, 2)


def test_a_chunk_is_executed_whole_before_the_next_is_planned(make_baseline, monkeypatch):
    """ddpm_act denoises at steps 0, 4, 8, ..., from the five latest observations."""
    policy = make_baseline("ddpm_act")
    windows = []

    def sample(window):
        windows.append(window[OBSERVATIONS[0]][0, :, 0].tolist())
        return torch.arange(4.0).reshape(1, 4, 1).expand(3, 4, 2) + 10 * len(windows)

    monkeypatch.setattr(policy, "sample", sample)
    policy.reset()
    actions = [
        policy.select_action({key: torch.full((3, 2), float(i)) for key in OBSERVATIONS}) for i in range(9)
    ]
    assert [a[0, 0].item() for a in actions] == [10, 11, 12, 13, 20, 21, 22, 23, 30]
    assert windows == [[0.0] * 5, [0, 1, 2, 3, 4], [4, 5, 6, 7, 8]]


def test_beso_starts_from_the_actions_that_were_executed(make_baseline, monkeypatch):
    """The newest action starts as noise of size σ_max, those before it as what was done."""
    policy = make_baseline("beso", sigma_min=0.001, sigma_max=0.002)
    starts, denoise = [], policy.process.denoise

    def record(network, actions, *rest):
        starts.append(actions.clone())
        return denoise(network, actions, *rest)

    monkeypatch.setattr(policy.process, "denoise", record)
    policy.reset()
    done = torch.stack(
        [policy.select_action({key: torch.ones(6, 2) for key in OBSERVATIONS}) for _ in range(7)], 1
    )
    assert 0 < starts[0].abs().max() < 0.02
    torch.testing.assert_close(starts[2][:, 2:4], done[:, :2])
    torch.testing.assert_close(starts[6][:, :4], done[:, 2:6])
    assert 0 < starts[6][:, 4].abs().max() < 0.02


@pytest.mark.parametrize("policy_type", BASELINES)
def test_actions_stay_within_those_of_the_demonstrations(make_baseline, small_maze_meta, policy_type):
    """The bounds are the dataset's least and largest actions, normalised by hand."""
    policy = make_baseline(policy_type)
    stats = small_maze_meta.stats["action"]
    low, high = ((stats[key] - stats["mean"]) / stats["std"] for key in ("min", "max"))
    np.testing.assert_allclose(policy.action_low, low, rtol=1e-4)
    np.testing.assert_allclose(policy.action_high, high, rtol=1e-4)
    actions = policy.predict_action_chunk({key: 9 * torch.randn(200, 2) for key in OBSERVATIONS})
    assert (actions >= policy.action_low).all()
    assert (actions <= policy.action_high).all()
