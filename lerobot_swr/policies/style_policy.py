"""A style policy: a cookbook of styles, a backbone that acts by them, and the steps of a lesson."""

from dataclasses import replace
from typing import Any, Self, cast

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_swr.corrective.relative_actions import RelativeActions
from lerobot_swr.policies.configuration_swr import BCConfig, WZBCConfig, ZBCConfig
from lerobot_swr.policies.dynamics import adopt_dynamics, make_relative_actions
from lerobot_swr.policies.lessons import Balance, Blur, Correct, Lesson, LessonStep, Relabel, logged
from lerobot_swr.policies.loss_errors import LossErrors
from lerobot_swr.policies.row_adam import FROM_ROWS
from lerobot_swr.policies.scene_defaults import adopt_scene_defaults
from lerobot_swr.policies.stored_styles import StoredStyles
from lerobot_swr.policies.style_making import make_balance, make_cookbook, make_sampler
from lerobot_swr.policies.training_data import TrainingData, adopt_features, adopt_names
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.encoding import ActionErrors, Imitation
from lerobot_swr.styles.held_out import HeldOutStyles
from lerobot_swr.trajectories import Trajectories


class StylePolicy(StoredStyles, PreTrainedPolicy):
    """π_θ(a | s, z), with one trainable style z_i per demonstration τ_i.

    ``zbc`` fits each demonstration with its own style (eq. 1); in ``wzbc`` similar demonstrations teach each
    other's styles (algorithm 1, see `Relabel`); ``bc`` has no styles. They differ in their configurations
    alone. A rollout draws one style per environment at its first action and keeps it to the end (eq. 2).

    Args:
        config: The policy's configuration.
        dataset_meta: Metadata of the training dataset; given when the policy is trained, absent at inference.
        **kwargs: Whatever else LeRobot's factory passes (``dataset_stats``).

    Attributes:
        backbone: π_θ.
        styles: The cookbook {z_i}; ``bc`` has none.
        relative: Translates between actions and the backbone's, where these are relative to the state.
        balance: The first step of a lesson; None where there is no dataset.
        correct: The second, with corrective labels.
        relabel: The third, of ``wzbc``.
        blur: The last, with noise on the styles.
        data: The training dataset; None at inference.

    Raises:
        ValueError: If the dataset's features, data or statistics are not usable, there is a single episode to
            train ``wzbc`` on, or a resumed run's dataset is not the checkpoint's.
    """

    config_class = BCConfig
    name = "style"  # LeRobot wants one of every class; policies have their own
    config: BCConfig
    styles: StyleCookbook

    def __init__(self, config: BCConfig, dataset_meta: LeRobotDatasetMetadata | None = None, **kwargs: Any):
        super().__init__(config)
        self._has_trained = False
        self.features_of = "environment" if dataset_meta is None else f"dataset {dataset_meta.root}"
        adopt_features(config, dataset_meta)
        self.data: TrainingData | None = None
        self.balance: Balance | None = None
        if dataset_meta is not None:
            adopt_names(config, dataset_meta)
            self.data = data = TrainingData.read(config, dataset_meta)
            self.balance = make_balance(config, data)
            if isinstance(config, ZBCConfig):
                adopt_scene_defaults(config, data.scene_variation)
            config.traits.adopt(config, data.trajectories.columns, data.trajectories.lengths)
        style_dim = (config.style_dim or 0) if isinstance(config, ZBCConfig) else 0
        stats = kwargs.get("dataset_stats") if dataset_meta is None else dataset_meta.stats
        self.backbone = config.traits.make(config, style_dim, stats, dataset_meta)
        if self.data is not None:
            self.backbone.fit(self.data.trajectories.columns, self.data.normalize)
            config.num_episodes = len(self.data.trajectories)
            config.dataset_fingerprint = self.data.fingerprint
        self.has_styles = isinstance(config, ZBCConfig)
        self.relative: RelativeActions | None = None
        self.correct: Correct | None = None
        self.relabel: Relabel | None = None
        self.blur: Blur | None = None
        if isinstance(config, ZBCConfig):
            self._add_styles(config)
        if isinstance(config, WZBCConfig):
            self.relabel = Relabel(None if self.data is None else make_sampler(config, self.data))

    def _add_styles(self, config: ZBCConfig) -> None:
        if config.num_episodes is None:
            raise ValueError(
                f"policy {self.name!r} keeps one style per episode of its dataset: create it with a dataset "
                "(dataset_meta) or from a checkpoint (num_episodes)"
            )
        assert config.style_dim is not None
        data, dynamics = self.data, None
        if data is not None:
            config.num_added_styles = 0 if data.fine_tunes else config.num_added_styles
            dynamics = adopt_dynamics(config, data)
        if config.action_targets is not None and getattr(config.backbone, "looks_for_things", False):
            raise ValueError(
                "backbone.encoder='objects' says by itself what actions are relative to: give "
                "--policy.corrective_relative=false"
            )
        self.styles = make_cookbook(config, data)
        self.held_out = HeldOutStyles(self.styles, data)
        if config.style_noise:
            self.blur = Blur(config.style_noise, config.style_dim)
        self.relative = make_relative_actions(config)
        stream = None
        if dynamics is not None and data is not None and self.balance is not None:
            self.relative = dynamics.relative_actions(config)
            stream = dynamics.corrective_stream(config, self.balance.factors.numpy())
        if config.corrective != "none":
            self.correct = Correct(stream)

    @property
    def trajectories(self) -> Trajectories:
        """The training dataset.

        Raises:
            RuntimeError: If the policy was created without one.
        """
        if self.data is None:
            raise RuntimeError("this needs the training dataset: create the policy with dataset_meta")
        return self.data.trajectories

    # --- Training ---

    @property
    def steps(self) -> list[LessonStep]:
        """The steps that make a lesson of a batch, in order."""
        return [step for step in (self.balance, self.correct, self.relabel, self.blur) if step is not None]

    def get_optim_params(self) -> Any:
        """The backbone's parameters, and the styles with a learning rate of their own."""
        groups = self.backbone.param_groups()
        if not isinstance(self.config, ZBCConfig) or self.config.has_fixed_styles:
            return groups
        if isinstance(groups, dict):  # the optimizer gives rates by name
            return {**groups, **{f"styles.{name}": value for name, value in self.styles.named_parameters()}}
        by_rows = {"by_rows": True} if len(self.styles) >= FROM_ROWS else {}
        styles = {"params": list(self.styles.parameters()), "lr": self.config.styles_lr, "weight_decay": 0.0}
        return [*groups, {**styles, **by_rows}]

    def forward(self, batch: dict[str, Any], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Training loss of a batch of frames; in evaluation, under the styles that suit the episodes best.

        Args:
            batch: Normalised observations (B, ...), ``action`` (B, ...), ``episode_index`` (B,) and, where
                the dataset has pauses, ``index`` (B,), the dataset's number of each frame.
            reduction: ``mean``, or ``none`` for one loss per frame.

        Returns:
            The loss, scalar or (B,), and numbers to log.

        Raises:
            ValueError: If the backbone does not know the losses of single frames and these are asked for.
        """
        lesson = self.draw(batch) if self.training else self._held_out_lesson(batch)
        style = self._taught(lesson) if self.training else self._held_out_styles(batch)
        if reduction == "none":
            losses = self.backbone.frame_losses(lesson.batch, style, lesson.weight)
            if losses is None:
                raise ValueError(
                    f"reduction='none': the backbone {self.config.backbone.type!r} knows the mean only"
                )
            result = losses
        else:
            result, losses = self.backbone.loss(lesson.batch, style, lesson.weight)
        own = logged(self.steps, lesson, losses) if self.training else {}
        return result, {**self.backbone.numbers, **own}

    def draw(self, batch: dict[str, Any], steps: int = 1) -> Lesson:
        """What the loss of a batch is computed from, all random draws and bookkeeping included.

        Args:
            batch: As in `forward`; the frames of consecutive steps may come together, one after the other.
            steps: Number of steps whose frames these are, as many of each.

        Returns:
            The lesson, whose actions are those that the backbone is to predict.
        """
        lesson = Lesson.of(batch)
        if self.has_styles:
            self.styles.check_trained(lesson.episode)
        self._has_trained = True
        for step in self.steps:
            lesson = step(lesson, steps)
        return replace(lesson, batch=self._as_outputs(lesson.batch))

    def loss(self, lesson: Lesson) -> tuple[Tensor, Tensor | None]:
        """Mean weighted loss of a lesson and each frame's (B,); a pure function of it and the parameters."""
        return self.backbone.loss(lesson.batch, self._taught(lesson), lesson.weight)

    def _taught(self, lesson: Lesson) -> Tensor | None:
        """(B, style_dim) styles of a lesson's frames, detached where they are not taught."""
        if not self.has_styles:
            return None
        style = self.styles(lesson.episode)
        style = torch.where(lesson.teaches_style[:, None], style, style.detach())
        return style if lesson.noise is None else style + lesson.noise

    def _held_out_lesson(self, batch: dict[str, Any]) -> Lesson:
        lesson = Lesson.of(batch)
        if self.balance is not None:
            lesson = self.balance(lesson, 1)
        return replace(lesson, batch=self._as_outputs(batch))

    def _held_out_styles(self, batch: dict[str, Any]) -> Tensor | None:
        if not isinstance(self.config, ZBCConfig):
            return None
        episodes = batch["episode_index"]
        if self.config.has_fixed_styles:  # those of all of the dataset's episodes are known
            return self.styles(episodes)
        return self.held_out.styles(self.imitation, episodes)

    @property
    def imitation(self) -> Imitation:
        """How badly demonstrations are imitated under styles, to encode those that were not trained on.

        Of a backbone that learns the present action the error is that of the action, else its own loss.
        """
        if self.config.traits.is_momentary:
            return ActionErrors(self.predict)
        return LossErrors(self.backbone, bool(self.config.image_features))

    def update(self) -> None:
        """What the backbone does after each step of the optimizer; LeRobot's loop calls it."""
        self.backbone.update()

    def _as_outputs(self, batch: dict[str, Any]) -> dict[str, Any]:
        """`batch` with actions as the backbone is to predict them."""
        actions = (
            batch[ACTION] if self.relative is None else self.relative.encode(batch[ACTION], batch[OBS_STATE])
        )
        return {**batch, ACTION: actions}

    def train(self, mode: bool = True) -> Self:
        """Switch between training and evaluation; training makes encoded styles out of date."""
        if mode and self.has_styles:
            self.held_out.forget()
        if mode and self.config.flush_denormal:
            torch.set_flush_denormal(True)
        return super().train(mode)

    # --- Acting ---

    def predict(self, batch: dict[str, Any], style: Tensor | None = None) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, ...) and styles (B, style_dim)."""
        return self._as_actions(self.backbone.predict_action_chunk(batch, style)[:, 0], batch)

    def _as_actions(self, outputs: Tensor, batch: dict[str, Any]) -> Tensor:
        """(B, A) actions of what the backbone predicts."""
        return outputs if self.relative is None else self.relative.decode(outputs, batch[OBS_STATE])

    def reset(self) -> None:
        """Start a rollout: the next action draws new styles, one per environment."""
        self.backbone.reset()
        if self.has_styles:
            self.styles.end_rollout()

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """(B, A) normalised actions for normalised observations (B, ...), one style per environment."""
        style = self._rollout_styles(batch)
        return self._as_actions(self.backbone.select_action(batch, style, **kwargs), batch)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """(B, K, A) normalised actions, now and next."""
        chunk = self.backbone.predict_action_chunk(batch, self._rollout_styles(batch), **kwargs)
        if self.relative is None:
            return chunk
        return torch.stack([self._as_actions(outputs, batch) for outputs in chunk.unbind(1)], dim=1)

    def supports_rtc(self) -> bool:
        """Whether the backbone does LeRobot's real-time chunking."""
        return self.backbone.supports_rtc()

    def init_rtc_processor(self) -> None:
        """Set real-time chunking up as ``config.rtc_config`` says."""
        self.backbone.init_rtc_processor(getattr(self.config, "rtc_config", None))

    def _rollout_styles(self, batch: dict[str, Any]) -> Tensor | None:
        """(B, style_dim) styles of the rollout under way."""
        if not self.has_styles:
            return None
        if not self._has_trained:
            self._refuse_untrained_styles()
        n_envs, tasks = len(batch[OBS_STATE]), cast(str | list[str], batch.get("task", []))
        scene = self._scene(batch, n_envs) if self.styles.drawing.sampling == "scene" else None
        return self.styles.active_styles(n_envs, [tasks] * n_envs if isinstance(tasks, str) else tasks, scene)

    def _scene(self, batch: dict[str, Any], n_envs: int) -> Tensor:
        """(B, c) what is seen now, side by side; of a window of observations the last one counts."""
        sizes = {key: self.config.dimensions[key] for key in self.config.observation_keys}
        return torch.cat([batch[key].reshape(n_envs, -1)[:, -d:] for key, d in sizes.items()], dim=1)
