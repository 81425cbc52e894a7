"""Actions that are targets of the state, and how a policy learns them: relative to the state."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

TARGET_SHARE = 0.5
"""An action dimension is a target if subtracting the state removes this share of its variance. Absolute joint
targets reach .7 to 1 (Unitree G1), velocities and displacements stay below 0 (Maze2D, D3IL)."""


def target_dimensions(states: np.ndarray, actions: np.ndarray, absolute: bool | None = None) -> np.ndarray:
    """The state dimension whose target each action dimension is.

    Args:
        states: (F, d).
        actions: (F, A).
        absolute: True takes every dimension that moves for a target, of the state dimension that explains it
            best; False none; None asks the data.

    Returns:
        (A,) int64, -1 where the action is no target.
    """
    found = np.full(actions.shape[1], -1)
    moving = states.min(axis=0) < states.max(axis=0)
    if absolute is False or not moving.any():
        return found
    for k in range(actions.shape[1]):
        action = actions[:, k : k + 1].astype(np.float64)  # (F, 1)
        variance = float(action.var())
        if variance == 0:
            continue
        removed = np.where(moving, 1 - (action - states).var(axis=0) / variance, -np.inf)  # (d,)
        if absolute or removed.max() >= TARGET_SHARE:
            found[k] = int(removed.argmax())
    return found


def relative_to_state(actions: np.ndarray, states: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Actions (F, A) minus the states (F, d) whose `targets` (A,) they are, in raw units."""
    return actions - states[:, np.maximum(targets, 0)] * (targets >= 0).astype(states.dtype)


@dataclass(frozen=True)
class Units:
    """The linear map from raw to normalised numbers: normalised = scale · raw + offset, (d,) float64 each."""

    scale: np.ndarray
    offset: np.ndarray

    def normalize(self, raw: np.ndarray) -> np.ndarray:
        """Normalised float32 numbers (F, d) of raw ones."""
        return (raw * self.scale + self.offset).astype(np.float32)


class RelativeActions(nn.Module):
    """Translates between actions and what the network predicts: actions relative to the state, standardised.

    Both sides are in normalised units: action = state_gain · state + offset + scale · output. The identity
    where an action is no target.

    Args:
        action_dim: A.
        state_dim: d.
    """

    def __init__(self, action_dim: int, state_dim: int):
        super().__init__()
        self.state_gain: Tensor
        self.offset: Tensor
        self.scale: Tensor
        self.register_buffer("state_gain", torch.zeros(action_dim, state_dim))
        self.register_buffer("offset", torch.zeros(action_dim))
        self.register_buffer("scale", torch.ones(action_dim))

    def fit(
        self, states: np.ndarray, actions: np.ndarray, targets: np.ndarray, state: Units, action: Units
    ) -> None:
        """Standardise by the relative actions of a dataset.

        Args:
            states: (F, d), raw.
            actions: (F, A), raw.
            targets: (A,), see `target_dimensions`.
            state: Units of the states.
            action: Units of the actions.
        """
        for k, m in enumerate(targets):
            if m < 0:
                continue
            relative = actions[:, k].astype(np.float64) - states[:, m]
            mean, std = float(relative.mean()), float(relative.std()) or 1.0
            scale, offset = float(action.scale[k]), float(action.offset[k])
            if state.scale[m] == 0:  # a state that never changes
                self.state_gain[k, m] = 0.0
                self.offset[k] = scale * (mean + float(states[0, m])) + offset
            else:
                gain = scale / float(state.scale[m])
                self.state_gain[k, m] = gain
                self.offset[k] = scale * mean + offset - gain * float(state.offset[m])
            self.scale[k] = scale * std

    def encode(self, actions: Tensor, states: Tensor) -> Tensor:
        """What the network is to predict for actions (F, A) in states (F, d)."""
        return (actions - self._at(states)) / self.scale

    def decode(self, outputs: Tensor, states: Tensor) -> Tensor:
        """Actions (F, A) of the network's outputs (F, A) in states (F, d)."""
        return self._at(states) + outputs * self.scale

    def _at(self, states: Tensor) -> Tensor:
        return states @ self.state_gain.T + self.offset
