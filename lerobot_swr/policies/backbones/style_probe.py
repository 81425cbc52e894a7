"""Whether a style reaches the network of a policy, tried on an invented batch."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, DONE, REWARD
from lerobot.utils.random_utils import get_rng_state, set_rng_state
from torch import Tensor, nn

if TYPE_CHECKING:
    from lerobot_swr.policies.backbones.style_place import StylePlace

Preprocessor = Callable[[dict[str, Any]], dict[str, Any]]

ROWS = 2  # of the batch
NUDGE = 1e-5  # of a style, too small to change what is rounded


def why_style_is_not_read(
    policy: PreTrainedPolicy, plain: PreTrainedConfig, place: "StylePlace", preprocessor: Preprocessor
) -> str | None:
    """Why a style that is put into an observation is lost on the policy; None where it is not.

    The loss has a gradient into the style. In a policy that does not train all of its network at first
    (vqbet), a style of the least different numbers changes what some module makes of an observation.

    Args:
        policy: The policy, on the features with the style; the state of its buffers and queues stays.
        plain: Its configuration with the dataset's features.
        place: Where the style is put.
        preprocessor: Of the policy.
    """
    random_state, training = get_rng_state(), policy.training
    buffers = [(buffer, buffer.clone()) for buffer in policy.buffers()]
    try:
        policy.eval()
        reached = _has_gradient(policy, plain, place, preprocessor)
        if not reached:
            reached = _changes_a_module(policy, plain, place, preprocessor)
    finally:
        with torch.no_grad():
            for buffer, before in buffers:
                buffer.copy_(before)
        policy.reset()
        policy.train(training)
        set_rng_state(random_state)
    return None if reached else "its network does not read it, or as no number that a gradient could move"


def _has_gradient(
    policy: PreTrainedPolicy, plain: PreTrainedConfig, place: "StylePlace", preprocessor: Preprocessor
) -> bool:
    batch = preprocessor(invented_batch(plain, windows=True))
    style = _style(policy, place).requires_grad_()
    with torch.enable_grad():
        loss = policy.forward(place.put(batch, style))[0]
        if not loss.requires_grad:
            return False
        (gradient,) = torch.autograd.grad(loss, [style], allow_unused=True)
    return gradient is not None and bool(gradient.abs().sum() > 0)


def _changes_a_module(
    policy: PreTrainedPolicy, plain: PreTrainedConfig, place: "StylePlace", preprocessor: Preprocessor
) -> bool:
    batch = preprocessor(invented_batch(plain, windows=False))
    batch = {key: value for key, value in batch.items() if key != ACTION}
    style = _style(policy, place)
    state = get_rng_state()
    runs = []
    for nudge in (0.0, NUDGE):
        set_rng_state(state)
        policy.reset()
        runs.append(_module_outputs(policy, place.put(batch, style + nudge)))
    return any(
        before.shape == after.shape and not torch.equal(before, after)
        for before, after in zip(*runs, strict=False)
    )


def _module_outputs(policy: PreTrainedPolicy, batch: dict[str, Tensor]) -> list[Tensor]:
    """What the layers with weights give while the policy chooses an action."""
    outputs: list[Tensor] = []

    def note(module: nn.Module, inputs: Any, output: Any) -> None:
        if isinstance(output, Tensor) and output.is_floating_point():
            outputs.append(output.detach().clone())

    layers = [m for m in policy.modules() if next(m.parameters(recurse=False), None) is not None]
    hooks = [layer.register_forward_hook(note) for layer in layers]
    try:
        policy.select_action(batch)
    finally:
        for hook in hooks:
            hook.remove()
    return outputs


def _style(policy: PreTrainedPolicy, place: "StylePlace") -> Tensor:
    device = next(policy.parameters()).device
    return torch.randn(ROWS, place.style_dim, generator=torch.Generator().manual_seed(0)).to(device)


def invented_batch(plain: PreTrainedConfig, windows: bool) -> dict[str, Any]:
    """Raw frames of a dataset with a policy's features, or of an environment.

    Args:
        plain: The policy's configuration with the dataset's features.
        windows: Whether observations and actions come as the windows of training.
    """
    generator = torch.Generator().manual_seed(1)
    observed = plain.observation_delta_indices if windows else None
    acted = plain.action_delta_indices if windows else None
    batch: dict[str, Any] = {}
    steps: list[tuple[dict, list | None]] = [
        (plain.input_features or {}, observed),
        (plain.output_features or {}, acted),
    ]
    for features, indices in steps:
        for key, feature in features.items():
            shape = (ROWS,) if indices is None else (ROWS, len(indices))
            if feature.type is FeatureType.VISUAL:
                batch[key] = torch.rand(*shape, *feature.shape, generator=generator)
            else:
                batch[key] = torch.randn(*shape, *feature.shape, generator=generator)
            if indices is not None:
                batch[f"{key}_is_pad"] = torch.zeros(shape, dtype=torch.bool)
    rewarded = plain.reward_delta_indices if windows else None
    if rewarded is not None:  # of policies that learn values
        shape = (ROWS, len(rewarded))
        batch[REWARD] = torch.rand(shape, generator=generator)
        batch[DONE] = torch.zeros(shape, dtype=torch.bool)
        batch |= {f"{key}_is_pad": torch.zeros(shape, dtype=torch.bool) for key in (REWARD, DONE)}
    numbers = {key: torch.arange(ROWS) for key in ("episode_index", "index")}
    return {**batch, **numbers, "task_index": torch.zeros(ROWS, dtype=torch.int64), "task": ["try"] * ROWS}
