"""Passes over recorded tensor operations: fewer of them, quicker calls, gradients handed over early."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, fx

aten = torch.ops.aten

VIEWS = {
    *(aten.view.default, aten._unsafe_view.default, aten.expand.default, aten.permute.default),
    *(aten.detach.default, aten.transpose.int, aten.t.default, aten.unsqueeze.default, aten.squeeze.dim),
    *(aten.slice.Tensor, aten.select.int, aten.alias.default, aten.unflatten.int),
}
SHAPE_ONLY = {aten.ones_like.default: torch.ones, aten.zeros_like.default: torch.zeros}
# The same kernels behind torch's own functions, which take their arguments more quickly than operators do.
QUICKER: dict[Any, Callable[..., Any]] = {
    aten.add.Tensor: torch.add,
    aten.bmm.default: torch.bmm,
    aten.cat.default: torch.cat,
    aten.embedding.default: torch.embedding,
    aten.mean.dim: torch.mean,
    aten.mul.Tensor: torch.mul,
    aten.relu.default: torch.relu,
    aten.sub.Tensor: torch.sub,
    aten.sum.dim_IntList: torch.sum,
    aten.transpose.int: torch.transpose,
    aten.unsqueeze.default: torch.unsqueeze,
    aten.where.self: torch.where,
}


def drop_no_ops(recorded: fx.GraphModule) -> None:
    """Drop reshapes to the shape that a tensor has already, and products with 1."""
    for node in list(recorded.graph.nodes):
        source = node.args[0] if node.op == "call_function" and node.args else None
        if not isinstance(source, fx.Node):
            continue
        same = _layout(source) is not None and _layout(source) == _layout(node)
        if (node.target in VIEWS and same) or (node.target is aten.mul.Scalar and node.args[1] == 1):
            node.replace_all_uses_with(source)
            recorded.graph.erase_node(node)


def fold_constants(recorded: fx.GraphModule, parameters: Sequence[Tensor]) -> dict[fx.Node, int]:
    """Compute once what does not change from step to step: constants, and views of parameters.

    Args:
        recorded: Operations whose first inputs are the parameters.
        parameters: Their memory, which stays where it is.

    Returns:
        Every node that is a view of a parameter's memory, with the parameter's place.

    Raises:
        NotImplementedError: If an operation makes a view of a parameter and is not known to.
    """
    graph = recorded.graph
    inputs = [node for node in graph.nodes if node.op == "placeholder"][: len(parameters)]
    values: dict[fx.Node, Tensor] = dict(zip(inputs, parameters, strict=True))
    owner = {node: place for place, node in enumerate(inputs)}
    for node in list(graph.nodes):
        if node.op != "call_function":
            continue
        if node.target in SHAPE_ONLY and (meta := node.meta.get("tensor_meta")) is not None:
            device = node.meta["val"].device if "val" in node.meta else parameters[0].device
            values[node] = SHAPE_ONLY[node.target](meta.shape, dtype=meta.dtype, device=device)
            continue
        sources = node.all_input_nodes
        if not all(source in values for source in sources) or _is_random(node):
            continue
        owners = {owner[source] for source in sources if source in owner}
        if owners and node.target not in VIEWS:
            _check_returns_no_view(node)
            continue
        values[node] = _call(node, values)
        if owners:
            owner[node] = owners.pop()
    folded = {node: value for node, value in values.items() if node.op == "call_function"}
    views = {node: owner[node] for node in inputs}
    for number, (node, value) in enumerate(folded.items()):
        setattr(recorded, f"constant_{number}", value)
        with graph.inserting_before(next(iter(graph.nodes))):
            constant = graph.create_node("get_attr", f"constant_{number}")
        node.replace_all_uses_with(constant)
        if node in owner:
            views[constant] = owner[node]
    graph.eliminate_dead_code()
    alive = set(graph.nodes)
    return {node: place for node, place in views.items() if node in alive}


def hand_over_early(
    recorded: fx.GraphModule, views: dict[fx.Node, int], consume: Sequence[Callable[[Tensor], None]]
) -> None:
    """Hand every gradient over as soon as it is there and nothing else needs its parameter.

    Then both still lie in the processor's cache.

    Args:
        recorded: Operations that return losses and, after them, one gradient per parameter.
        views: Every node that is a view of a parameter, with the parameter's place.
        consume: What takes each parameter's gradient, and may change the parameter.
    """
    graph = recorded.graph
    order = {node: place for place, node in enumerate(graph.nodes)}
    output = graph.output_node()
    returned: Any = output.args[0]
    losses, *gradients = returned
    last_use: dict[int, fx.Node] = {}
    for node, parameter in views.items():
        for user in node.users:
            known = last_use.get(parameter)
            if user is not output and (known is None or order[user] > order[known]):
                last_use[parameter] = user
    for place, gradient in enumerate(gradients):
        after = max([gradient, last_use.get(place, gradient)], key=order.__getitem__)
        with graph.inserting_after(after):
            call = graph.call_function(consume[place], (gradient,))
        order[call] = order[after]
    output.args = ((losses,),)


def call_quickly(recorded: fx.GraphModule) -> None:
    """Call torch's functions instead of operators where they do the same."""
    for node in recorded.graph.nodes:
        if node.target in (aten.view.default, aten._unsafe_view.default):
            node.op, node.target = "call_method", "view"
        elif node.target in QUICKER and not node.kwargs:
            node.target = QUICKER[node.target]


def _call(node: fx.Node, values: dict[fx.Node, Tensor]) -> Any:
    arguments = fx.map_arg(node.args, values.__getitem__)
    options = fx.map_arg(node.kwargs, values.__getitem__)
    return node.target(*arguments, **options)  # type: ignore[operator]


def _is_random(node: fx.Node) -> bool:
    return torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ())


def _check_returns_no_view(node: fx.Node) -> None:
    """A view that is not known to be one would let its parameter be updated too early."""
    if any(returned.alias_info is not None for returned in node.target._schema.returns):  # type: ignore
        raise NotImplementedError(f"{node.target} returns a view of a parameter: add it to VIEWS")


def _layout(node: fx.Node) -> tuple[Any, Any] | None:
    meta = node.meta.get("tensor_meta")
    return None if meta is None else (meta.shape, meta.stride)
