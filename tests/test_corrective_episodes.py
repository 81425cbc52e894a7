"""Episodes that are left out of a training: corrective labels learn nothing of them."""

import json

import numpy as np
import pytest
import torch
from corrective_policies import ACTION, STATE, batch_of, make
from lerobot.configs.default import DatasetConfig

from lerobot_swr.corrective.inverse_model import fit_inverse_model
from lerobot_swr.run_context import running


@pytest.mark.parametrize(("way", "balanced"), [("flag", True), ("file", False)])
def test_episodes_left_out_shape_nothing(small_maze, tmp_path, monkeypatch, way, balanced):
    """J, R², ranges and limits are those of a dataset that never had the other episodes."""
    chosen = [0, 2, 3, 5]
    if way == "flag":
        argv = ["lerobot-train", f"--dataset.episodes={chosen}"]
    else:
        file = tmp_path / "train_config.json"
        file.write_text(json.dumps({"dataset": {"episodes": chosen}}))
        argv = ["lerobot-train", f"--config_path={file}"]
    monkeypatch.setattr("sys.argv", argv)
    policy, _ = make(small_maze, corrective="demos", balance_episodes=balanced)
    subset = policy.trajectories.subset(chosen)
    model = fit_inverse_model(subset)
    assert policy.config.inverse_r2 == pytest.approx(model.r2, abs=1e-4)
    feedback = policy.correct.stream.labels.feedback
    np.testing.assert_array_equal(feedback.paths.range, np.ptp(subset.columns[STATE], axis=0))
    np.testing.assert_allclose(feedback.limits, np.abs(subset.columns[ACTION]).max(axis=0))
    # Styles keep their episodes' numbers.
    drawn = policy.draw(batch_of(policy, policy.data.meta, torch.zeros(400, dtype=torch.int64)))
    styles = drawn.episode[drawn.corrective]
    assert set(styles.tolist()) == set(chosen)
    torch.testing.assert_close(drawn.weight[drawn.corrective], policy.balance.factors[styles])


def test_held_out_episodes_lend_no_states(small_maze):
    """Only episodes that are trained on become partners, and their states are the only ones that appear."""
    with running(DatasetConfig("local/small_maze", episodes=[0, 2, 3])):
        policy, meta = make(small_maze, corrective="demos")
    episodes = np.repeat(np.arange(6), policy.trajectories.lengths)
    rows = torch.from_numpy(np.flatnonzero(np.isin(episodes, (0, 2, 3))))
    batch = batch_of(policy, meta, rows[torch.randint(len(rows), (800,))])
    drawn = policy.draw(batch)
    everything = batch_of(policy, meta, torch.arange(len(episodes)))[STATE]
    distances = torch.cdist(drawn.batch[STATE][drawn.corrective].double(), everything.double())
    lent = distances.amin(dim=1) < 1e-4  # the others are noise
    assert lent.double().mean() > 0.5
    assert set(episodes[distances.argmin(dim=1)[lent]].tolist()) == {0, 2, 3}
