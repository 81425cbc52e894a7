"""Weights of frames for a loss that is known as a mean only: frames are shown as often as they weigh."""

from typing import Any

import torch
from torch import Tensor


def redrawn(batch: dict[str, Any], weight: Tensor, uniform: float) -> tuple[dict[str, Any], float]:
    """A batch whose plain mean, times a factor, is an unbiased estimate of the weighted mean of `batch`.

    Args:
        batch: Features (B, ...), lists of B, and whatever is the same for all frames.
        weight: (B,) weights >= 0.
        uniform: A random number in [0, 1).

    Returns:
        The batch, of B rows, and the factor, which is the mean weight.
    """
    factor = float(weight.mean())
    if weigh_alike(weight):
        return batch, factor
    rows = systematic_rows(weight, uniform)
    if torch.equal(rows, torch.arange(len(rows), device=rows.device)):
        return batch, factor
    return picked_rows(batch, rows, len(weight)), factor


def weigh_alike(weight: Tensor) -> bool:
    """Whether all (B,) weights are the same."""
    return bool((weight == weight[0]).all())


def systematic_rows(weight: Tensor, uniform: float) -> Tensor:
    """(B,) int64: rows, in order, each ``B w / Σw`` times on average, rounded up or down.

    Systematic resampling: B places, one apart from the other, on a line on which every row takes up as much
    room as it weighs. Its spread is the smallest of the usual ways.

    Args:
        weight: (B,) weights >= 0, not all 0.
        uniform: A random number in [0, 1).
    """
    count = len(weight)
    ends = weight.double().cumsum(0)
    ends = ends * (count / ends[-1])
    places = torch.arange(count, dtype=torch.float64, device=weight.device) + uniform
    rows = torch.searchsorted(ends, places, right=True)
    last = int((weight > 0).nonzero()[-1])
    return rows.clamp(max=last)


def picked_rows(batch: dict[str, Any], rows: Tensor, count: int) -> dict[str, Any]:
    """Some rows of a batch; what is not one value per frame stays."""
    places = rows.tolist()
    picked = dict(batch)
    for key, value in batch.items():
        if isinstance(value, Tensor) and value.ndim > 0 and len(value) == count:
            picked[key] = value[rows.to(value.device)]
        elif isinstance(value, list | tuple) and len(value) == count:
            picked[key] = [value[place] for place in places]
    return picked
