"""The policies ``bc``, ``zbc`` and ``wzbc``."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch
from lerobot.configs import parser
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_swr.behaviors import dataset_behavior_rule, load_style_metrics
from lerobot_swr.policies.configuration_swr import BCConfig, WZBCConfig, ZBCConfig
from lerobot_swr.policies.network import ActionNetwork
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.policies.state_policy import StatePolicy
from lerobot_swr.sampling import SimilarityWeightedSampler, StepGenerator
from lerobot_swr.similarity import cached_distances
from lerobot_swr.style_encoding import Frames, encode_styles
from lerobot_swr.style_selection import StyleSelection
from lerobot_swr.style_table import OUTCOMES, StyleTable, load_style_table, make_style_table
from lerobot_swr.styles import StyleCookbook
from lerobot_swr.trajectories import Trajectories, load_trajectories

logger = logging.getLogger(__name__)

# The held-out loss encodes episodes in the middle of training, so it spends less than
# `lerobot-swr-styles --add`.
HELD_OUT_ENCODING_STEPS = 100
HELD_OUT_FRAMES = 64  # per episode, evenly spread over it
HELD_OUT_CHUNK = 32  # episodes encoded at once


class BCPolicy(StatePolicy):
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
        self._trajectories: Trajectories | None = None
        self._dataset_meta: LeRobotDatasetMetadata | None = None
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
        return ActionNetwork(
            config.observation_keys,
            config.observation_dim,
            self._style_dim,
            config.action_dim,
            config.hidden_dim,
            config.num_hidden,
            config.residual,
        )

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
            config.num_episodes + config.num_added_styles,
            config.style_dim,
            config.style_init_scale,
            config.style_sampling,  # type: ignore[arg-type]
            config.style_selection,
        )
        self._held_out: dict[int, Tensor] = {}
        if dataset_meta is not None:
            self.styles.table = self._make_table(dataset_meta)

    @property
    def _style_dim(self) -> int:
        return self.config.style_dim

    def frame_losses(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """(B,) squared error of each frame under its own episode's style.

        In evaluation mode an episode that was not trained on has no style: the one that `held_out_styles`
        encodes takes its place.
        """
        episodes = batch["episode_index"]
        if self.training:
            self.styles.mark_trained(episodes)
            style = self.styles.embedding(episodes)
        else:
            style = self.held_out_styles(episodes)
        return self._action_errors(self.network(batch, style), batch), {}

    def held_out_styles(self, episodes: Tensor) -> Tensor:
        """(B, style_dim) styles of the (B,) `episodes`, encoded where they were not trained.

        The held-out loss of ``--dataset.eval_split`` thus tells how well *some* style of the policy explains
        an unseen demonstration. Every held-out episode is encoded once per evaluation, from the style of the
        nearest trained one; its z is fitted to frames all over it.

        Raises:
            RuntimeError: If the policy was created without a dataset.
        """
        trained = self.styles.trained.bool()
        styles = self.styles.embedding(episodes).clone()
        missing = [i for i in episodes[~trained[episodes]].unique().tolist() if i not in self._held_out]
        if missing:
            # Evaluation goes through the episodes in order: the next ones are encoded along, at little cost.
            following = (~trained[: self.config.num_episodes]).nonzero().squeeze(1).tolist()
            following = [i for i in following if i > missing[-1] and i not in self._held_out]
            missing = missing + following[: max(0, HELD_OUT_CHUNK - len(missing))]
            candidates = trained[: self.config.num_episodes].nonzero().squeeze(1)
            to_trained = self.distances()[np.ix_(missing, candidates.cpu().numpy())]
            nearest = candidates[torch.from_numpy(to_trained.argmin(axis=1)).to(candidates.device)]
            starts = self.styles.embedding(nearest).detach()[:, None]
            frames = [self._normalized_frames(i) for i in missing]
            encoded, _ = encode_styles(self.network, frames, starts, HELD_OUT_ENCODING_STEPS)
            self._held_out.update(zip(missing, encoded, strict=True))
        for place, episode in enumerate(episodes.tolist()):
            if episode in self._held_out:
                styles[place] = self._held_out[episode]
        return styles

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation; training again makes encoded styles out of date."""
        if mode:
            self._held_out = {}
        return super().train(mode)

    def _normalized_frames(self, episode: int) -> Frames:
        """At most `HELD_OUT_FRAMES` frames of an episode, as batches bring them."""
        assert self._trajectories is not None
        assert self._dataset_meta is not None
        preprocessor, _ = make_bc_pre_post_processors(self.config, self._dataset_meta.stats)
        count = min(HELD_OUT_FRAMES, int(self._trajectories.lengths[episode]))
        chosen = np.linspace(0, self._trajectories.lengths[episode] - 1, count).round().astype(int)
        columns = self._trajectories.episode(episode)
        keys = [*self.config.observation_keys, ACTION]
        frames = preprocessor({key: torch.from_numpy(columns[key][chosen]) for key in keys})
        return {key: frames[key] for key in keys}

    def distances(self) -> np.ndarray:
        """(N, N) distances of the training dataset's episodes over the features that ν compares.

        Raises:
            RuntimeError: If the policy was created without a dataset.
            ValueError: If a feature to compare is unknown.
        """
        if self._trajectories is None or self._dataset_meta is None:
            raise RuntimeError(
                "distances between episodes need the dataset: create the policy with dataset_meta"
            )
        return cached_distances(self._trajectories, self.compared_keys(), Path(self._dataset_meta.root))

    def compared_keys(self) -> Sequence[str]:
        """The features over which ν compares demonstrations."""
        return self.config.observation_keys

    def _make_table(self, meta: LeRobotDatasetMetadata) -> StyleTable:
        assert self._trajectories is not None
        rule = dataset_behavior_rule(self.config.behavior_rule, meta.robot_type)
        metrics = load_style_metrics(self.config.style_metrics)
        return make_style_table(self._trajectories, self.distances(), rule, metrics)

    def reset(self) -> None:
        """Start a rollout: the next action draws new styles, one per environment."""
        self.styles.end_rollout()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d), one style per environment."""
        tasks = cast(str | list[str], batch.get("task", []))
        n_envs = len(batch[OBS_STATE])
        style = self.styles.active_styles(n_envs, [tasks] * n_envs if isinstance(tasks, str) else tasks)
        return self.network(batch, style)

    # --- Checkpoints ---

    def _adopt_dataset(self, meta: LeRobotDatasetMetadata) -> None:
        super()._adopt_dataset(meta)
        if self._new_dataset:
            self.config.num_added_styles = 0

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **kwargs: Any) -> Self:  # type: ignore[override]
        """Load a checkpoint and its table of demonstrations; selections of styles are checked at once.

        Raises:
            ValueError: If the checkpoint is damaged, or the selection of styles is empty.
        """
        policy = super().from_pretrained(pretrained_name_or_path, **kwargs)
        known = ("revision", "token", "cache_dir", "local_files_only", "force_download")
        options = {key: kwargs[key] for key in known if key in kwargs}
        policy._adopt_table(load_style_table(pretrained_name_or_path, **options))
        return policy

    def _adopt_table(self, stored: StyleTable | None) -> None:
        """Take the checkpoint's table, unless it describes another dataset than this policy's."""
        styles = self.styles
        if self._new_dataset:
            if stored is not None and stored.filters:
                logger.warning(
                    "Named filters of the old dataset's styles are dropped: %s", ", ".join(stored.filters)
                )
        elif stored is not None:
            if len(stored) != len(styles):
                raise ValueError(
                    f"styles.json has {len(stored)} rows, the checkpoint {len(styles)} styles; copy the "
                    "checkpoint again"
                )
            styles.table = stored
        elif styles.table is None:
            logger.warning(
                "This checkpoint has no table of its demonstrations (an earlier version made it): filters "
                "are not available. Make it with lerobot-swr-styles CHECKPOINT --dataset.root=DATASET"
            )
        if self._dataset_meta is not None:
            return  # in training; styles to draw need not exist yet
        if self.config.style_interpolate is not None:
            i, j, share = self.config.style_interpolate
            styles.interpolate(int(i), int(j), share)
        elif self.config.style_selection != StyleSelection(neighbours=self.config.style_neighbours):
            styles.allowed()

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        super()._save_pretrained(save_directory, state_dict)
        if self.styles.table is not None:
            self.styles.table.save(Path(save_directory))

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

    def _translate_checkpoint(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Checkpoints from before the draws' seed was kept start a new sequence of draws."""
        draws = {f"draws.{key}": value for key, value in self.draws.state_dict().items()}
        return {**draws, **super()._translate_checkpoint(state)}

    def compared_keys(self) -> Sequence[str]:
        """The features over which ν compares demonstrations.

        Raises:
            ValueError: If a configured feature is unknown.
        """
        keys = self.config.similarity_keys or self.config.observation_keys
        known = [*self.config.observation_keys, ACTION]
        unknown = [key for key in keys if key not in known]
        if unknown:
            raise ValueError(f"similarity_keys={keys}: {unknown} are not among {known}")
        return keys

    def frame_losses(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """(B,) weighted loss of each frame under its pair's style, whose mean has algorithm 1's expectation.

        Figures to log: ``own_style_loss``, the mean squared error of frames under their own style;
        ``relabelled_loss``, the mean of W(τ_i, τ_j) times the error under another style; ``mean_weight``,
        the mean of W(τ_i, τ_j); and ``effective_demos`` per style. The first three are unbiased estimates,
        whichever way pairs are drawn, and defined for every batch: read their averages over time.
        """
        if not self.training:
            return super().frame_losses(batch)
        if self.sampler is None:
            raise RuntimeError("wzbc compares demonstrations to train: create the policy with dataset_meta")
        episodes = batch["episode_index"]
        self.styles.mark_trained(episodes)
        self.sampler.set_candidates(self.styles.trained[: self.config.num_episodes])
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
