"""Losses and gradients as one flat list of tensor operations, recorded once and then replayed.

For small networks most of a step's time goes into finding out what to compute: `vmap` and autograd do that
anew in every step. The recorded operations are those that they would run, on the same numbers.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, fx
from torch.fx.experimental.proxy_tensor import make_fx

aten = torch.ops.aten
RESHAPES = (
    aten.view.default,
    aten._unsafe_view.default,
    aten.expand.default,
    aten.permute.default,
    aten.detach.default,
)


class TracedGradients:
    """Computes losses and their gradients, recording the operations for every shape of the inputs.

    Args:
        losses: Pure function of parameters (by name) and inputs (by name) to (K,) losses.
        parameters: Parameters that require gradients; later calls use the values that they have then.
    """

    def __init__(
        self,
        losses: Callable[[Mapping[str, Tensor], Mapping[str, Tensor]], Tensor],
        parameters: Mapping[str, Tensor],
    ):
        self._losses, self._names = losses, list(parameters)
        self._parameters = list(parameters.values())
        self._values = [parameter.detach() for parameter in self._parameters]  # the same memory
        self._recorded: dict[Any, fx.GraphModule] = {}

    def __call__(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """(K,) losses, detached, and the gradient of their sum, by parameter name."""
        shapes = tuple((name, value.shape, value.stride()) for name, value in inputs.items())
        if shapes not in self._recorded:
            self._recorded[shapes] = self._record(dict(inputs))
        with torch.no_grad():
            losses, gradients = self._recorded[shapes](self._values, dict(inputs))
        return losses, dict(zip(self._names, gradients, strict=True))

    def _record(self, inputs: dict[str, Tensor]) -> fx.GraphModule:
        def compute(parameters: list[Tensor], inputs: dict[str, Tensor]) -> tuple[Tensor, tuple[Tensor, ...]]:
            losses = self._losses(dict(zip(self._names, parameters, strict=True)), inputs)
            return losses.detach(), torch.autograd.grad(losses.sum(), parameters, materialize_grads=True)

        return _without_no_ops(make_fx(compute)(self._parameters, inputs))


def _without_no_ops(recorded: fx.GraphModule) -> fx.GraphModule:
    """Drop reshapes to the shape that a tensor has already, and products with 1."""
    for node in list(recorded.graph.nodes):
        source = node.args[0] if node.op == "call_function" and node.args else None
        if not isinstance(source, fx.Node):
            continue
        same = _layout(source) is not None and _layout(source) == _layout(node)
        if (node.target in RESHAPES and same) or (node.target is aten.mul.Scalar and node.args[1] == 1):
            node.replace_all_uses_with(source)
            recorded.graph.erase_node(node)
    recorded.graph.eliminate_dead_code()
    recorded.recompile()
    return recorded


def _layout(node: fx.Node) -> tuple[Any, Any] | None:
    meta = node.meta.get("tensor_meta")
    return None if meta is None else (meta.shape, meta.stride)
