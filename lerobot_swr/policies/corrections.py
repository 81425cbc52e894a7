"""What corrective labels change in a style policy: its frames, and what its network predicts."""

from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_swr.corrective.inverse_model import InverseModel, fit_inverse_model, log_inverse_model
from lerobot_swr.corrective.labels import SHARE, CorrectiveLabels
from lerobot_swr.corrective.relative_actions import RelativeActions, Units
from lerobot_swr.policies.configuration_swr import ZBCConfig
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.sampling import StepGenerator
from lerobot_swr.trajectories import Trajectories

STREAM = 1  # of random numbers; pairs are drawn from stream 0


def describe_dynamics(
    config: ZBCConfig, meta: LeRobotDatasetMetadata, trajectories: Trajectories
) -> InverseModel:
    """Fit the inverse model of a training dataset, log it and note it in the configuration.

    Raises:
        ValueError: If corrective labels cannot work on this dataset.
    """
    model = fit_inverse_model(trajectories, config.corrective_horizon, config.corrective_relative)
    log_inverse_model(model, meta.features[ACTION].get("names"))
    config.inverse_horizon, config.inverse_r2 = model.horizon, [round(float(r2), 4) for r2 in model.r2]
    config.action_targets = model.targets.tolist() if (model.targets >= 0).any() else None
    return model


class Corrections(nn.Module):
    """The corrective part of a style policy; all in normalised units.

    Attributes:
        relative: Translates between actions and the network's outputs; None where actions are no targets.
        draws: Source of the random numbers.
        labels: The dataset's corrective labels; None outside of training.

    Args:
        config: The policy's configuration.
    """

    def __init__(self, config: ZBCConfig):
        super().__init__()
        self.draws = StepGenerator(STREAM)
        self.relative: RelativeActions | None = None
        if config.action_targets is not None:
            state_dim = config.robot_state_feature.shape[0]  # type: ignore[union-attr]
            self.relative = RelativeActions(len(config.action_targets), state_dim)
        self.labels: CorrectiveLabels | None = None
        self._units: dict[str, Units] = {}

    def adopt_dataset(
        self, config: ZBCConfig, trajectories: Trajectories, stats: dict[str, Any], model: InverseModel
    ) -> None:
        """Prepare for training.

        Args:
            config: The policy's configuration.
            trajectories: The training dataset.
            stats: Its statistics, by which LeRobot normalises.
            model: Its inverse model.
        """
        columns = {key: trajectories.columns[key] for key in [*config.observation_keys, ACTION]}
        preprocessor, _ = make_bc_pre_post_processors(config, stats)
        self._units = _units_of(preprocessor, columns)
        if self.relative is not None:
            state, action = self._units[OBS_STATE], self._units[ACTION]
            self.relative.fit(columns[OBS_STATE], columns[ACTION], model.targets, state, action)
        self.labels = CorrectiveLabels(
            trajectories,
            model,
            config.corrective,  # type: ignore[arg-type]
            config.corrective_scale,
            config.observation_keys,
        )

    def correct(
        self, drawn: dict[str, Tensor], own: dict[str, Tensor], rows: Tensor, trained: Tensor, steps: int
    ) -> dict[str, Tensor]:
        """Put corrective frames in the place of about half of what a policy drew.

        Args:
            drawn: What the policy's `draw` prepared for (B,) frames.
            own: What `drawn` holds for a frame under its own episode's style, where that differs.
            rows: (B,) frames of the dataset.
            trained: (N,) non-zero where an episode takes part in training.
            steps: Number of steps whose frames these are.

        Returns:
            `drawn` with these frames replaced, ``corrective`` (B,), True where they are, and actions as the
            network is to predict them.
        """
        if self.labels is None:
            return self.encode(drawn)
        device, per_frame = rows.device, self.labels.draws_per_frame
        self.labels.to(device)
        numbers = self.draws.uniforms(steps, len(rows) // steps * per_frame)
        uniforms = torch.from_numpy(numbers.reshape(-1, per_frame))
        corrected = self.labels.relabel(rows, uniforms.to(device), trained.nonzero().squeeze(1))
        raw = {**corrected.observations, ACTION: corrected.actions}
        new = {key: self._units[key].to(device).normalize(value) for key, value in raw.items()}
        new |= {key: value[corrected.places].to(drawn[key]) for key, value in own.items() if key in drawn}
        replaced = {key: drawn[key].index_copy(0, corrected.places, value) for key, value in new.items()}
        corrective = torch.zeros_like(rows, dtype=torch.bool).index_fill_(0, corrected.places, True)
        return self.encode({**drawn, **replaced, "corrective": corrective})

    def encode(self, drawn: dict[str, Tensor]) -> dict[str, Tensor]:
        """`drawn` with actions as the network is to predict them."""
        if self.relative is None:
            return drawn
        return {**drawn, ACTION: self.relative.encode(drawn[ACTION], drawn[OBS_STATE])}

    def decode(self, outputs: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """(B, A) actions of the network's outputs for a batch of observations."""
        return outputs if self.relative is None else self.relative.decode(outputs, batch[OBS_STATE])

    def fitted(self, prefix: str) -> dict[str, Tensor]:
        """What was computed from the training dataset and therefore holds against a checkpoint's, by name."""
        own = {key: value for key, value in self.state_dict().items() if not key.startswith("draws.")}
        return {prefix + key: value for key, value in own.items()}

    def figures(self, drawn: dict[str, Tensor], losses: Tensor) -> dict[str, float]:
        """``corrective_loss``: the mean loss of corrective frames, unbiased; read its average over time."""
        if "corrective" not in drawn:
            return {}
        corrective = drawn["corrective"].cpu().numpy()
        return {"corrective_loss": float((losses.cpu().numpy() * corrective).mean()) / SHARE}


def _units_of(preprocessor: Any, columns: dict[str, np.ndarray]) -> dict[str, Units]:
    """The linear maps with which LeRobot's normalisation, whichever it is, treats features.

    A constant dimension is mapped to what its constant becomes.
    """
    ends = {
        key: torch.from_numpy(np.stack([column.min(axis=0), column.max(axis=0)]))  # (2, d)
        for key, column in columns.items()
    }
    normalized = preprocessor(ends)
    units = {}
    for key, (low, high) in ends.items():
        low_to, high_to = normalized[key].double().cpu()
        scale = torch.where(high > low, (high_to - low_to) / (high - low), 0.0)
        units[key] = Units(scale.float(), (low_to - scale * low).float())
    return units
