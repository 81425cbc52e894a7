"""A parameter of several policies in one block of memory, over which an optimizer steps at once."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

# Rows of a block are padded to a multiple of this many numbers, so that vectorised loops treat a policy's
# numbers alike wherever its row lies: a policy is trained to the same bits in a stack of any height.
ROW_MULTIPLE = 64


class ParameterBlock:
    """One parameter of K policies, one policy per row.

    Matrices (out, in) lie as (in, out): so do the gradients of a batch of linear layers, which are then used
    where they are.

    Attributes:
        flat: (K, P) the block, the optimizer's parameter.
        stacked: (K, ...) view of the block that requires a gradient of its own.

    Args:
        parameters: The K policies' parameter, whose values are taken.
    """

    def __init__(self, parameters: Sequence[Tensor]):
        first = parameters[0]
        self._shape = first.shape
        self._size = first.numel()
        width = -(-self._size // ROW_MULTIPLE) * ROW_MULTIPLE
        self.flat = nn.Parameter(torch.zeros(len(parameters), width, dtype=first.dtype, device=first.device))
        self.stacked = self.view(self.flat.detach()).requires_grad_()
        self._gradient: Tensor | None = None
        with torch.no_grad():
            self.stacked.copy_(torch.stack(list(parameters)))

    def view(self, block: Tensor) -> Tensor:
        """(K, ...) of a (K, P) block of this layout."""
        rows = block[:, : self._size]
        if len(self._shape) == 2:
            return rows.unflatten(1, (self._shape[1], self._shape[0])).transpose(1, 2)
        return rows.unflatten(1, self._shape)

    def rows(self, gradient: Tensor) -> Tensor:
        """(K, P) of a (K, ...) gradient: the same memory where possible, else a block that is kept."""
        if self.flat.shape[1] == self._size:
            return (gradient.transpose(1, 2) if len(self._shape) == 2 else gradient).flatten(1)
        if self._gradient is None:
            self._gradient = torch.zeros_like(self.flat)
        self.view(self._gradient).copy_(gradient)
        return self._gradient

    def stack_state(self, states: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """State of the block's optimizer from those of the parameter in K optimizers."""
        stacked: dict[str, Tensor] = {}
        for key, example in states[0].items():
            if example.dim() == 0:  # a count of steps, the same for all
                stacked[key] = example.clone()
                continue
            stacked[key] = torch.zeros_like(self.flat)
            self.view(stacked[key]).copy_(torch.stack([state[key] for state in states]))
        return stacked

    def state_of(self, stacked: Mapping[str, Tensor], k: int) -> dict[str, Tensor]:
        """State of the parameter in policy k's optimizer, from that of the block's."""
        return {
            key: (value if value.dim() == 0 else self.view(value)[k]).clone(
                memory_format=torch.contiguous_format
            )
            for key, value in stacked.items()
        }
