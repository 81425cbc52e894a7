"""Parameters of several policies in one block of memory, over which an optimizer steps at once."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

# Rows of the block are padded to a multiple of this many numbers, so that vectorised loops treat a policy's
# numbers alike wherever its row lies: a policy is trained to the same bits in a stack of any height.
ROW_MULTIPLE = 64


class FlatParameters:
    """Some of the parameters of K policies, one policy per row.

    Matrices (out, in) lie as (in, out): so do the gradients of a batch of linear layers, which makes their
    copy a straight one.

    Attributes:
        flat: (K, P) the block, the optimizer's parameter.
        gradient: (K, P) its gradient.
        stacked: Parameter name to (K, ...), views of the block that require gradients of their own.

    Args:
        policies: K policies of one configuration, whose values are taken.
        names: Names of the parameters.
    """

    def __init__(self, policies: Sequence[nn.Module], names: Sequence[str]):
        own = [dict(policy.named_parameters()) for policy in policies]
        self._shapes = {name: own[0][name].shape for name in names}
        size = sum(shape.numel() for shape in self._shapes.values())
        width = -(-size // ROW_MULTIPLE) * ROW_MULTIPLE
        first = own[0][names[0]]
        self.flat = nn.Parameter(torch.zeros(len(policies), width, dtype=first.dtype, device=first.device))
        self.gradient = torch.zeros_like(self.flat)
        self.flat.grad = self.gradient
        self.stacked = {name: view.requires_grad_() for name, view in self._views(self.flat.detach()).items()}
        self._gradients = self._views(self.gradient)
        with torch.no_grad():
            for name, view in self.stacked.items():
                view.copy_(torch.stack([parameters[name] for parameters in own]))

    def set_gradient(self, gradients: Mapping[str, Tensor]) -> None:
        """Copy gradients, parameter name to (K, ...), into `gradient`."""
        torch._foreach_copy_(list(self._gradients.values()), [gradients[name] for name in self._shapes])

    def flatten_state(self, states: Sequence[Sequence[Mapping[str, Tensor]]]) -> dict[str, Tensor]:
        """State of the block's optimizer from those of K optimizers, each with one mapping per parameter."""
        flat: dict[str, Tensor] = {}
        for key, example in states[0][0].items():
            if example.dim() == 0:  # a count of steps, the same for all
                flat[key] = example.clone()
                continue
            flat[key] = torch.zeros_like(self.flat)
            for place, view in enumerate(self._views(flat[key]).values()):
                view.copy_(torch.stack([state[place][key] for state in states]))
        return flat

    def unflatten_state(self, flat: Mapping[str, Tensor], k: int) -> list[dict[str, Tensor]]:
        """State of policy k's optimizer, one mapping per parameter."""
        states: list[dict[str, Tensor]] = [{} for _ in self._shapes]
        for key, value in flat.items():
            if value.dim() == 0:
                for state in states:
                    state[key] = value.clone()
                continue
            for state, view in zip(states, self._views(value).values(), strict=True):
                state[key] = view[k].clone(memory_format=torch.contiguous_format)
        return states

    def _views(self, block: Tensor) -> dict[str, Tensor]:
        """Parameter name to (K, ...) of a block of this layout."""
        views, start = {}, 0
        for name, shape in self._shapes.items():
            columns = block[:, start : start + shape.numel()]
            if len(shape) == 2:
                views[name] = columns.unflatten(1, (shape[1], shape[0])).transpose(1, 2)
            else:
                views[name] = columns.unflatten(1, shape)
            start += shape.numel()
        return views
