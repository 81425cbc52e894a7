"""What this package's policies share: low-dimensional observations only, checkpoints that are checked."""

import json
from pathlib import Path
from typing import Any, Self

import torch
from huggingface_hub import ModelCard
from huggingface_hub.constants import CONFIG_NAME
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_swr.dataset_checks import check_dimensions
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.policies.training_data import adopt_features

INSTALL_HINT = """
## Install

This policy is a LeRobot plugin: `pip install lerobot_policy_swr`, then use it with `lerobot-eval`,
`lerobot-rollout` or `lerobot-train` as any LeRobot policy.
"""


class StatePolicy(PreTrainedPolicy):
    """A policy of low-dimensional observations.

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.

    Raises:
        ValueError: If the dataset lacks ``observation.state`` or ``action``, or an input of the policy.
    """

    config_class = StateConfig
    name = "state"  # LeRobot wants one of every class; policies have their own
    config: StateConfig

    def __init__(self, config: StateConfig, dataset_meta: LeRobotDatasetMetadata | None = None):
        super().__init__(config)
        self._features_of = "environment" if dataset_meta is None else f"dataset {dataset_meta.root}"
        adopt_features(config, dataset_meta)
        if config.flush_denormal:
            torch.set_flush_denormal(True)

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
        if misfits:
            model._check_dimensions(Path(model_file).with_name(CONFIG_NAME))
        if missing or misfits:
            raise ValueError(
                f"{model_file}: does not fit its config.json; missing: {missing}; misfits: {misfits}; "
                "is it the checkpoint of another policy or dataset?"
            )
        model.load_state_dict(state, strict=False)
        return model

    def _check_dimensions(self, stored_config: Path) -> None:
        """Refuse a dataset or environment whose features have other dimensions than the checkpoint's."""
        stored = json.loads(stored_config.read_text()) if stored_config.is_file() else {}
        features = {**(stored.get("input_features") or {}), **(stored.get("output_features") or {})}
        check_dimensions(
            self._features_of,
            {key: [d] for key, d in self.config.dimensions.items()},
            {key: ft["shape"] for key, ft in features.items()},
            "train a new policy on it",
        )

    def _translate_checkpoint(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """The part of a checkpoint that is to be loaded into this policy."""
        return state

    def generate_model_card(self, *args: Any, **kwargs: Any) -> ModelCard:
        """LeRobot's model card, with a word on how to install the plugin."""
        card = super().generate_model_card(*args, **kwargs)
        card.text += INSTALL_HINT
        return card
