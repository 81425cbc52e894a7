"""Adam's step, parameter by parameter while the gradients of others are still computed.

A gradient that was just computed lies in the processor's cache, and so does its parameter; after the whole
backward pass neither does. For small networks most of an optimizer's time is waiting for memory.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_swr.training.parameter_blocks import ParameterBlock

# Rows of fewer numbers are updated together at the end of the step: calls would cost more than memory does.
SMALL = 2048


class EarlyUpdates:
    """The step of a fused Adam in parts, with the optimizer's own kernel, options and state.

    Attributes:
        consume: By parameter name what takes a stacked gradient (K, ...).

    Args:
        optimizer: A `torch.optim.Adam` for which `are_possible` holds, over the blocks of `groups`.
        groups: For each of its parameter groups, its blocks by parameter name.
    """

    def __init__(self, optimizer: torch.optim.Adam, groups: Sequence[Mapping[str, ParameterBlock]]):
        blocks = [block for group in groups for block in group.values()]
        self._steps = optimizer.state[blocks[0].flat].get("step", torch.zeros((), dtype=torch.float32))
        for block in blocks:
            state = optimizer.state[block.flat]
            state.setdefault("exp_avg", torch.zeros_like(block.flat))
            state.setdefault("exp_avg_sq", torch.zeros_like(block.flat))
            state["step"] = self._steps  # one count for all
        optimizer.step()  # without gradients it does nothing, but schedules want to see it called
        self.consume: dict[str, Callable[[Tensor], None]] = {}
        self._late: list[_Updates] = []
        for group, options in zip(groups, optimizer.param_groups, strict=True):
            small = _Updates(options, self._steps)
            for name, block in group.items():
                if block.flat.shape[1] < SMALL:
                    self.consume[name] = small.add(block, optimizer.state[block.flat])
                else:
                    single = _Updates(options, self._steps)
                    self.consume[name] = _at_once(single, single.add(block, optimizer.state[block.flat]))
            if not small.is_empty():
                self._late.append(small)

    @staticmethod
    def are_possible(optimizer: torch.optim.Optimizer) -> bool:
        """Whether an optimizer is a plain fused Adam on the CPU."""
        return type(optimizer) is torch.optim.Adam and all(
            group["fused"]
            and not (group["amsgrad"] or group["maximize"] or group["decoupled_weight_decay"])
            and all(parameter.device.type == "cpu" for parameter in group["params"])
            for group in optimizer.param_groups
        )

    def begin(self) -> None:
        """Count a step, before its first gradient is consumed."""
        self._steps += 1

    def finish(self) -> None:
        """Update what is left, after the last gradient was consumed."""
        for updates in self._late:
            updates.apply()


class _Updates:
    """Blocks that one call of Adam's kernel updates."""

    def __init__(self, options: Mapping[str, Any], steps: Tensor):
        self._options, self._steps = options, steps
        self._blocks: list[ParameterBlock] = []
        self._flat: list[Tensor] = []
        self._gradients: list[Tensor] = []
        self._means: list[Tensor] = []
        self._squares: list[Tensor] = []

    def is_empty(self) -> bool:
        """Whether no block was added."""
        return not self._blocks

    def add(self, block: ParameterBlock, state: Mapping[str, Tensor]) -> Callable[[Tensor], None]:
        """Add a block; returns what takes its gradient."""
        place = len(self._blocks)
        self._blocks.append(block)
        self._flat.append(block.flat.detach())
        self._gradients.append(block.flat.detach())  # until the first one is taken
        self._means.append(state["exp_avg"])
        self._squares.append(state["exp_avg_sq"])

        def take(gradient: Tensor) -> None:
            self._gradients[place] = block.rows(gradient)

        return take

    def apply(self) -> None:
        """Update the blocks by the gradients that were taken."""
        options = self._options
        beta1, beta2 = options["betas"]
        torch._fused_adam_(
            self._flat,
            self._gradients,
            self._means,
            self._squares,
            [],
            [self._steps] * len(self._flat),
            lr=options["lr"],  # which a schedule changes
            beta1=beta1,
            beta2=beta2,
            weight_decay=options["weight_decay"],
            eps=options["eps"],
            amsgrad=False,
            maximize=False,
        )


def _at_once(updates: _Updates, take: Callable[[Tensor], None]) -> Callable[[Tensor], None]:
    def update(gradient: Tensor) -> None:
        take(gradient)
        updates.apply()

    return update
