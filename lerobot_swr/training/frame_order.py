"""Which frames a seed sees at which step."""

from collections.abc import Sequence

import torch
from lerobot.datasets import EpisodeAwareSampler
from torch import Tensor


class FrameOrder(EpisodeAwareSampler):
    """The frames of ``lerobot-train --seed=SEED`` step by step, as a pure function of seed and step.

    LeRobot's sampler gives one frame at a time; this gives those of many steps as one tensor. Every epoch
    shows every frame once, in an order drawn for it; its last batch may be smaller.

    Args:
        starts: (N,) first row of each episode in the dataset.
        ends: (N,) row after its last.
        episodes: Episodes to train on; None takes all.
        seed: Seed of the run.
        batch_size: Frames per step.
        places: Row of each frame among those of `episodes`, as LeRobot's dataset has it; None takes the row.
    """

    def __init__(
        self,
        starts: Sequence[int],
        ends: Sequence[int],
        episodes: list[int] | None,
        seed: int,
        batch_size: int,
        places: dict[int, int] | None = None,
    ):
        super().__init__(list(starts), list(ends), episodes, 0, 0, True, seed, places)
        self.batch_size = batch_size
        self._rows = torch.tensor(self.indices)
        self._order: tuple[int, Tensor] | None = None

    @property
    def steps_per_epoch(self) -> int:
        """Steps in which every frame is shown once."""
        return -(-len(self._rows) // self.batch_size)

    def steps(self, first: int, count: int) -> Tensor:
        """Rows of the dataset for consecutive steps that have batches of equal size.

        Args:
            first: Number of the first step, from 0.
            count: Largest number of steps.

        Returns:
            (S, B) int64: S <= `count` steps of one epoch; B is `batch_size`, or smaller in an epoch's last
            step, which comes alone.
        """
        epoch, place = divmod(first, self.steps_per_epoch)
        full = len(self._rows) // self.batch_size  # steps with a whole batch
        rows = self._of_epoch(epoch)
        if place == full:
            return rows[place * self.batch_size :][None]
        stop = min(place + count, full)
        return rows[place * self.batch_size : stop * self.batch_size].view(stop - place, self.batch_size)

    def _of_epoch(self, epoch: int) -> Tensor:
        """(F,) rows in the order of an epoch."""
        if self._order is None or self._order[0] != epoch:
            permutation = torch.randperm(len(self._rows), generator=self._epoch_generator(epoch))
            self._order = (epoch, self._rows[permutation])
        return self._order[1]
