"""Losses and gradients as one flat list of tensor operations, recorded once and then replayed.

For small networks most of a step's time goes into finding out what to compute: `vmap` and autograd do that
anew in every step. The recorded operations are those that they would run, on the same numbers.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, fx
from torch.fx.experimental.proxy_tensor import make_fx

from lerobot_swr.training.recorded_operations import (
    call_quickly,
    drop_no_ops,
    fold_constants,
    hand_over_early,
)


class TracedGradients:
    """Computes losses and their gradients, recording the operations for every shape of the inputs.

    Args:
        losses: Pure function of parameters (by name) and inputs (by name) to (K,) losses.
        parameters: Parameters that require gradients; later calls use the values that they have then.
        consume: By parameter name what takes its gradient, as soon as nothing else in the step needs the
            parameter, which it may therefore change; None returns the gradients.
    """

    def __init__(
        self,
        losses: Callable[[Mapping[str, Tensor], Mapping[str, Tensor]], Tensor],
        parameters: Mapping[str, Tensor],
        consume: Mapping[str, Callable[[Tensor], None]] | None = None,
    ):
        self._losses, self._names = losses, list(parameters)
        self._parameters = list(parameters.values())
        self._values = [parameter.detach() for parameter in self._parameters]  # the same memory
        self._consume = consume
        self._recorded: dict[Any, fx.GraphModule] = {}

    def __call__(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """(K,) losses, detached, and the gradient of their sum, by parameter name."""
        shapes = tuple((name, value.shape, value.stride()) for name, value in inputs.items())
        recorded = self._recorded.get(shapes)
        if recorded is None:
            recorded = self._recorded[shapes] = self._record(inputs)
        with torch.no_grad():
            losses, *gradients = recorded.forward(*self._values, *inputs.values())
        return losses, dict(zip(self._names, gradients, strict=self._consume is None))

    def _record(self, inputs: Mapping[str, Tensor]) -> fx.GraphModule:
        def compute(*values: Tensor) -> tuple[Tensor, ...]:
            parameters, drawn = values[: len(self._names)], values[len(self._names) :]
            losses = self._losses(
                dict(zip(self._names, parameters, strict=True)), dict(zip(inputs, drawn, strict=True))
            )
            return losses.detach(), *torch.autograd.grad(losses.sum(), parameters, materialize_grads=True)

        recorded = make_fx(compute)(*self._parameters, *inputs.values())
        drop_no_ops(recorded)
        views = fold_constants(recorded, self._values)
        if self._consume is not None:
            hand_over_early(recorded, views, [self._consume[name] for name in self._names])
        call_quickly(recorded)
        recorded.recompile()
        return recorded
