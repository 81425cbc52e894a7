"""The last observations of every environment of a rollout."""

from collections import deque
from collections.abc import Sequence

import torch
from lerobot.policies.utils import populate_queues
from torch import Tensor


class ObservationHistory:
    """A window of observations that moves with the rollout.

    Before the episode's start it repeats the first observation, marked as padding, as LeRobot's datasets do.

    Args:
        keys: Names of the observations.
        length: T, observations in the window.
    """

    def __init__(self, keys: Sequence[str], length: int):
        self.keys, self.length = tuple(keys), length
        self.clear()

    def clear(self) -> None:
        """Start a rollout."""
        self._queues = {key: deque[Tensor](maxlen=self.length) for key in self.keys}
        self.seen = 0

    def push(self, observations: dict[str, Tensor]) -> None:
        """Add the current observations, (B, d) each.

        Raises:
            ValueError: If the number of environments changes within a rollout.
        """
        n_envs = len(observations[self.keys[0]])
        if self.seen and n_envs != (before := len(self._queues[self.keys[0]][-1])):
            raise ValueError(
                f"batch of {n_envs} observations in a rollout of {before} environments: "
                "call policy.reset() before a rollout with another number of environments"
            )
        populate_queues(self._queues, observations)
        self.seen = min(self.seen + 1, self.length)

    def window(self) -> dict[str, Tensor]:
        """The last T observations, (B, T, d) each, and ``is_pad`` (B, T), True before the episode."""
        window = {key: torch.stack(list(queue), dim=1) for key, queue in self._queues.items()}
        any_key = window[self.keys[0]]
        is_pad = torch.arange(self.length, device=any_key.device) < self.length - self.seen
        return {**window, "is_pad": is_pad.expand(len(any_key), -1)}
