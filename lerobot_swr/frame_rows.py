"""Which frames of its dataset a batch holds."""

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.trajectories import Trajectories


class FrameRows:
    """Finds frames in the columns of `Trajectories` by what LeRobot's batches say of them.

    Args:
        trajectories: All episodes of the dataset, F frames.
    """

    def __init__(self, trajectories: Trajectories):
        self._rows: Tensor | None = None
        if trajectories.index is not None:
            owner = np.repeat(np.arange(len(trajectories)), trajectories.lengths)
            self._span = int(trajectories.index.max()) + 1
            codes = owner * self._span + trajectories.index  # a number may come again in another episode
            order = np.argsort(codes, kind="stable")
            self._codes, self._rows = torch.from_numpy(codes[order]), torch.from_numpy(order)

    def __call__(self, batch: dict[str, Tensor]) -> Tensor:
        """(B,) rows, 0 to F - 1, of a batch's frames, from its ``episode_index`` and ``index``."""
        episodes, index = batch["episode_index"].flatten(), batch["index"].flatten()
        if self._rows is None:
            return index
        self._codes, self._rows = self._codes.to(index.device), self._rows.to(index.device)
        return self._rows[torch.searchsorted(self._codes, episodes * self._span + index)]
