"""What this package's policies share: low-dimensional observations only, checkpoints that are checked."""

import logging
from typing import Any, Self, cast

import torch
from huggingface_hub import ModelCard
from lerobot.policies import PreTrainedPolicy
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_swr.policies.state_config import StateConfig

logger = logging.getLogger(__name__)

INSTALL_HINT = """
## Install

This policy is a LeRobot plugin: `pip install lerobot_policy_swr`, then use it with `lerobot-eval`,
`lerobot-rollout` or `lerobot-train` as any LeRobot policy.
"""


class StatePolicy(PreTrainedPolicy):
    """A policy of low-dimensional observations.

    Args:
        config: The policy's configuration.

    Raises:
        ValueError: If the dataset lacks ``observation.state`` or ``action``.
    """

    config_class = StateConfig
    name = "state"  # LeRobot wants one of every class; policies have their own
    config: StateConfig

    def __init__(self, config: StateConfig):
        super().__init__(config)
        config.validate_features()
        self._leave_out_images()
        if config.flush_denormal:
            torch.set_flush_denormal(True)

    def _leave_out_images(self) -> None:
        images = list(self.config.image_features)
        if images:
            logger.warning("Policy %r does not look at images; left out: %s", self.name, ", ".join(images))
            inputs = cast(dict, self.config.input_features)
            self.config.input_features = {key: ft for key, ft in inputs.items() if key not in images}

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
