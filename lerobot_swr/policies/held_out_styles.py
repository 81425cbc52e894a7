"""Styles of episodes that a policy in training does not train on, for the held-out loss."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.style_encoding import encode_styles

if TYPE_CHECKING:
    from lerobot_swr.policies.zbc_policy import ZBCPolicy

# Encoding happens in the middle of training, so it spends less than `lerobot-swr-styles --add`.
ENCODING_STEPS = 100
FRAMES = 64  # per episode, evenly spread over it
CHUNK = 32  # episodes encoded at once


class HeldOutStyles:
    """The loss of ``--dataset.eval_split`` tells how well *some* style explains an unseen demonstration.

    Every held-out episode is encoded once per evaluation, from the style of the nearest trained one; its z is
    fitted to frames all over it.

    Args:
        policy: The policy in training.
    """

    def __init__(self, policy: ZBCPolicy):
        self._policy = (policy,)  # in a tuple, lest torch takes it for a part of the policy
        self._encoded: dict[int, Tensor] = {}

    def forget(self) -> None:
        """Drop what was encoded: the policy changes."""
        self._encoded = {}

    def styles(self, episodes: Tensor) -> Tensor:
        """(B, style_dim) styles of the (B,) `episodes`, encoded where they were not trained.

        Raises:
            RuntimeError: If an episode has to be encoded and the policy was created without a dataset.
        """
        (policy,) = self._policy
        trained = policy.styles.trained.bool()
        styles = policy.styles.embedding(episodes).clone()
        missing = [i for i in episodes[~trained[episodes]].unique().tolist() if i not in self._encoded]
        if missing:
            self._encode(missing)
        for place, episode in enumerate(episodes.tolist()):
            if episode in self._encoded:
                styles[place] = self._encoded[episode]
        return styles

    def _encode(self, missing: list[int]) -> None:
        (policy,) = self._policy
        trained = policy.styles.trained.bool()[: policy.config.num_episodes]
        # Evaluation goes through the episodes in order: the next ones are encoded along, at little cost.
        following = (~trained).nonzero().squeeze(1).tolist()
        following = [i for i in following if i > missing[-1] and i not in self._encoded]
        missing = missing + following[: max(0, CHUNK - len(missing))]
        candidates = trained.nonzero().squeeze(1)
        to_trained = policy.distances()[np.ix_(np.array(missing), candidates.cpu().numpy())]
        nearest = candidates[torch.from_numpy(to_trained.argmin(axis=1)).to(candidates.device)]
        starts = policy.styles.embedding(nearest).detach()[:, None]
        frames = [policy.normalized_frames(i, self._frames(i)) for i in missing]
        encoded, _ = encode_styles(policy.predict, frames, starts, ENCODING_STEPS)
        self._encoded.update(zip(missing, encoded, strict=True))

    def _frames(self, episode: int) -> np.ndarray:
        (policy,) = self._policy
        length = int(policy.trajectories.lengths[episode])
        return np.linspace(0, length - 1, min(FRAMES, length)).round().astype(int)
