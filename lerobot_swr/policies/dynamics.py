"""How the actions of a training dataset move its states, for corrective labels and relative actions."""

import logging
from dataclasses import dataclass

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_swr.corrective.frames import BLOCK, CorrectiveStream, units_of
from lerobot_swr.corrective.inverse_model import InverseModel, fit_inverse_model, log_inverse_model
from lerobot_swr.corrective.labels import CorrectiveLabels
from lerobot_swr.corrective.relative_actions import RelativeActions, Units
from lerobot_swr.policies.configuration_swr import ZBCConfig
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.policies.training_data import TrainingData
from lerobot_swr.trajectories import Trajectories

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Dynamics:
    """What a policy with corrective labels, or one that predicts relative actions, knows of its dataset.

    Attributes:
        episodes: (M,) the episodes that are trained on.
        trajectories: These episodes, without pauses.
        units: Feature to the units in which the policy sees it.
        model: Their inverse model; None without corrective labels.
    """

    episodes: np.ndarray
    trajectories: Trajectories
    units: dict[str, Units]
    model: InverseModel | None

    def corrective_stream(self, config: ZBCConfig, weights: np.ndarray) -> CorrectiveStream | None:
        """The corrective frames, of which `weights` (N,) are the factors of the loss by episode."""
        if self.model is None:
            return None
        labels = CorrectiveLabels(
            self.trajectories,
            self.model,
            "demos" if config.corrective == "demos" else "noise",
            config.corrective_scale,
            config.observation_keys,
        )
        if config.corrective == "demos":
            _log_borrowed(labels, len(self.episodes))
        return CorrectiveStream(labels, self.episodes, self.units, weights)

    def relative_actions(self, config: ZBCConfig) -> RelativeActions | None:
        """What translates between actions and the network's outputs; None where these are actions."""
        relative = make_relative_actions(config)
        if relative is not None:
            columns, units = self.trajectories.columns, self.units
            targets = np.array(config.action_targets)
            relative.fit(columns[OBS_STATE], columns[ACTION], targets, units[OBS_STATE], units[ACTION])
        return relative


def make_relative_actions(config: ZBCConfig) -> RelativeActions | None:
    """A translation that is still to be fitted, or loaded."""
    if config.action_targets is None:
        return None
    return RelativeActions(len(config.action_targets), config.dimensions[OBS_STATE])


def adopt_dynamics(config: ZBCConfig, data: TrainingData) -> Dynamics | None:
    """Fit the inverse model of a training dataset, log it and note in the configuration what it says.

    Args:
        config: The policy's configuration, changed in place.
        data: The training dataset. Of a network from a checkpoint, what its outputs mean is kept.

    Returns:
        None where nothing of the dataset is needed.

    Raises:
        ValueError: If corrective labels cannot work on this dataset, or a flag contradicts the checkpoint.
    """
    if data.from_checkpoint:
        _check_outputs(config, data.trajectories, data.run.resuming)
    config.inverse_horizon = config.inverse_r2 = None
    if config.corrective == "none" and config.action_targets is None:
        return None
    episodes = np.array(data.run.episodes)
    trained = data.moving if len(episodes) == len(data.moving) else data.moving.subset(episodes.tolist())
    columns = {key: trained.columns[key] for key in [*config.observation_keys, ACTION]}
    preprocessor, _ = make_bc_pre_post_processors(config, data.meta.stats)
    units = units_of(preprocessor, columns)
    if config.corrective == "none":
        return Dynamics(episodes, trained, units, None)
    model = fit_inverse_model(trained, config.corrective_horizon, config.corrective_relative)
    log_inverse_model(model, data.meta.features[ACTION].get("names"))
    config.inverse_horizon, config.inverse_r2 = model.horizon, [round(float(r2), 4) for r2 in model.r2]
    targets = model.targets.tolist() if (model.targets >= 0).any() else None
    if not data.from_checkpoint:
        config.action_targets = targets
    elif targets != config.action_targets:
        logger.warning(
            "The network keeps the checkpoint's outputs, %s, although this dataset's actions are %s.",
            _name_outputs(config.action_targets),
            _name_outputs(targets),
        )
    return Dynamics(episodes, trained, units, model)


def _check_outputs(config: ZBCConfig, trajectories: Trajectories, resuming: bool) -> None:
    """Refuse what contradicts the meaning of a checkpoint's outputs."""
    targets, wanted = config.action_targets, config.corrective_relative
    if wanted is not None and wanted != (targets is not None) and not resuming:
        raise ValueError(
            f"corrective_relative={str(wanted).lower()}: the checkpoint's network predicts "
            f"{_name_outputs(targets)}, and fine-tuning keeps that; give --policy.corrective_relative=null, "
            "or train a new policy"
        )
    state_dim, action_dim = (trajectories.columns[key].shape[1] for key in (OBS_STATE, ACTION))
    if targets is not None and (len(targets) != action_dim or max(targets) >= state_dim):
        raise ValueError(
            f"action_targets={targets} of the checkpoint: the dataset's actions have {action_dim} dimensions "
            f"and its states {state_dim}; train a new policy on it"
        )


def _name_outputs(targets: list[int] | None) -> str:
    return "actions" if targets is None else f"actions relative to the state (action_targets={targets})"


def _log_borrowed(labels: CorrectiveLabels, n_episodes: int) -> None:
    """Say how many states ``demos`` finds near in other demonstrations."""
    numbers = np.random.default_rng(0).random((BLOCK, labels.draws_per_frame))
    share = labels.draw(numbers, np.arange(n_episodes)).borrowed.mean()
    logger.info(
        "corrective=demos: about %.0f %% of the corrective states are other demonstrations', the rest noise",
        100 * share,
    )
