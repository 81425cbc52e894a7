"""Corrective frames as training takes them: normalised, weighted, the n-th one the same in every run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_swr.corrective.labels import CorrectiveLabels
from lerobot_swr.corrective.relative_actions import Units
from lerobot_swr.random_streams import StepGenerator

BLOCK = 256  # corrective frames that are drawn together


@dataclass(frozen=True)
class PreparedFrames:
    """Frames as batches bring them.

    Attributes:
        features: Observations and ``action`` to (P, d_k), normalised.
        weight: (P,) factor of the loss.
        episode: (P,) the demonstrations, whose styles they teach.
    """

    features: dict[str, Tensor]
    weight: Tensor
    episode: Tensor

    def __getitem__(self, part: slice) -> "PreparedFrames":
        """Some of the frames."""
        features = {key: value[part] for key, value in self.features.items()}
        return PreparedFrames(features, self.weight[part], self.episode[part])


class CorrectiveStream:
    """Corrective frames 0, 1, 2, ...: frame n is a pure function of the seed.

    Drawn for many steps at once: for the few of one step the overhead of each operation would be noticeable.

    Args:
        labels: Corrective labels of the episodes that are trained on.
        episodes: (M,) numbers of these episodes.
        units: Feature to the units in which the policy sees it.
        weights: (N,) factor of the loss of each episode's frames.
    """

    def __init__(
        self, labels: CorrectiveLabels, episodes: np.ndarray, units: Mapping[str, Units], weights: np.ndarray
    ):
        self.labels = labels
        self.episodes = episodes
        self.units = units
        self._weights = weights
        self._block: tuple[Any, PreparedFrames] | None = None  # the last one

    def frames(self, draws: StepGenerator, first: int, last: int, device: torch.device) -> PreparedFrames:
        """Frames `first` to `last` - 1; their block is kept for the next steps."""
        parts: list[PreparedFrames] = []
        while first < last:
            block, place = divmod(first, BLOCK)
            key = (int(draws.seed), block, device)
            if self._block is None or self._block[0] != key:
                self._block = key, self._draw(draws, block * BLOCK, device)
            stop = min(place + last - first, BLOCK)
            parts.append(self._block[1][place:stop])
            first += stop - place
        return parts[0] if len(parts) == 1 else _joined(parts)

    def _draw(self, draws: StepGenerator, first: int, device: torch.device) -> PreparedFrames:
        """A block of frames."""
        per_frame = self.labels.draws_per_frame
        uniforms = draws.uniforms_at(first, BLOCK, per_frame).reshape(BLOCK, per_frame)
        frames = self.labels.draw(uniforms, np.arange(len(self.episodes)))
        raw = {**frames.observations, ACTION: frames.actions}
        features = {key: self.units[key].normalize(value) for key, value in raw.items()}
        episodes = self.episodes[frames.episodes]
        return PreparedFrames(
            {key: torch.from_numpy(value).to(device) for key, value in features.items()},
            torch.from_numpy(self._weights[episodes]).to(device),
            torch.from_numpy(episodes).to(device),
        )


def _joined(parts: Sequence[PreparedFrames]) -> PreparedFrames:
    keys = parts[0].features
    return PreparedFrames(
        {key: torch.cat([part.features[key] for part in parts]) for key in keys},
        torch.cat([part.weight for part in parts]),
        torch.cat([part.episode for part in parts]),
    )


def units_of(
    preprocessor: Callable[[dict[str, Any]], dict[str, Any]], columns: Mapping[str, np.ndarray]
) -> dict[str, Units]:
    """The linear maps with which LeRobot's normalisation, whichever it is, treats features.

    A constant dimension is mapped to what its constant becomes.
    """
    ends = {key: np.stack([column.min(axis=0), column.max(axis=0)]) for key, column in columns.items()}
    normalized = preprocessor({key: torch.from_numpy(value) for key, value in ends.items()})  # (2, d)
    units = {}
    for key, (low, high) in ((key, value.astype(np.float64)) for key, value in ends.items()):
        low_to, high_to = normalized[key].cpu().double().numpy()
        scale = np.divide(high_to - low_to, high - low, out=np.zeros(len(low)), where=high > low)
        units[key] = Units(scale, low_to - scale * low)
    return units
