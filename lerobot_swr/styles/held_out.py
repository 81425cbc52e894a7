"""Styles of episodes that a policy in training does not train on, for the held-out loss."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_swr.similarity import Similarity
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.encoding import Frames, Imitation, Network, encode_styles
from lerobot_swr.trajectories import Trajectories

# Encoding happens in the middle of training, so it spends less than `lerobot-swr-styles --add`.
ENCODING_STEPS = 100
FRAMES = 64  # per episode, evenly spread over it
CHUNK = 32  # episodes encoded at once


class Demonstrations(Protocol):
    """The dataset of which some episodes are held out."""

    @property
    def trajectories(self) -> Trajectories:
        """All episodes."""

    @property
    def similarity(self) -> Similarity:
        """Their distances."""

    def frames(self, episode: int, rows: np.ndarray) -> Frames:
        """Some frames of an episode, as batches bring them."""


class HeldOutStyles:
    """The loss of ``--dataset.eval_split`` tells how well *some* style explains an unseen demonstration.

    Every held-out episode is encoded once per evaluation, from the style of the nearest trained one; its z is
    fitted to frames all over it.

    Args:
        cookbook: The styles in training.
        data: The training dataset; None where there is none.
    """

    def __init__(self, cookbook: StyleCookbook, data: Demonstrations | None):
        self._cookbook = cookbook
        self._data = data
        self._encoded: dict[int, Tensor] = {}

    def forget(self) -> None:
        """Drop what was encoded: the policy changes."""
        self._encoded = {}

    def styles(self, network: Network | Imitation, episodes: Tensor) -> Tensor:
        """(B, style_dim) styles of the (B,) `episodes`, encoded where they were not trained.

        Args:
            network: π_θ(a | s, z) as it is now, or how badly it imitates.
            episodes: (B,) int64.

        Raises:
            RuntimeError: If an episode has to be encoded and there is no dataset.
        """
        trained = self._cookbook.trained.bool()
        styles = self._cookbook.embedding(episodes).clone()
        missing = [i for i in episodes[~trained[episodes]].unique().tolist() if i not in self._encoded]
        if missing:
            self._encode(network, missing)
        for place, episode in enumerate(episodes.tolist()):
            if episode in self._encoded:
                styles[place] = self._encoded[episode]
        return styles

    def _encode(self, network: Network | Imitation, missing: Sequence[int]) -> None:
        if self._data is None:
            raise RuntimeError("this needs the training dataset: create the policy with dataset_meta")
        lengths = self._data.trajectories.lengths
        trained = self._cookbook.trained.bool()[: len(lengths)]
        # Evaluation goes through the episodes in order: the next ones are encoded along, at little cost.
        following = (~trained).nonzero().squeeze(1).tolist()
        following = [i for i in following if i > missing[-1] and i not in self._encoded]
        missing = [*missing, *following[: max(0, CHUNK - len(missing))]]
        candidates = trained.nonzero().squeeze(1)
        nearest, _ = self._data.similarity.nearest(np.array(missing), 1, candidates.cpu().numpy())
        starts = self._cookbook.embedding(torch.from_numpy(nearest).to(candidates.device)).detach()
        frames = [self._data.frames(i, _spread(int(lengths[i]))) for i in missing]
        encoded, _ = encode_styles(network, frames, starts, ENCODING_STEPS)
        self._encoded.update(zip(missing, encoded, strict=True))


def _spread(length: int) -> np.ndarray:
    """At most `FRAMES` rows of an episode, evenly spread over it."""
    return np.linspace(0, length - 1, min(FRAMES, length)).round().astype(int)
