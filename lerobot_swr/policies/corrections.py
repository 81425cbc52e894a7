"""What corrective labels change in a style policy: its frames, and what its network predicts."""

import logging
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_swr.configuration import is_resuming, training_episodes
from lerobot_swr.corrective.inverse_model import InverseModel, fit_inverse_model, log_inverse_model
from lerobot_swr.corrective.labels import CorrectiveLabels
from lerobot_swr.corrective.relative_actions import RelativeActions, Units
from lerobot_swr.policies.configuration_swr import ZBCConfig
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.sampling import StepGenerator
from lerobot_swr.trajectories import Trajectories

STREAM = 1  # of random numbers; pairs are drawn from stream 0
BLOCK = 256  # corrective frames that are drawn together

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Dynamics:
    """What corrective labels take from a training dataset.

    Attributes:
        episodes: (M,) the episodes that are trained on.
        trajectories: These episodes.
        model: Their inverse model; None without corrective labels.
    """

    episodes: np.ndarray
    trajectories: Trajectories
    model: InverseModel | None


def describe_dynamics(
    config: ZBCConfig, meta: LeRobotDatasetMetadata, trajectories: Trajectories, from_checkpoint: bool
) -> Dynamics | None:
    """Fit the inverse model of a training dataset, log it and note it in the configuration.

    Args:
        config: The policy's configuration.
        meta: Metadata of the training dataset.
        trajectories: All of its episodes.
        from_checkpoint: Whether the network comes from a checkpoint: what its outputs mean is then kept.

    Returns:
        None where nothing of the dataset is needed.

    Raises:
        ValueError: If corrective labels cannot work on this dataset, or a flag contradicts the checkpoint.
    """
    if from_checkpoint:
        _check_outputs(config, trajectories)
    config.inverse_horizon = config.inverse_r2 = None
    if config.corrective == "none" and config.action_targets is None:
        return None
    chosen = training_episodes(meta)
    episodes = np.arange(len(trajectories)) if chosen is None else np.sort(chosen)
    trained = trajectories if len(episodes) == len(trajectories) else trajectories.subset(episodes.tolist())
    if config.corrective == "none":
        return Dynamics(episodes, trained, None)
    model = fit_inverse_model(trained, config.corrective_horizon, config.corrective_relative)
    log_inverse_model(model, meta.features[ACTION].get("names"))
    config.inverse_horizon, config.inverse_r2 = model.horizon, [round(float(r2), 4) for r2 in model.r2]
    targets = model.targets.tolist() if (model.targets >= 0).any() else None
    if not from_checkpoint:
        config.action_targets = targets
    elif targets != config.action_targets:
        logger.warning(
            "The network keeps the checkpoint's outputs, %s, although this dataset's actions are %s.",
            _name_outputs(config.action_targets),
            _name_outputs(targets),
        )
    return Dynamics(episodes, trained, model)


def _check_outputs(config: ZBCConfig, trajectories: Trajectories) -> None:
    """Refuse what contradicts the meaning of a checkpoint's outputs."""
    targets, wanted = config.action_targets, config.corrective_relative
    if wanted is not None and wanted != (targets is not None) and not is_resuming():
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


class Corrections(nn.Module):
    """The corrective part of a style policy; all in normalised units.

    Half of a batch is replaced by corrective frames. These do not depend on the batch: they are drawn from
    all frames that are trained on, for many steps at once as soon as every episode has been seen, because for
    the few of one step the overhead of each operation would be noticeable. Frame n is a pure function of the
    seed and of the episodes trained on so far, so a resumed run finds the same.

    Attributes:
        relative: Translates between actions and the network's outputs; None where it predicts actions.
        draws: Source of the random numbers; its step counts the frames of all batches, two for each
            corrective frame.
        labels: The dataset's corrective labels; None where none are used.

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
        self._block: tuple[Any, dict[str, Tensor]] | None = None  # the last one
        self._places: dict[Any, tuple[Tensor, Tensor]] = {}

    def adopt_dataset(
        self, config: ZBCConfig, dynamics: Dynamics, stats: dict[str, Any], weights: Tensor | None
    ) -> None:
        """Prepare for training.

        Args:
            config: The policy's configuration.
            dynamics: What is known of the training dataset.
            stats: Its statistics, by which LeRobot normalises.
            weights: (N,) factor of the loss of each episode's frames; None for 1.
        """
        trajectories = dynamics.trajectories
        columns = {key: trajectories.columns[key] for key in [*config.observation_keys, ACTION]}
        preprocessor, _ = make_bc_pre_post_processors(config, stats)
        self._units = _units_of(preprocessor, columns)
        if self.relative is not None:
            state, action = self._units[OBS_STATE], self._units[ACTION]
            targets = np.array(config.action_targets)
            self.relative.fit(columns[OBS_STATE], columns[ACTION], targets, state, action)
        if dynamics.model is not None:
            kind, scale = config.corrective, config.corrective_scale
            self.labels = CorrectiveLabels(
                trajectories,
                dynamics.model,
                kind,  # type: ignore[arg-type]
                scale,
                config.observation_keys,
            )
            if kind == "demos":
                _log_borrowed(self.labels, len(dynamics.episodes))
            self._episodes = dynamics.episodes
            self._weights = None if weights is None else weights.cpu().numpy()

    def correct(self, drawn: dict[str, Tensor], trained: Tensor, steps: int) -> dict[str, Tensor]:
        """Put corrective frames in the place of the first half of every step's frames.

        Frames come in random order. Where their number is odd, the larger half is corrective every other
        time.

        Args:
            drawn: What the policy's `draw` prepared for (B,) frames, each with its own style.
            trained: (N,) non-zero where an episode was trained on.
            steps: Number of steps whose frames these are.

        Returns:
            `drawn` with these frames replaced, ``corrective`` (B,), True where they are, and actions as the
            network is to predict them.
        """
        drawn = self.encode(drawn)
        if self.labels is None:
            return drawn
        first, count = int(self.draws.step), len(drawn[ACTION])
        self.draws.step.add_(count)  # `+=` would have the module register it anew
        device = drawn[ACTION].device
        places, corrective = self._half(count // steps, steps, first % 2, device)
        if len(places) == 0:
            return {**drawn, "corrective": corrective}
        edges = (first + count // steps * np.arange(steps + 1)) // 2
        frames = self._frames(edges, trained, device)
        replaced = {key: drawn[key].index_copy(0, places, value) for key, value in frames.items()}
        return {**drawn, **replaced, "corrective": corrective}

    def _half(self, count: int, steps: int, first: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Which of `steps` times `count` frames are corrective: (P,) places, and (B,) True there."""
        key = (count, steps, first, device)
        if key not in self._places:
            edges = (first + count * np.arange(steps + 1)) // 2
            corrective = np.arange(count) < np.diff(edges)[:, None]  # (steps, count)
            places = np.flatnonzero(corrective)
            kept = dict(list(self._places.items())[-3:])
            value = torch.from_numpy(places).to(device), torch.from_numpy(corrective.reshape(-1)).to(device)
            self._places = {**kept, key: value}
        return self._places[key]

    def _frames(self, edges: np.ndarray, trained: Tensor, device: torch.device) -> dict[str, Tensor]:
        """Corrective frames of one step or more, as `draw` of a policy returns frames.

        Step s has frames ``edges[s]`` to ``edges[s + 1]`` - 1; `trained` (N,) is not 0 where an episode was.
        """
        is_candidate = trained.cpu().numpy()[self._episodes] != 0
        if is_candidate.all():
            parts = self._from_blocks(int(edges[0]), int(edges[-1]), device)
        else:
            # A block would serve only until the next episode is seen. Rounding depends on how many frames are
            # drawn together: a step's, however many steps are asked for.
            candidates = np.flatnonzero(is_candidate)
            spans = [(first, last - first) for first, last in pairwise(edges.tolist()) if last > first]
            parts = [self._draw_frames(first, count, candidates, device) for first, count in spans]
        if len(parts) == 1:
            return parts[0]
        return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}

    def _from_blocks(self, first: int, last: int, device: torch.device) -> list[dict[str, Tensor]]:
        """Frames `first` to `last` - 1 of all episodes; their block is kept for the next steps."""
        parts: list[dict[str, Tensor]] = []
        while first < last:
            block, place = divmod(first, BLOCK)
            key = (int(self.draws.seed), block, device)
            if self._block is None or self._block[0] != key:
                everything = np.arange(len(self._episodes))
                self._block = key, self._draw_frames(block * BLOCK, BLOCK, everything, device)
            stop = min(place + last - first, BLOCK)
            parts.append({name: value[place:stop] for name, value in self._block[1].items()})
            first += stop - place
        return parts

    def _draw_frames(
        self, first: int, count: int, candidates: np.ndarray, device: torch.device
    ) -> dict[str, Tensor]:
        """`count` frames, of (M,) places in the list of the episodes that are trained on."""
        assert self.labels is not None
        if len(candidates) == 0:
            raise ValueError(
                "none of the episodes in training is among those that --dataset.episodes and "
                "--dataset.eval_split leave to train on"
            )
        per_frame = self.labels.draws_per_frame
        uniforms = self.draws.uniforms_at(first, count, per_frame).reshape(count, per_frame)
        frames = self.labels.draw(uniforms, candidates)
        raw = {**frames.observations, ACTION: frames.actions}
        episodes = self._episodes[frames.episodes]
        content = {key: self._units[key].normalize(value) for key, value in raw.items()}
        weights = np.ones(count, np.float32) if self._weights is None else self._weights[episodes]
        content |= {"weight": weights, "style_episode": episodes}
        return self.encode({key: torch.from_numpy(value).to(device) for key, value in content.items()})

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
        """``corrective_loss``: corrective frames' mean weighted loss, unbiased: read its average."""
        if "corrective" not in drawn:
            return {}
        corrective = drawn["corrective"].cpu().numpy()
        return {"corrective_loss": float(losses.cpu().numpy() @ corrective) / (0.5 * len(corrective))}


def _log_borrowed(labels: CorrectiveLabels, n_episodes: int) -> None:
    """Say how many states ``demos`` finds near in other demonstrations."""
    numbers = np.random.default_rng(0).random((BLOCK, labels.draws_per_frame))
    share = labels.draw(numbers, np.arange(n_episodes)).borrowed.mean()
    logger.info(
        "corrective=demos: about %.0f %% of the corrective states are other demonstrations', the rest noise",
        100 * share,
    )


def _units_of(preprocessor: Any, columns: dict[str, np.ndarray]) -> dict[str, Units]:
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
