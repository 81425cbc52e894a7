"""What the diffusion baselines share: denoises actions, given a window of observations."""

from abc import abstractmethod
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Self

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_swr.dataset_statistics import Statistics
from lerobot_swr.policies.backbones.backbone import check_same_shape
from lerobot_swr.policies.backbones.modeling_mlp import ObservationEncoder
from lerobot_swr.policies.baselines.averaging import moving_average
from lerobot_swr.policies.baselines.configuration_baselines import WindowDiffusionConfig
from lerobot_swr.policies.baselines.diffusion import Bounds, Ddpm, Generators, Karras, Noised
from lerobot_swr.policies.baselines.history import ObservationHistory
from lerobot_swr.policies.baselines.processor_baselines import make_beso_pre_post_processors
from lerobot_swr.policies.checked_loading import CheckedLoading
from lerobot_swr.policies.training_data import adopt_features, read_training_data
from lerobot_swr.random_streams import StepGenerator
from lerobot_swr.run_context import RunContext
from lerobot_swr.trajectories import Trajectories

PAD = f"{OBS_STATE}_is_pad"
ACTION_PAD = f"{ACTION}_is_pad"


class WindowDiffusionPolicy(CheckedLoading, PreTrainedPolicy):
    """Denoises actions, given a window of observations, with a transformer.

    Attributes:
        network: What is trained.
        average: The moving average of its weights, which acts and on which held-out losses are taken.

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.
        **kwargs: Whatever else LeRobot's factory passes (``dataset_stats``).

    Raises:
        ModuleNotFoundError: If diffusers is not installed.
        ValueError: If the dataset lacks ``observation.state`` or ``action``, or their data or statistics are
            not usable.
    """

    config_class = WindowDiffusionConfig
    name = "window_diffusion"  # LeRobot wants one of every class; policies have their own
    config: WindowDiffusionConfig

    def __init__(
        self,
        config: WindowDiffusionConfig,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ):
        super().__init__(config)
        self.features_of = "environment" if dataset_meta is None else f"dataset {dataset_meta.root}"
        adopt_features(config, dataset_meta)
        self.encoder = ObservationEncoder(config.observation_keys)
        self.network = self._make_network()
        self.average = moving_average(self.network, config.ema_decay)
        self.process = self._make_process()
        self.draws = StepGenerator()
        self.action_low: Tensor
        self.action_high: Tensor
        self.register_buffer("action_low", torch.full((config.action_dim,), -torch.inf))
        self.register_buffer("action_high", torch.full((config.action_dim,), torch.inf))
        self._has_dataset = dataset_meta is not None
        if dataset_meta is not None:
            run = RunContext.current(dataset_meta)
            self._set_bounds(read_training_data(config, dataset_meta, run), dataset_meta.stats)
        self.reset()

    @abstractmethod
    def _make_network(self) -> nn.Module:
        """The denoising network."""

    @abstractmethod
    def _make_process(self) -> Ddpm | Karras:
        """The diffusion process."""

    @property
    @abstractmethod
    def _n_actions(self) -> int:
        """K, actions that are denoised together."""

    def _set_bounds(self, trajectories: Trajectories, stats: Statistics | None) -> None:
        """Remember the range of the demonstrations' normalised actions."""
        normalize, _ = make_beso_pre_post_processors(self.config, stats)
        columns = {key: torch.from_numpy(trajectories.columns[key]) for key in self.config.dimensions}
        ends = {key: torch.stack([value.amin(dim=0), value.amax(dim=0)]) for key, value in columns.items()}
        low, high = normalize(ends)[ACTION]
        self.action_low.copy_(low)
        self.action_high.copy_(high)

    # --- LeRobot's training interface ---

    def get_optim_params(self) -> Any:
        """The network's parameters; its average is not trained."""
        return self.network.parameters()

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Training loss of a batch of windows.

        In evaluation mode the average's loss is taken, with the same noise every time.

        Args:
            batch: Normalised observations (B, T, d), ``action`` (B, K, A), and what LeRobot's datasets say
                about steps beyond the episode, ``observation.state_is_pad`` (B, T), ``action_is_pad`` (B, K).
            reduction: ``mean``, or ``none`` for one loss per window.

        Returns:
            The loss, scalar or (B,), and no further figures. Steps beyond the episode add nothing to it.
        """
        actions = batch[ACTION]
        with self._own_draws(actions.device):
            noised: Noised = self.process.noised(actions)
            network = self.network if self.training else self.average
            predicted = network(self.encoder(batch), noised.inputs, noised.level, batch[PAD])
        check_same_shape(predicted, noised.target)
        errors = (predicted - noised.target).square().mean(dim=-1)  # (B, K)
        losses = (errors * ~batch[ACTION_PAD]).mean(dim=-1)
        return (losses if reduction == "none" else losses.mean()), {}

    @contextmanager
    def _own_draws(self, device: torch.device) -> Iterator[None]:
        """Make torch's global generators draw, for noise and dropout, what depends on the step alone.

        So that a resumed run draws what an uninterrupted one does, see `StepGenerator`.
        """
        seed = self.draws.next().initial_seed() if self.training else int(self.draws.seed)
        with torch.random.fork_rng([device] if device.type == "cuda" else []):
            torch.manual_seed(seed)
            yield

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation."""
        if mode and self.config.flush_denormal:
            torch.set_flush_denormal(True)
        return super().train(mode)

    def update(self) -> None:
        """Go on with the average; LeRobot calls this after every step of the optimizer."""
        self.average.update_parameters(self.network)

    # --- LeRobot's inference interface ---

    def reset(self) -> None:
        """Start a rollout."""
        self.history = ObservationHistory(self.config.observation_keys, self.config.n_obs_steps)
        self._planned: deque[Tensor] = deque()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised current observations (B, d)."""
        self.history.push(batch)
        if not self._planned:
            self._planned.extend(self.sample(self.history.window()).unbind(dim=1))
        return self._planned.popleft()

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """(B, C, A) normalised actions from the current one on, for normalised observations (B, d).

        The observations become part of the rollout's history, as with `select_action`.
        """
        self.history.push(batch)
        return self.sample(self.history.window())

    def sample(self, window: dict[str, Tensor], generator: Generators = None) -> Tensor:
        """(B, C, A) actions to execute, given a window as `ObservationHistory.window` has it."""
        observations, is_pad = self.encoder(window), window["is_pad"]
        like = observations.new_empty(len(observations), self._n_actions, self.config.action_dim)
        start = self._start(self.process.prior(like, generator))
        actions = self.process.denoise(
            lambda noised, level: self.average(observations, noised, level, is_pad),
            start,
            Bounds(self.action_low, self.action_high),
            generator,
        )
        return self._executed(actions)

    def _start(self, noise: Tensor) -> Tensor:
        """(B, K, A), where denoising starts."""
        return noise

    def _executed(self, actions: Tensor) -> Tensor:
        """(B, C, A), the part of (B, K, A) denoised actions that is executed."""
        return actions

    # --- Checkpoints ---

    def adapted(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """On a dataset, which need not be the checkpoint's, its own bounds of the actions hold."""
        if not self._has_dataset:
            return state
        return {**state, "action_low": self.action_low, "action_high": self.action_high}
