"""What policies that read their training dataset have in common: telling datasets apart, safe checkpoints."""

import logging
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch
from huggingface_hub import ModelCard
from lerobot.configs import PreTrainedConfig, parser
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_swr.policies.configuration_swr import BCConfig
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.style_encoding import Frames
from lerobot_swr.style_table import OUTCOMES
from lerobot_swr.trajectories import Trajectories, load_trajectories

logger = logging.getLogger(__name__)

INSTALL_HINT = """
## Install

This policy is a LeRobot plugin: `pip install lerobot_policy_swr`, then use it with `lerobot-eval`,
`lerobot-rollout` or `lerobot-train` as any LeRobot policy.
"""


class DatasetPolicy(PreTrainedPolicy):
    """A LeRobot policy on low-dimensional observations that looks at its whole dataset when it is created.

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.

    Raises:
        ValueError: If the dataset lacks ``observation.state`` or ``action`` or holds NaN, or if a resumed
            run's dataset is not the checkpoint's.
    """

    config_class = PreTrainedConfig
    name = "dataset_policy"
    config: BCConfig

    def __init__(self, config: BCConfig, dataset_meta: LeRobotDatasetMetadata | None = None):
        super().__init__(config)
        config.validate_features()
        self._leave_out_images()
        self._trajectories: Trajectories | None = None
        self._dataset_meta: LeRobotDatasetMetadata | None = None
        self._new_dataset = False
        if dataset_meta is not None:
            self._adopt_dataset(dataset_meta)

    def _leave_out_images(self) -> None:
        images = list(self.config.image_features)
        if images:
            logger.warning("Policy %r does not look at images; left out: %s", self.name, ", ".join(images))
            inputs = cast(dict, self.config.input_features)
            self.config.input_features = {key: ft for key, ft in inputs.items() if key not in images}

    def _adopt_dataset(self, meta: LeRobotDatasetMetadata) -> None:
        """Read the training dataset; tell whether the checkpoint, if any, was trained on it."""
        config = self.config
        outcomes = [key for key in OUTCOMES if key in meta.features]
        self._trajectories = load_trajectories(meta, [*config.observation_keys, ACTION, *outcomes])
        self._dataset_meta = meta
        fingerprint = self._trajectories.fingerprint([OBS_STATE])
        known = config.dataset_fingerprint
        self._new_dataset = known is not None and known != fingerprint
        if self._new_dataset and parser.parse_arg("resume") in ("true", "True", "yes", "1"):
            raise ValueError(
                f"dataset.root={str(meta.root)!r} has {meta.total_episodes} episodes and is not the dataset "
                f"of the checkpoint ({config.num_episodes} episodes, fingerprint {known}); resume with the "
                "original dataset, or fine-tune on this one with --policy.path instead of --resume"
            )
        config.num_episodes, config.dataset_fingerprint = len(self._trajectories), fingerprint

    @property
    def trajectories(self) -> Trajectories:
        """The training dataset.

        Raises:
            RuntimeError: If the policy was created without one.
        """
        if self._trajectories is None:
            raise RuntimeError("this needs the training dataset: create the policy with dataset_meta")
        return self._trajectories

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

    # --- Checkpoints ---

    @classmethod
    def _load_as_safetensor(cls, model: Self, model_file: str, map_location: str, strict: bool) -> Self:  # type: ignore[override]
        """Load weights; unlike LeRobot's default, a damaged or incomplete file is an error.

        Raises:
            ValueError: If the file is truncated, or lacks a tensor of the policy or has one of another shape.
        """
        try:
            state = load_file(model_file, device=map_location)
        except SafetensorError as error:
            raise ValueError(
                f"{model_file}: damaged checkpoint ({error}); use another checkpoint, or copy it again"
            ) from error
        state = model._translate_checkpoint(state)
        own = model.state_dict()
        missing = sorted(set(own) - set(state))
        misfits = [
            f"{key}: {tuple(state[key].shape)} in the file, {tuple(own[key].shape)} by config.json"
            for key in own.keys() & state.keys()
            if own[key].shape != state[key].shape
        ]
        if missing or misfits:
            raise ValueError(
                f"{model_file}: does not fit its config.json; missing: {missing}; misfits: {misfits}; "
                "is it the checkpoint of another policy or dataset?"
            )
        model.load_state_dict(state, strict=False)
        return model

    def _translate_checkpoint(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """The part of a checkpoint that is to be loaded into this policy."""
        return state

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """LeRobot's model card, with a word on how to install the plugin."""
        card = super().generate_model_card(*args, **kwargs)
        card.text += INSTALL_HINT
        return card
