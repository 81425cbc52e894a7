"""What policies that look at their whole training dataset share: reading it, telling it from another."""

import logging
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_swr.configuration import is_resuming
from lerobot_swr.pauses import pause_frames
from lerobot_swr.policies.configuration_swr import BCConfig
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.policies.state_policy import StatePolicy
from lerobot_swr.policies.training_data import read_training_data
from lerobot_swr.sampling import StepGenerator
from lerobot_swr.style_encoding import Frames
from lerobot_swr.style_table import OUTCOMES
from lerobot_swr.trajectories import Trajectories, load_trajectories

logger = logging.getLogger(__name__)


class DatasetPolicy(StatePolicy):
    """A policy that looks at its whole dataset when it is created.

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.

    Raises:
        ValueError: If the dataset lacks ``observation.state`` or ``action``, their data or statistics are
            not usable, or if a resumed run's dataset is not the checkpoint's.
    """

    config_class = BCConfig
    name = "dataset"  # LeRobot wants one of every class; policies have their own
    config: BCConfig
    pauses: np.ndarray | None = None  # (F,) bool, which frames of the training dataset are left out, if any

    def __init__(self, config: BCConfig, dataset_meta: LeRobotDatasetMetadata | None = None):
        super().__init__(config, dataset_meta)
        self._trajectories: Trajectories | None = None
        self._dataset_meta: LeRobotDatasetMetadata | None = None
        self._new_dataset = False
        if dataset_meta is not None:
            self._adopt_dataset(dataset_meta)

    def _adopt_dataset(self, meta: LeRobotDatasetMetadata) -> None:
        """Read the training dataset; tell whether the checkpoint, if any, was trained on it."""
        config = self.config
        self._trajectories = read_training_data(config, meta, OUTCOMES)
        self._dataset_meta = meta
        fingerprint = self._trajectories.fingerprint([OBS_STATE])
        known = config.dataset_fingerprint
        self._new_dataset = known is not None and known != fingerprint
        if self._new_dataset and is_resuming():
            raise ValueError(
                f"dataset.root={str(meta.root)!r} has {meta.total_episodes} episodes and is not the dataset "
                f"of the checkpoint ({config.num_episodes} episodes, fingerprint {known}); resume with the "
                "original dataset, or fine-tune on this one with --policy.path instead of --resume"
            )
        config.num_episodes, config.dataset_fingerprint = len(self._trajectories), fingerprint
        if config.skip_pauses:
            self._find_pauses()

    def _find_pauses(self) -> None:
        pauses = pause_frames(self.trajectories, self.config.observation_keys, ACTION)
        if pauses.any():
            logger.info(
                "%.1f %% of the frames are pauses before a movement, which a policy without memory cannot "
                "learn: left out (policy.skip_pauses=false keeps them)",
                100 * pauses.mean(),
            )
            self.pauses = pauses

    def read_demonstrations(self, meta: LeRobotDatasetMetadata) -> Trajectories:
        """What a policy like this one takes from a dataset: observations, actions and, if any, outcomes."""
        return load_trajectories(meta, [*self.config.observation_keys, ACTION], OUTCOMES)

    @property
    def trajectories(self) -> Trajectories:
        """The training dataset.

        Raises:
            RuntimeError: If the policy was created without one.
        """
        if self._trajectories is None:
            raise RuntimeError("this needs the training dataset: create the policy with dataset_meta")
        return self._trajectories

    @property
    def moving_trajectories(self) -> Trajectories:
        """The training dataset without the frames that are left out."""
        return self.trajectories if self.pauses is None else self.trajectories.without(self.pauses)

    def normalized_frames(self, episode: int, frames: np.ndarray) -> Frames:
        """Some frames of an episode of the training dataset, as batches bring them."""
        assert self._dataset_meta is not None
        preprocessor, _ = make_bc_pre_post_processors(self.config, self._dataset_meta.stats)
        columns = self.trajectories.episode(episode)
        keys = [*self.config.observation_keys, ACTION]
        batch = preprocessor({key: torch.from_numpy(columns[key][frames]) for key in keys})
        return {key: batch[key] for key in keys}

    @property
    def dataset_root(self) -> Path:
        """Folder of the training dataset.

        Raises:
            RuntimeError: If the policy was created without one.
        """
        _ = self.trajectories
        assert self._dataset_meta is not None
        return Path(self._dataset_meta.root)

    def _translate_checkpoint(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """A run that starts from a checkpoint draws the numbers of its own seed; one that resumes goes on."""
        own = {
            f"{name}.{key}": value
            for name, module in self.named_modules()
            if isinstance(module, StepGenerator)
            for key, value in module.state_dict().items()
        }
        starts = self._dataset_meta is not None and not is_resuming()
        return {**state, **own} if starts else {**own, **state}
