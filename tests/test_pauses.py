"""Pauses of a demonstrator: what they are, and that nothing is learned from them."""

import numpy as np
import pytest
import torch
from conftest import make_batch

from lerobot_swr.pauses import pause_frames
from lerobot_swr.policies.lessons import Lesson
from lerobot_swr.trajectories import Trajectories

MOVE = 0.5


def walk(steps: str) -> dict[str, np.ndarray]:
    """An episode on a line: "." stays, ">" moves; the action is the move, the state is seen before it."""
    moves = np.array([MOVE if step == ">" else 0.0 for step in steps], dtype=np.float32)[:, None]
    return {"observation.state": np.cumsum(moves, axis=0) - moves, "action": moves}


def recorded(*episodes: dict[str, np.ndarray]) -> Trajectories:
    """Episodes as a dataset."""
    columns = {key: np.concatenate([episode[key] for episode in episodes]) for key in episodes[0]}
    return Trajectories(np.array([len(e["action"]) for e in episodes]), columns, 10, "walks")


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ("...>>>", "xxx---"),
        (">>>...", "------"),  # what an episode ends with was meant
        ("..>>...>>..", "xx--xxx----"),
        (">.>", "---"),
        (">>>>", "----"),
        ("....", "----"),
    ],
)
def test_a_pause_is_followed_by_a_movement(steps, expected):
    """At the start or on the way; a single frame of another action is no pause."""
    found = pause_frames(recorded(walk(steps), walk(10 * ">")), ["observation.state"], "action")
    shown = "".join("x" if pause else "-" for pause in found[: len(steps)])
    assert shown == expected
    assert not found[len(steps) :].any()


def test_a_slow_movement_is_no_pause():
    """Its steps are as small as a pause's; what it comes to is not."""
    steps = np.concatenate([np.full(20, 0.5), np.full(25, 0.02), np.full(15, 0.5)])
    for action in (steps, np.cumsum(steps)):
        state = np.cumsum(steps) - steps
        episode = {"observation.state": state[:, None], "action": action[:, None]}
        assert not pause_frames(recorded(episode), ["observation.state"], "action").any()


def test_a_dimension_that_only_jitters_hides_no_pause():
    """A sensor's noise is not a movement, however small everything else that it is measured by."""
    episode = walk(">>>....>>>>>>")
    noise = np.random.default_rng(0).normal(scale=1e-6, size=(13, 1))
    episode["observation.state"] = np.concatenate([episode["observation.state"], 1 + noise], axis=1)
    found = pause_frames(recorded(episode), ["observation.state"], "action")
    assert np.flatnonzero(found).tolist() == [3, 4, 5, 6]


def test_targets_are_held_in_a_pause():
    """Absolute actions repeat; the frame that asks for a new target is kept, though nothing moves yet."""
    state = np.array([0, 0, 0, 0, 1, 2, 3, 3], dtype=np.float32)[:, None]
    action = np.array([0, 0, 0, 1, 2, 3, 3, 3], dtype=np.float32)[:, None]
    episode = {"observation.state": state, "action": action}
    found = pause_frames(recorded(episode), ["observation.state"], "action")
    assert found.tolist() == [True, True, True, False, False, False, False, False]


def test_whoever_waits_for_something_that_moves_does_not_pause():
    """While another observation changes there is something to see."""
    episode = walk("...>>>")
    episode["observation.environment_state"] = np.arange(6, dtype=np.float32)[:, None]
    keys = ["observation.state", "observation.environment_state"]
    assert not pause_frames(recorded(episode), keys, "action").any()
    assert pause_frames(recorded(episode), keys[:1], "action").sum() == 3


def test_frames_are_left_out_of_every_episode():
    """`Trajectories.without` keeps order and episodes."""
    dataset = recorded(walk("..>>"), walk(".>"), walk(10 * ">"))
    kept = dataset.without(pause_frames(dataset, ["observation.state"], "action"))
    assert kept.lengths.tolist() == [2, 1, 10]
    assert (kept.columns["action"] == np.float32(MOVE)).all()
    with pytest.raises(ValueError, match="nothing is left of episode 1"):
        dataset.without(np.repeat([False, True, False], dataset.lengths))


@pytest.mark.parametrize("balance", [True, False])
def test_pauses_teach_nothing_and_the_mean_weight_is_one(make_tiny_policy, monkeypatch, balance):
    """Their loss is 0, episodes count alike as before, and so does the loss as a whole."""
    marked = {}

    def mark(trajectories, observations, action):
        marked["pauses"] = np.arange(trajectories.lengths.sum()) % 5 == 1
        return marked["pauses"]

    monkeypatch.setattr("lerobot_swr.policies.training_data.pause_frames", mark)
    policy = make_tiny_policy("zbc", balance_episodes=balance)
    trajectories, pauses = policy.trajectories, marked["pauses"]
    episodes = np.repeat(np.arange(len(trajectories)), trajectories.lengths)
    batch = make_batch(len(episodes))
    batch["episode_index"] = torch.from_numpy(episodes)
    batch["index"] = torch.arange(len(episodes))
    losses, _ = policy.forward(batch, reduction="none")
    weights = policy.balance(Lesson.of(batch), 1).weight.numpy()
    assert (losses.detach().numpy()[pauses] == 0).all()
    assert (losses.detach().numpy()[~pauses] > 0).all()
    assert weights.mean() == pytest.approx(1)
    by_episode = np.bincount(episodes, weights)
    expected = np.full(len(by_episode), weights.mean()) if balance else np.bincount(episodes, ~pauses)
    np.testing.assert_allclose(by_episode / by_episode.sum(), expected / expected.sum(), rtol=1e-5)


def test_pauses_can_be_kept(make_tiny_policy, monkeypatch):
    """`skip_pauses=false` learns every frame, as the paper does."""
    monkeypatch.setattr("lerobot_swr.policies.training_data.pause_frames", lambda *_: pytest.fail("looked"))
    assert make_tiny_policy("zbc", skip_pauses=False).data.pauses is None
