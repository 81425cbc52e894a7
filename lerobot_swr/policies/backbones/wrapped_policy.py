"""A LeRobot policy as a backbone: it sees the style as further numbers of one of its observations."""

import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.factory import get_policy_class
from torch import Tensor, nn

from lerobot_swr.policies.backbones.backbone import Backbone, weighted_mean
from lerobot_swr.policies.backbones.redrawn_rows import picked_rows, redrawn, weigh_alike
from lerobot_swr.policies.backbones.style_place import StylePlace
from lerobot_swr.random_streams import StepGenerator

BACKBONE_STREAM = 2  # of random numbers: the policy's own (noise, dropout) and which rows are redrawn


class WrappedPolicy(Backbone):
    """π_θ(a | s, z) that is any policy of LeRobot, unchanged: its loss, its chunks, its queues.

    A policy that knows the loss of each frame (``reduction="none"``) is given the weights of the frames. To
    any other frames are shown by their weight: of a batch whose frames weigh differently, rows are redrawn.

    What the policy draws at random in training is a function of seed, process and step, so that a resumed run
    draws what it would have drawn.

    Args:
        policy: The policy, on the features with the style.
        place: Where the style goes; None without styles.

    Attributes:
        policy: The policy.
        draws: Source of the random numbers in training.
    """

    def __init__(self, policy: PreTrainedPolicy, place: StylePlace | None):
        super().__init__()
        self.policy = policy
        self.place = place
        self.draws = StepGenerator(BACKBONE_STREAM)
        self.knows_frames = "reduction" in inspect.signature(policy.forward).parameters
        self._acted: Tensor | None = None  # the styles of the last action

    # --- Training ---

    def loss(
        self, batch: dict[str, Tensor], style: Tensor | None, weight: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """See `Backbone.loss`; what else the policy logs is in `numbers`.

        In evaluation nothing is redrawn: where frames weigh differently, their losses are taken one by one.
        """
        if not self.training and not self.knows_frames and not weigh_alike(weight):
            losses = self.frame_losses(batch, style, weight)
            return losses.mean(), losses
        with self._drawing(weight.device) as uniform:
            if self.knows_frames:
                losses, numbers = self.policy.forward(self._styled(batch, style), reduction="none")
                self.numbers = _loggable(numbers)
                return weighted_mean(losses, weight)
            shown, factor = redrawn(self._styled(batch, style), weight, uniform)
            mean, numbers = self.policy.forward(shown)
            self.numbers = _loggable(numbers)
            return mean * factor, None

    def frame_losses(self, batch: dict[str, Tensor], style: Tensor | None, weight: Tensor) -> Tensor:
        """(B,) weighted losses; of a policy that knows the mean only, frame by frame: slowly."""
        with self._drawing(weight.device):
            styled = self._styled(batch, style)
            if self.knows_frames:
                losses, numbers = self.policy.forward(styled, reduction="none")
                self.numbers = _loggable(numbers)
                return losses * weight
            rows = torch.arange(len(weight), device=weight.device).split(1)
            single = [picked_rows(styled, row, len(weight)) for row in rows]
            return torch.stack([self.policy.forward(one)[0] for one in single]) * weight

    @contextmanager
    def _drawing(self, device: torch.device) -> Iterator[float]:
        """Let the block draw this step's random numbers, in evaluation always the same; gives one of them."""
        generator = self.draws.next() if self.training else torch.Generator().manual_seed(0)
        seed = int(torch.randint(2**62, (), generator=generator))
        uniform = float(torch.rand((), generator=generator, dtype=torch.float64))
        devices = [device] if device.type == "cuda" else []
        with torch.random.fork_rng(devices):
            if device.type == "cpu":
                torch.default_generator.manual_seed(seed)  # to seed every kind of device takes a millisecond
            else:
                torch.manual_seed(seed)
            yield uniform

    def _styled(self, batch: dict[str, Any], style: Tensor | None) -> dict[str, Any]:
        """A copy that the policy may change, with the style."""
        if style is None or self.place is None:
            return dict(batch)
        return self.place.put(batch, style)

    def param_groups(self) -> list[dict[str, Any]] | dict[str, nn.Parameter]:
        """The policy's groups of parameters, or its parameters by name where its optimizer wants them so.

        Raises:
            ValueError: If the policy has several optimizers.
        """
        given = self.policy.get_optim_params()
        if isinstance(given, Mapping):
            if not all(isinstance(value, nn.Parameter) for value in given.values()):
                raise ValueError(
                    f"policy.backbone.type={self.policy.name!r} is trained by several optimizers, which "
                    "lerobot-train does not do; use another backbone"
                )
            return dict(given)
        parts = list(given)
        if parts and isinstance(parts[0], Mapping):
            return [{**part, "params": list(part["params"])} for part in parts]
        return [{"params": parts}]

    def update(self) -> None:
        """What the policy does after each step of the optimizer."""
        if callable(getattr(self.policy, "update", None)):
            self.policy.update()

    def peft_targets(self) -> dict[str, Any] | None:
        """The policy's; a pattern of its modules' names is one of names within this."""
        targets = self.policy._get_default_peft_targets()
        if targets is None:
            return None
        pattern = targets.get("target_modules")
        if isinstance(pattern, str):
            targets = {**targets, "target_modules": rf"backbone\.policy\.(?:{pattern})"}
        return targets

    # --- Acting ---

    def predict_action_chunk(self, batch: dict[str, Tensor], style: Tensor | None, **options: Any) -> Tensor:
        """The policy's chunk; options are its own (real-time chunking's, noise)."""
        self._note(style)
        return self.policy.predict_action_chunk(self._styled(batch, style), **options)

    def select_action(self, batch: dict[str, Tensor], style: Tensor | None, **options: Any) -> Tensor:
        """The policy's next action: of the chunk under way, or of a new one with this style."""
        self._note(style)
        return self.policy.select_action(self._styled(batch, style), **options)

    def _note(self, style: Tensor | None) -> None:
        """Put a style into the observations that the policy remembers, where it is another than theirs."""
        if style is None or self.place is None or self.training:
            return
        known = self._acted
        if known is style:
            return
        if known is not None and known.shape == style.shape and not torch.equal(known, style):
            self.place.rewrite(getattr(self.policy, "_queues", None), style)
        self._acted = style

    def reset(self) -> None:
        """Forget chunks and histories."""
        self._acted = None
        self.policy.reset()

    def supports_rtc(self) -> bool:
        """Whether the policy does real-time chunking."""
        return self.policy.supports_rtc()

    def init_rtc_processor(self, options: Any) -> None:
        """Set real-time chunking up as `options` say."""
        self.policy.config.rtc_config = options
        if hasattr(self.policy, "init_rtc_processor"):
            self.policy.init_rtc_processor()


def make_policy_of(config: PreTrainedConfig, more: Mapping[str, Any]) -> PreTrainedPolicy:
    """A new policy of a configuration, as LeRobot's factory makes it.

    Args:
        config: The configuration, with features.
        more: What else the factory passes.
    """
    given = {key: value for key, value in more.items() if value is not None}
    return get_policy_class(config.type)(config=config, **given).to(config.device)


def make_styled_policy_of(config: PreTrainedConfig, more: Mapping[str, Any]) -> PreTrainedPolicy:
    """The same of a configuration with a style, which a dataset does not have.

    The dataset's metadata are left out where the policy does without: it might compare features with them.
    """
    dataset = inspect.signature(get_policy_class(config.type)).parameters.get("dataset_meta")
    needed = dataset is not None and dataset.default is inspect.Parameter.empty
    return make_policy_of(config, {k: v for k, v in more.items() if needed or k != "dataset_meta"})


def _loggable(numbers: Mapping[str, Any] | None) -> dict[str, float]:
    """What a policy logs that is a number, without its own sum, which the redrawn rows have made another."""
    return {
        key: float(value)
        for key, value in (numbers or {}).items()
        if isinstance(value, int | float) and key != "loss"
    }
