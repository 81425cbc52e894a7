"""``zbc``: behaviour cloning with one trainable style per demonstration."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self, cast

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_swr.behaviors import dataset_behavior_rule, load_style_metrics
from lerobot_swr.policies.bc_policy import BCPolicy
from lerobot_swr.policies.configuration_swr import ZBCConfig
from lerobot_swr.policies.corrections import Corrections, Dynamics, describe_dynamics
from lerobot_swr.policies.held_out_styles import HeldOutStyles
from lerobot_swr.similarity import cached_distances
from lerobot_swr.style_selection import StyleSelection
from lerobot_swr.style_table import StyleTable, load_style_table, make_style_table
from lerobot_swr.styles import StyleCookbook
from lerobot_swr.trajectories import Trajectories

logger = logging.getLogger(__name__)


class ZBCPolicy(BCPolicy):
    """Style-conditioned behaviour cloning (ZBC): one trainable style per demonstration.

    Training fits π_θ(a | s, z_i) to each demonstration τ_i with its own style (eq. 1). A rollout draws one
    style per environment at its first action and keeps it to the end (eq. 2).

    Attributes:
        styles: The cookbook {z_i}.
        corrections: What corrective labels change; None without them.
    """

    config_class = ZBCConfig
    name = "zbc"
    config: ZBCConfig
    _dynamics: Dynamics | None = None

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
        self.held_out = HeldOutStyles(self)
        self.corrections: Corrections | None = None
        if config.corrective != "none" or config.action_targets is not None:
            self.corrections = Corrections(config)
        if self.corrections is not None and self._dynamics is not None:
            stats = cast(LeRobotDatasetMetadata, dataset_meta).stats
            self.corrections.adopt_dataset(config, self._dynamics, stats, self._episode_weights)
        if dataset_meta is not None:
            self.styles.table = self.make_table(self.trajectories, dataset_meta)

    @property
    def _style_dim(self) -> int:
        return self.config.style_dim

    def get_optim_params(self) -> Any:
        """The network's parameters, and the styles with a learning rate of their own."""
        rate = self.config.optimizer_lr * self.config.style_lr_scale
        return [
            {"params": list(self.network.parameters())},
            {"params": list(self.styles.parameters()), "lr": rate},
        ]

    def draw(self, batch: dict[str, Tensor], steps: int = 1) -> dict[str, Tensor]:
        """As `BCPolicy.draw`, with the style of each frame.

        That is ``style_episode`` (B,), the episode whose style it is, in training; in evaluation, where an
        episode may not have been trained on, the ``style`` (B, style_dim) itself.
        """
        episodes = batch["episode_index"]
        if not self.training:
            drawn = {**super().draw(batch, steps), "style": self.held_out.styles(episodes)}
            return drawn if self.corrections is None else self.corrections.encode(drawn)
        if steps > 1 and not self.styles.trained[episodes].all():
            # Partners are episodes seen so far, which differ from step to step.
            split = [{k: v.unflatten(0, (steps, -1))[s] for k, v in batch.items()} for s in range(steps)]
            parts = [self.draw(one) for one in split]
            return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}
        self.styles.mark_trained(episodes)
        drawn = {**super().draw(batch, steps), "style_episode": episodes}
        if self.corrections is not None:
            drawn = self.corrections.correct(drawn, self.styles.trained[: self.config.num_episodes], steps)
        return self._relabel(drawn, steps)

    def _relabel(self, drawn: dict[str, Tensor], steps: int) -> dict[str, Tensor]:
        """What `draw` returns, given frames with the styles of their own episodes: these stay."""
        return drawn

    def frame_losses(self, drawn: dict[str, Tensor]) -> Tensor:
        """(B,) weighted squared error of each frame under its style; a pure function, see `BCPolicy`."""
        errors = self._action_errors(self.network(drawn, self._drawn_styles(drawn)), drawn)
        return errors * drawn["weight"]

    def figures(self, drawn: dict[str, Tensor], losses: Tensor) -> dict[str, float]:
        """Figures to log: those of corrective labels."""
        return {} if self.corrections is None else self.corrections.figures(drawn, losses)

    def predict(self, batch: dict[str, Tensor], style: Tensor | None = None) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d_k) and styles (B, style_dim)."""
        outputs = self.network(batch, style)
        return outputs if self.corrections is None else self.corrections.decode(outputs, batch)

    def _drawn_styles(self, drawn: dict[str, Tensor]) -> Tensor:
        """(B, style_dim) styles of what `draw` returned."""
        return drawn["style"] if "style" in drawn else self.styles.embedding(drawn["style_episode"])

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation; training again makes encoded styles out of date."""
        if mode:
            self.held_out.forget()
        return super().train(mode)

    def distances(self) -> np.ndarray:
        """(N, N) distances of the training dataset's episodes over the features that ν compares.

        Raises:
            RuntimeError: If the policy was created without a dataset.
            ValueError: If a feature to compare is unknown.
        """
        return cached_distances(self.trajectories, self.compared_keys(), self.dataset_root)

    def compared_keys(self) -> Sequence[str]:
        """The features over which ν compares demonstrations."""
        return self.config.observation_keys

    def make_table(self, trajectories: Trajectories, meta: LeRobotDatasetMetadata) -> StyleTable:
        """The table of demonstrations, which need not have been given to the policy when it was created.

        Args:
            trajectories: What `read_demonstrations` finds in the dataset.
            meta: The dataset's metadata.
        """
        rule = dataset_behavior_rule(self.config.behavior_rule, meta.robot_type)
        metrics = load_style_metrics(self.config.style_metrics)
        distances = cached_distances(trajectories, self.compared_keys(), Path(meta.root))
        return make_style_table(trajectories, distances, rule, metrics)

    def reset(self) -> None:
        """Start a rollout: the next action draws new styles, one per environment."""
        self.styles.end_rollout()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d), one style per environment."""
        tasks = cast(str | list[str], batch.get("task", []))
        n_envs = len(batch[OBS_STATE])
        if self._new_dataset and not self.styles.trained.any():
            raise ValueError(
                f"this policy was created to be trained on {self.dataset_root}, which is not the dataset of "
                f"its checkpoint, so its {len(self.styles)} styles are new; to act with the checkpoint's, "
                "load it without dataset_meta (ds_meta), whatever dataset you evaluate on"
            )
        style = self.styles.active_styles(n_envs, [tasks] * n_envs if isinstance(tasks, str) else tasks)
        return self.predict(batch, style)

    # --- Checkpoints ---

    def _adopt_dataset(self, meta: LeRobotDatasetMetadata) -> None:
        from_checkpoint = self.config.dataset_fingerprint is not None
        super()._adopt_dataset(meta)
        if self._new_dataset:
            self.config.num_added_styles = 0
        self._dynamics = describe_dynamics(self.config, meta, self.moving_trajectories, from_checkpoint)

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
        """On another dataset keep the network and start new styles.

        Raises:
            ValueError: If corrective labels are asked of a checkpoint that was trained without, to act.
        """
        corrective = self.config.corrective
        if self._dataset_meta is None and corrective != "none" and "corrections.draws.seed" not in state:
            raise ValueError(
                f"policy.corrective={corrective!r}: this checkpoint was trained without corrective labels, "
                "which take effect in training alone; leave the flag out, or train with it"
            )
        state = super()._translate_checkpoint(state)
        if self.corrections is not None and self._dynamics is not None:
            state = {**state, **self.corrections.fitted("corrections.")}
        if not self._new_dataset:
            return state
        logger.warning(
            "The dataset is not the one that the checkpoint was trained on: the network is kept, %d new "
            "styles are started.",
            len(self.styles),
        )
        kept = {key: value for key, value in state.items() if not key.startswith("styles.")}
        return {**kept, **{f"styles.{key}": value for key, value in self.styles.state_dict().items()}}
