"""What of a demonstration ν compares: its states, the hand's path about an object, or features of one's own.

On a table where things lie elsewhere in every episode, states say where things lay rather than what the hand
did. Comparing the hand's path as seen from the object that it handles, or whatever a function tells of an
episode, compares the manner.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from lerobot_swr.object_poses import Names, find_poses, hand_of, into_frame, object_of
from lerobot_swr.trajectories import Trajectories
from lerobot_swr.user_functions import load_function

MANNER = "manner"  # the column of what is compared, where that is no feature of the dataset


@dataclass(frozen=True)
class Manner:
    """How demonstrations are described to be compared.

    Attributes:
        keys: Features whose values make up the states; beside `frame` or `features` those that were named.
        frame: An object; the states are the hand's path in its frame.
        scale: Distance from the object, in units of its position, beyond which the path saturates.
        names: Of the dimensions of features, in which hand and object are found.
        features: ``module:function`` that maps an episode, ``{feature: (T, d)}``, to numbers (k,), or to a
            sequence (T', k).
    """

    keys: tuple[str, ...]
    frame: str | None = None
    scale: float = 0.1
    names: Names = field(default_factory=dict)
    features: str | None = None

    @property
    def columns(self) -> list[str]:
        """Names of the columns of `of` that ν compares."""
        return list(self.keys) if self.frame is None and self.features is None else [MANNER]

    def of(self, trajectories: Trajectories) -> Trajectories:
        """What is compared of demonstrations, as trajectories whose columns are `columns`.

        Raises:
            ValueError: If hand or object are not found, or the function does not give numbers.
        """
        if self.features is not None:
            sequences = [self._described(i, episode) for i, episode in enumerate(trajectories.episodes())]
            wide = sorted({sequence.shape[1] for sequence in sequences})
            if len(wide) > 1:
                raise ValueError(
                    f"similarity_features={self.features!r}: gives {wide[0]} numbers for one episode and "
                    f"{wide[1]} for another; give as many for all"
                )
            lengths = np.array([len(sequence) for sequence in sequences])
            return self._compared(trajectories, np.concatenate(sequences), lengths)
        if self.frame is not None:
            path = hand_path(trajectories.columns, self.frame, self.names, self.scale)
            beside = [trajectories.columns[key] for key in self.keys]
            return self._compared(trajectories, np.column_stack([path, *beside]), trajectories.lengths)
        return replace(trajectories, columns={key: trajectories.columns[key] for key in self.keys})

    @staticmethod
    def _compared(trajectories: Trajectories, states: np.ndarray, lengths: np.ndarray) -> Trajectories:
        return Trajectories(lengths, {MANNER: states}, trajectories.fps, trajectories.name)

    def _described(self, i: int, episode: dict[str, np.ndarray]) -> np.ndarray:
        """(T', k) float32 of an episode."""
        where = f"similarity_features={self.features!r}"
        assert self.features is not None
        function = load_function("similarity_features", self.features)
        try:
            value: Any = np.asarray(function(episode), dtype=np.float32)
        except Exception as error:  # whatever a user's function raises
            raise ValueError(f"{where}: fails on episode {i}: {error!r}") from error
        if value.ndim not in (1, 2) or value.size == 0 or not np.isfinite(value).all():
            raise ValueError(
                f"{where}: episode {i} gives an array of shape {value.shape}; expected finite numbers "
                "(k,), or (T, k) for a sequence"
            )
        return value if value.ndim == 2 else value[None]


def hand_path(columns: Mapping[str, np.ndarray], frame: str, names: Names, scale: float = 0.1) -> np.ndarray:
    """The hand's path in the frame of an object, saturating far away: scale · tanh(offset / scale).

    So the way in which the hand takes hold counts, and not the flight.

    Args:
        columns: Feature name to (F, d) raw values.
        frame: The object.
        names: Of the features' dimensions.
        scale: In units of the positions.

    Returns:
        (F, 3) float32, or (F, 2) where hand and object have no height.

    Raises:
        ValueError: If hand or object are not found.
    """
    poses = find_poses({key: dimensions for key, dimensions in names.items() if key in columns})
    thing = object_of(poses, frame, "similarity_frame")
    hand = poses[hand_of({name: pose for name, pose in poses.items() if name != frame})]
    own, other = (torch.from_numpy(columns[pose.key]).double() for pose in (hand, thing))
    away = into_frame(hand.position(own) - thing.position(other), thing.rotation(other))
    path = (scale * torch.tanh(away / scale)).numpy().astype(np.float32)
    return path if hand.is_spatial and thing.is_spatial else path[:, :2]
