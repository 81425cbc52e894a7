"""The policies ``bc``, ``zbc`` and ``wzbc``."""

import logging
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch
from huggingface_hub import ModelCard
from lerobot.configs import parser
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_swr.policies.configuration_swr import BCConfig, WZBCConfig, ZBCConfig
from lerobot_swr.policies.network import ActionNetwork
from lerobot_swr.sampling import SimilarityWeightedSampler, StepGenerator
from lerobot_swr.similarity import cached_distances
from lerobot_swr.styles import StyleCookbook
from lerobot_swr.trajectories import Trajectories, load_trajectories

logger = logging.getLogger(__name__)

INSTALL_HINT = """
## Install

This policy is a LeRobot plugin: `pip install lerobot_policy_swr`, then use it with `lerobot-eval`,
`lerobot-rollout` or `lerobot-train` as any LeRobot policy.
"""


class BCPolicy(PreTrainedPolicy):
    """Behaviour cloning: a deterministic policy fitted by squared error.

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.
        **kwargs: Whatever else LeRobot's factory passes (``dataset_stats``).

    Raises:
        ValueError: If the dataset lacks ``observation.state`` or ``action`` or holds NaN, or if a resumed
            run's dataset is not the checkpoint's.
    """

    config_class = BCConfig
    name = "bc"
    config: BCConfig

    def __init__(self, config: BCConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any):
        super().__init__(config)
        config.validate_features()
        self._leave_out_images()
        if config.flush_denormal:
            torch.set_flush_denormal(True)
        self._trajectories: Trajectories | None = None
        self._dataset_root: Path | None = None
        self._new_dataset = False
        if dataset_meta is not None:
            self._adopt_dataset(dataset_meta)
        self.network = self._make_network()
        self._episode_weights = self._balance_weights()

    @property
    def _style_dim(self) -> int:
        return 0

    def _make_network(self) -> ActionNetwork:
        config = self.config
        inputs = cast(dict, config.input_features)
        return ActionNetwork(
            config.observation_keys,
            sum(inputs[key].shape[0] for key in config.observation_keys),
            self._style_dim,
            config.action_feature.shape[0],  # type: ignore[union-attr]
            config.hidden_dim,
            config.num_hidden,
            config.residual,
        )

    def _leave_out_images(self) -> None:
        images = list(self.config.image_features)
        if images:
            logger.warning("Policy %r does not look at images; left out: %s", self.name, ", ".join(images))
            inputs = cast(dict, self.config.input_features)
            self.config.input_features = {key: ft for key, ft in inputs.items() if key not in images}

    def _adopt_dataset(self, meta: LeRobotDatasetMetadata) -> None:
        """Read the training dataset; tell whether the checkpoint, if any, was trained on it."""
        config = self.config
        self._trajectories = load_trajectories(meta, [*config.observation_keys, ACTION])
        self._dataset_root = Path(meta.root)
        fingerprint = self._trajectories.fingerprint([OBS_STATE])
        known = config.dataset_fingerprint
        self._new_dataset = known is not None and known != fingerprint
        if self._new_dataset and parser.parse_arg("resume") in ("true", "True", "1"):
            raise ValueError(
                f"dataset.root={str(meta.root)!r} has {meta.total_episodes} episodes and is not the dataset "
                f"of the checkpoint ({config.num_episodes} episodes, fingerprint {known}); resume with the "
                "original dataset, or fine-tune on this one with --policy.path instead of --resume"
            )
        config.num_episodes, config.dataset_fingerprint = len(self._trajectories), fingerprint

    def _balance_weights(self) -> Tensor | None:
        """(N,) mean length / length of each episode: uniform frames become uniform episodes."""
        if not self.config.balance_episodes or self._trajectories is None:
            return None
        lengths = torch.from_numpy(self._trajectories.lengths).to(torch.float32)
        return lengths.mean() / lengths

    # --- LeRobot's training interface ---

    def get_optim_params(self) -> Any:
        """All parameters."""
        return self.parameters()

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Training loss of a batch of frames.

        Args:
            batch: Normalised observations (B, d), ``action`` (B, A) and ``episode_index`` (B,).
            reduction: ``mean``, or ``none`` for one loss per frame.

        Returns:
            The loss, scalar or (B,), and figures to log.
        """
        losses, figures = self.frame_losses(batch)
        if self._episode_weights is not None:
            self._episode_weights = self._episode_weights.to(losses.device)
            losses = losses * self._episode_weights[batch["episode_index"]]
        return (losses if reduction == "none" else losses.mean()), figures

    def frame_losses(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """(B,) loss of each frame, before episodes are balanced, and figures to log."""
        return self._action_errors(self.network(batch), batch), {}

    @staticmethod
    def _action_errors(predicted: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """(B,) squared error of (B, A) actions, mean over the action's dimensions."""
        return (predicted - batch[ACTION]).square().mean(dim=-1)

    # --- LeRobot's inference interface ---

    def reset(self) -> None:
        """Start a rollout."""

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d)."""
        return self.network(batch)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, 1, A): this policy predicts one action at a time."""
        return self.select_action(batch).unsqueeze(1)

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


class ZBCPolicy(BCPolicy):
    """Style-conditioned behaviour cloning (ZBC): one trainable style per demonstration.

    Training fits π_θ(a | s, z_i) to each demonstration τ_i with its own style (eq. 1). A rollout draws one
    style per environment at its first action and keeps it to the end (eq. 2).

    Attributes:
        styles: The cookbook {z_i}.
    """

    config_class = ZBCConfig
    name = "zbc"
    config: ZBCConfig

    def __init__(self, config: ZBCConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any):
        super().__init__(config, dataset_meta, **kwargs)
        if config.num_episodes is None:
            raise ValueError(
                f"policy {self.name!r} keeps one style per episode of its dataset: create it with a dataset "
                "(dataset_meta) or from a checkpoint (num_episodes)"
            )
        self.styles = StyleCookbook(
            config.num_episodes,
            config.style_dim,
            config.style_init_scale,
            config.style_sampling,  # type: ignore[arg-type]
            config.style_episodes,
        )

    @property
    def _style_dim(self) -> int:
        return self.config.style_dim

    def frame_losses(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """(B,) squared error of each frame under its own episode's style.

        In evaluation mode an episode that was not trained on has no style of its own: the nearest trained
        episode's style stands in.
        """
        episodes = batch["episode_index"]
        if self.training:
            self.styles.mark_trained(episodes)
        else:
            episodes = self.stand_ins()[episodes]
        predicted = self.network(batch, self.styles.embedding(episodes))
        return self._action_errors(predicted, batch), {}

    def stand_ins(self) -> Tensor:
        """(N,) int64: every trained episode itself, for every other the nearest trained one.

        Raises:
            RuntimeError: If the policy was created without a dataset.
        """
        is_trained = self.styles.trained.bool()
        own = torch.arange(len(self.styles), device=is_trained.device)
        if is_trained.all():
            return own
        trained = is_trained.nonzero().squeeze(1)
        nearest = self.distances()[:, trained.cpu().numpy()].argmin(axis=1)
        return torch.where(is_trained, own, trained[torch.from_numpy(nearest).to(own.device)])

    def distances(self) -> np.ndarray:
        """(N, N) distances of the training dataset's episodes.

        Raises:
            RuntimeError: If the policy was created without a dataset.
        """
        if self._trajectories is None or self._dataset_root is None:
            raise RuntimeError(
                "distances between episodes need the dataset: create the policy with dataset_meta"
            )
        return cached_distances(self._trajectories, self.config.observation_keys, self._dataset_root)

    def reset(self) -> None:
        """Start a rollout: the next action draws new styles, one per environment."""
        self.styles.end_rollout()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d), one style per environment."""
        return self.network(batch, self.styles.active_styles(len(batch[OBS_STATE])))

    def _translate_checkpoint(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """On another dataset keep the network and start new styles."""
        if not self._new_dataset:
            return state
        logger.warning(
            "The dataset is not the one that the checkpoint was trained on: the network is kept, %d new "
            "styles are started.",
            len(self.styles),
        )
        kept = {key: value for key, value in state.items() if not key.startswith("styles.")}
        return {**kept, **{f"styles.{key}": value for key, value in self.styles.state_dict().items()}}


class WZBCPolicy(ZBCPolicy):
    """ZBC with similarity weighted regression (WZBC): similar demonstrations teach each other's styles.

    With probability p a frame of τ_i is relabelled with the style z_j of another demonstration; its loss is
    weighted by W(τ_i, τ_j) and sends no gradient into z_j (algorithm 1). The pairs are drawn here, in
    `forward`, because LeRobot's frame sampler belongs to its training loop.

    Raises:
        ValueError: In addition to `ZBCPolicy`, if the dataset has a single episode.
    """

    config_class = WZBCConfig
    name = "wzbc"
    config: WZBCConfig

    def __init__(self, config: WZBCConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any):
        super().__init__(config, dataset_meta, **kwargs)
        self.draws = StepGenerator()
        self.sampler: SimilarityWeightedSampler | None = None
        if dataset_meta is not None:
            if len(self.styles) < 2:
                raise ValueError(
                    f"dataset.root={str(dataset_meta.root)!r} has a single episode; wzbc compares episodes "
                    "and needs at least 2: record more, or use --policy.type=zbc"
                )
            self.sampler = SimilarityWeightedSampler(
                self.distances(),
                config.beta,
                config.p,
                config.similarity_normalization,  # type: ignore[arg-type]
                config.partner_sampling,  # type: ignore[arg-type]
            )

    def distances(self) -> np.ndarray:
        """(N, N) distances of the training dataset's episodes over the configured features."""
        keys = self.config.similarity_keys or self.config.observation_keys
        if self._trajectories is None or self._dataset_root is None:
            raise RuntimeError(
                "distances between episodes need the dataset: create the policy with dataset_meta"
            )
        unknown = [key for key in keys if key not in self._trajectories.columns]
        if unknown:
            raise ValueError(
                f"similarity_keys={keys}: {unknown} are not among {list(self._trajectories.columns)}"
            )
        return cached_distances(self._trajectories, keys, self._dataset_root)

    def frame_losses(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """(B,) weighted loss of each frame under its pair's style, whose mean has algorithm 1's expectation.

        Figures to log: ``own_style_loss``, the mean squared error of frames under their own style;
        ``relabelled_loss``, the mean of W(τ_i, τ_j) times the error under another style; ``mean_weight``, the mean
        of W(τ_i, τ_j); and ``effective_demos`` per style. The first three are unbiased estimates, whichever way
        pairs are drawn, and defined for every batch: read their averages over time.
        """
        if not self.training or self.sampler is None:
            return super().frame_losses(batch)
        episodes = batch["episode_index"]
        self.styles.mark_trained(episodes)
        self.sampler.set_candidates(self.styles.trained)
        pairs = self.sampler.draw(episodes, self.draws.next())
        style = self.styles.embedding(pairs.styles)
        style = torch.where(pairs.relabelled[:, None], style.detach(), style)
        losses = self._action_errors(self.network(batch, style), batch) * pairs.weights

        p = self.config.p
        figures = {"effective_demos": self.sampler.effective_demos}
        with torch.no_grad():
            if p < 1:
                figures["own_style_loss"] = (losses * ~pairs.relabelled).mean().item() / (1 - p)
            if p > 0:
                figures["relabelled_loss"] = (losses * pairs.relabelled).mean().item() / p
                figures["mean_weight"] = (pairs.weights * pairs.relabelled).mean().item() / p
        return losses, figures
