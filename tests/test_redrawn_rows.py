"""Weights of frames for losses that are known as a mean only."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from lerobot_swr.policies.backbones.redrawn_rows import redrawn, systematic_rows

WEIGHTS = st.lists(st.floats(0, 8), min_size=1, max_size=12).filter(lambda weights: sum(weights) > 1e-3)


@given(WEIGHTS, st.floats(0, 1, exclude_max=True))
def test_every_row_is_drawn_by_its_weight_up_to_rounding(weights, uniform):
    """B rows; row i is there ``B w_i / Σw`` times, rounded up or down, so never where it weighs nothing."""
    rows = systematic_rows(torch.tensor(weights), uniform)
    expected = np.array(weights) / sum(weights) * len(weights)
    counts = np.bincount(rows.numpy(), minlength=len(weights))
    assert len(rows) == len(weights)
    assert (np.abs(counts - expected) < 1 + 1e-6).all()
    assert (counts[np.array(weights) == 0] == 0).all()


def test_the_mean_of_redrawn_rows_is_unbiased():
    """Averaged over evenly spread random numbers, against the weighted mean."""
    generator = torch.Generator().manual_seed(0)
    weight, losses = torch.rand(16, generator=generator) ** 3, torch.rand(16, generator=generator)
    draws = (np.arange(2000) + 0.5) / 2000
    means = []
    for uniform in draws:
        batch, factor = redrawn({"loss": losses}, weight, float(uniform))
        means.append(float(batch["loss"].mean()) * factor)
    assert abs(np.mean(means) - float((weight * losses).mean())) < 1e-4
    assert np.std(means) > 0


def test_frames_that_weigh_alike_are_left_alone():
    """The batch is the same, its mean times the weight."""
    batch = {"loss": torch.arange(4.0), "task": ["a", "b", "c", "d"], "fps": 10}
    same, factor = redrawn(batch, torch.full((4,), 0.5), 0.3)
    assert same is batch
    assert factor == 0.5


def test_lists_follow_and_what_is_no_frame_stays():
    """Tasks are those of the rows that are shown."""
    batch = {"loss": torch.arange(3.0), "task": ["a", "b", "c"], "fps": 10, "scale": torch.tensor(2.0)}
    batch["mean"] = torch.zeros(2)
    shown, factor = redrawn(batch, torch.tensor([0.0, 0.0, 1.5]), 0.9)
    assert shown["loss"].tolist() == [2.0, 2.0, 2.0]
    assert shown["task"] == ["c", "c", "c"]
    assert (shown["fps"], shown["scale"], factor) == (10, batch["scale"], 0.5)
    assert shown["mean"] is batch["mean"]
