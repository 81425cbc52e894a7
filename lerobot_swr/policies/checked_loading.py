"""Loads a checkpoint's weights and refuses what LeRobot would only log: damage, gaps, misfits."""

import json
from pathlib import Path
from typing import Any, cast

from huggingface_hub import ModelCard
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_swr.dataset_checks import check_dimensions
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.sharing.policy_card import TRAINING_KEYS, policy_card


class CheckedLoading:
    """For a policy, before `PreTrainedPolicy` among its bases.

    Attributes:
        features_of: What the policy's features are those of, for messages.
    """

    features_of: str = "environment"

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
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
        state = model.adapted(state)
        own = model.state_dict()
        # Of tensors that share their memory, a file holds one.
        shared = {own[key].data_ptr() for key in own.keys() & state.keys()}
        missing = sorted(key for key in set(own) - set(state) if own[key].data_ptr() not in shared)
        misfits = [
            f"{key}: {tuple(state[key].shape)} in the file, {tuple(own[key].shape)} by config.json"
            for key in own.keys() & state.keys()
            if own[key].shape != state[key].shape
        ]
        if misfits:
            model.check_features(Path(model_file).with_name(CONFIG_NAME))
        if missing or misfits:
            raise ValueError(
                f"{model_file}: does not fit its config.json; missing: {missing}; misfits: {misfits}; "
                "is it the checkpoint of another policy or dataset?"
            )
        model.load_state_dict(state, strict=False)
        return model

    def adapted(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """What of a checkpoint's tensors, by name, is to be loaded into this policy."""
        return state

    def check_features(self, stored_config: Path) -> None:
        """Refuse a dataset or environment whose features have other dimensions than the checkpoint's.

        Raises:
            ValueError: Naming the feature and both dimensions.
        """
        config = cast(PreTrainedPolicy, self).config
        assert isinstance(config, StateConfig)
        stored = json.loads(stored_config.read_text()) if stored_config.is_file() else {}
        features = {**(stored.get("input_features") or {}), **(stored.get("output_features") or {})}
        check_dimensions(
            self.features_of,
            {key: [d] for key, d in config.dimensions.items()},
            {key: ft["shape"] for key, ft in features.items()},
            "train a new policy on it",
        )

    def generate_model_card(
        self,
        dataset_repo_id: str | None = None,
        model_type: str | None = None,
        license: str | None = None,
        tags: list[str] | None = None,
        cfg: TrainPipelineConfig | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card of this package instead of LeRobot's; licence and tags are the configuration's."""
        training = None if cfg is None else {key: getattr(cfg, key) for key in TRAINING_KEYS}
        return policy_card(self, dataset=dataset_repo_id, training=training)
