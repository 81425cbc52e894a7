"""``bc``: behaviour cloning without styles."""

from typing import Any

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_swr.frame_rows import FrameRows
from lerobot_swr.policies.configuration_swr import BCConfig
from lerobot_swr.policies.dataset_policy import DatasetPolicy
from lerobot_swr.policies.network import ActionNetwork, check_same_shape


class BCPolicy(DatasetPolicy):
    """Behaviour cloning: a deterministic policy fitted by squared error.

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.
        **kwargs: Whatever else LeRobot's factory passes (``dataset_stats``).

    Raises:
        ValueError: If the dataset lacks ``observation.state`` or ``action``, their data or statistics are
            not usable, or if a resumed run's dataset is not the checkpoint's.
    """

    config_class = BCConfig
    name = "bc"
    config: BCConfig

    def __init__(self, config: BCConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any):
        super().__init__(config, dataset_meta)
        self.network = self._make_network()
        self._episode_weights = self._balance_weights()
        self._pause_weights: Tensor | None = None  # (F,) 0 in a pause, their mean over all frames is 1
        if self.pauses is not None:
            moves = torch.from_numpy(~self.pauses).to(torch.float32)
            self._pause_weights, self._rows = moves / moves.mean(), FrameRows(self.trajectories)

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

    def _balance_weights(self) -> Tensor | None:
        """(N,) mean length / length of each episode: uniform frames become uniform episodes."""
        if not self.config.balance_episodes or self._trajectories is None:
            return None
        lengths = torch.from_numpy(self.moving_trajectories.lengths).to(torch.float32)
        return lengths.mean() / lengths

    # --- LeRobot's training interface ---

    def get_optim_params(self) -> Any:
        """All parameters."""
        return self.parameters()

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Training loss of a batch of frames: `draw`, then `frame_losses`.

        Args:
            batch: Normalised observations (B, d), ``action`` (B, A), ``episode_index`` (B,) and, where the
                dataset has pauses, ``index`` (B,), the dataset's number of each frame.
            reduction: ``mean``, or ``none`` for one loss per frame.

        Returns:
            The loss, scalar or (B,), and figures to log.
        """
        drawn = self.draw(batch)
        losses = self.frame_losses(drawn)
        figures = self.figures(drawn, losses.detach()) if self.training else {}
        return (losses if reduction == "none" else losses.mean()), figures

    def draw(self, batch: dict[str, Tensor], steps: int = 1) -> dict[str, Tensor]:
        """What the loss of a batch is computed from, all random draws and bookkeeping included.

        Args:
            batch: As in `forward`; the frames of consecutive steps may come together, one after the other.
            steps: Number of steps whose frames these are, as many of each.

        Returns:
            Observations (B, d_k), ``action`` (B, A) and ``weight`` (B,), the factor of each frame's loss.
        """
        keys = [*self.config.observation_keys, ACTION]
        return {**{key: batch[key] for key in keys}, "weight": self.frame_weights(batch)}

    def frame_weights(self, batch: dict[str, Tensor]) -> Tensor:
        """(B,) factors that let uniformly drawn frames count every episode alike, and pauses not at all."""
        episodes = batch["episode_index"]
        weights = torch.ones(len(episodes), device=episodes.device)
        if self._episode_weights is not None:
            self._episode_weights = self._episode_weights.to(episodes.device)
            weights = self._episode_weights[episodes]
        if self._pause_weights is not None:
            self._pause_weights = self._pause_weights.to(episodes.device)
            weights = weights * self._pause_weights[self._rows(batch)]
        return weights

    def frame_losses(self, drawn: dict[str, Tensor]) -> Tensor:
        """(B,) weighted loss of each frame; a pure function of the parameters and of what `draw` returned."""
        return self._action_errors(self.network(drawn), drawn) * drawn["weight"]

    def figures(self, drawn: dict[str, Tensor], losses: Tensor) -> dict[str, float]:
        """Figures to log about what `draw` returned and the (B,) losses of `frame_losses`."""
        return {}

    @staticmethod
    def _action_errors(predicted: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """(B,) squared error of (B, A) actions, mean over the action's dimensions.

        Raises:
            ValueError: If the batch's actions have another shape than those that are predicted.
        """
        check_same_shape(predicted, batch[ACTION])
        return (predicted - batch[ACTION]).square().mean(dim=-1)

    # --- LeRobot's inference interface ---

    def predict(self, batch: dict[str, Tensor], style: Tensor | None = None) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d_k) and styles (B, style_dim)."""
        return self.network(batch, style)

    def reset(self) -> None:
        """Start a rollout."""

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, d)."""
        return self.predict(batch)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, 1, A): this policy predicts one action at a time."""
        return self.select_action(batch).unsqueeze(1)
