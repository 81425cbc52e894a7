"""Adam for an embedding of very many rows, of which a step sees few."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

FROM_ROWS = 50_000  # below, a step over all rows costs less
SHARE_LEFT = 1e-3  # of a row's movement by its momentum, at which it is left alone


MEANS = ("exp_avg", "exp_avg_sq")  # Adam's names of its two running means, of gradients and their squares


class RowAdam(torch.optim.Adam):
    """Fused Adam whose step costs what the rows cost that move, for parameters in groups with ``by_rows``.

    A row that gets a gradient goes on moving by its momentum. When a thousandth of that movement is left, it
    is left alone; what Adam would have done to its state meanwhile is made up for at its next gradient. So
    rows move as under `torch.optim.Adam`, up to that thousandth.

    Such a parameter is in the CPU's memory and float32: what is done to few rows takes less time in NumPy.
    (On a GPU a step over all rows costs next to nothing.)

    Gradients of such a parameter are kept in one block of memory: a sparse gradient, that of
    ``F.embedding(..., sparse=True)``, is added to it row by row. After any other gradient all rows are taken
    for moving.

    Args:
        params: Parameter groups; in those with ``by_rows`` parameters are (N, d).
        **options: Options of `torch.optim.Adam`.
    """

    def __init__(self, params: Any, **options: Any):
        super().__init__(params, fused=True, **options)
        self._step_supports_amp_scaling = False  # lets torch's GradScaler scale back and pass over steps
        self._blocks: dict[Tensor, Tensor | None] = {}  # gradients, which others may replace
        self._touched: dict[Tensor, list[np.ndarray]] = {}  # rows that have a gradient
        self._moving: dict[Tensor, np.ndarray] = {}  # sorted rows that moved in the last step
        self._embeddings()

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Begin anew with what no copy and no file holds: it follows from the rest."""
        super().__setstate__(state)
        self._touched = self.__dict__.get("_touched", {})
        self._blocks = self.__dict__.get("_blocks", {})
        self._moving, self._step_supports_amp_scaling = {}, False

    def _embeddings(self) -> list[Tensor]:
        """The parameters that are stepped by rows, each with a block for its gradient."""
        groups = [group for group in self.param_groups if group.get("by_rows")]
        params = [param for group in groups for param in group["params"] if param.requires_grad]
        for param in params:
            if param not in self._touched:
                self._touched[param] = [] if param.grad is None else [_all_rows(param)]
                param.register_hook(self._noting(param))
                param.by_rows = True  # who computes gradients may send rows
                if param.grad is None:
                    param.grad = torch.zeros_like(param)
                self._blocks[param] = param.grad
        return params

    def _noting(self, param: Tensor) -> Callable[[Tensor], None]:
        def note(gradient: Tensor) -> None:
            rows = gradient._indices()[0].numpy().copy() if gradient.is_sparse else _all_rows(param)
            # Someone else may have forgotten the gradient, or have it grow over many batches.
            touched = [] if param.grad is None else self._touched[param]
            if param.grad is None and gradient.is_sparse:
                param.grad = self._blocks[param] = torch.zeros_like(param)
            touched = [*touched, rows]
            if sum(map(len, touched)) > len(param):
                touched = [_sorted(touched)]
            self._touched[param] = touched

        return note

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients; those of embeddings become 0 where they are."""
        kept = {param: param.grad for param in self._embeddings()}
        super().zero_grad(set_to_none)
        for param, gradient in kept.items():
            param.grad = self._blocks[param] = torch.zeros_like(param) if gradient is None else gradient
            for rows in self._touched[param]:
                param.grad.numpy()[rows] = 0
            self._touched[param] = []

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        """A step of Adam."""
        self._embeddings()
        by_rows = [p for group in self.param_groups if group.get("by_rows") for p in group["params"]]
        gradients = {param: param.grad for param in by_rows if param.grad is not None}
        for param, gradient in gradients.items():
            param.grad = None  # Adam passes over it
            if gradient is not self._blocks.get(param):
                self._touched[param], self._blocks[param] = [_all_rows(param)], gradient
        result = super().step(closure)
        for group in self.param_groups:
            for param in group["params"] if group.get("by_rows") else ():
                if param in gradients:
                    param.grad = gradients[param]
                    if param.requires_grad:
                        self._step_rows(param, group)
        return result

    def _step_rows(self, param: Tensor, group: dict[str, Any]) -> None:
        state, rest = self._prepared(param, group), _steps_to_rest(group)
        state["step"] += 1
        step, moved = float(state["step"]), state["moved"].numpy()
        touched = _sorted(self._touched[param])
        # Up to which step the rows' states are known; since then they decayed.
        missed = (step - 1) - np.minimum(moved[touched] + (rest - 1), step - 1)
        for name, beta in zip(MEANS, group["betas"], strict=True):
            state[name].numpy()[touched] *= np.power(np.float32(beta), missed)[:, None]
        moved[touched] = step
        before = self._moving[param]
        # In one order, however they came together.
        self._moving[param] = rows = _sorted([before[moved[before] > step - rest], touched])
        assert param.grad is not None
        arrays = [tensor.detach().numpy() for tensor in (param, *(state[name] for name in MEANS), param.grad)]
        parts = [[torch.from_numpy(array.take(rows, axis=0))] for array in arrays]
        torch._fused_adam_(
            parts[0],
            parts[3],
            parts[1],
            parts[2],
            [],
            [state["step"]],
            lr=group["lr"],  # which a schedule changes
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=0.0,
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )
        for array, (changed,) in zip(arrays[:3], parts[:3], strict=True):
            array[rows] = changed.numpy()

    def _prepared(self, param: Tensor, group: dict[str, Any]) -> dict[str, Tensor]:
        """The parameter's state, new or as a checkpoint of this optimizer or of Adam has it."""
        state, rest = self.state[param], _steps_to_rest(group)
        if "exp_avg" not in state:
            state["step"] = torch.zeros(())
            state.update({name: torch.zeros_like(param) for name in MEANS})
        if "moved" not in state:  # the step of a row's last gradient
            state["moved"] = torch.full((len(param),), float(state["step"]))
            state["moved"] -= (state["exp_avg"] == 0).all(dim=1) * (rest - 1.0)
        if param not in self._moving:
            self._moving[param] = np.flatnonzero(state["moved"].numpy() > float(state["step"]) + 1 - rest)
        return state

    def load_state_dict(self, state_dict: Any) -> None:
        """As any optimizer does; which groups are ``by_rows`` stays as it is."""
        by_rows = [group.get("by_rows", False) for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, value in zip(self.param_groups, by_rows, strict=True):
            group["by_rows"] = value
        self._moving = {}

    def settle(self) -> None:
        """Bring all rows' states up to now: they are then those of `torch.optim.Adam`."""
        settle(self)
        self._moving = {}


class SettlingAdam(torch.optim.Adam):
    """`torch.optim.Adam` that goes on from what `RowAdam` saved, too."""

    def load_state_dict(self, state_dict: Any) -> None:
        """Load a state and bring all of its rows up to the step at which it was saved."""
        super().load_state_dict(state_dict)
        settle(self)


@torch.no_grad()
def settle(optimizer: torch.optim.Optimizer) -> None:
    """Make states of Adam of those of `RowAdam`: what decayed since a row's last movement is made up for."""
    for group in optimizer.param_groups:
        for param in group["params"]:
            state = optimizer.state.get(param, {})
            if "moved" not in state:
                continue
            missed = (state["step"] - (state["moved"] + (_steps_to_rest(group) - 1))).clamp(min=0)
            for name, beta in zip(MEANS, group["betas"], strict=True):
                state[name] *= torch.pow(beta, missed)[:, None]
            del state["moved"]


def _sorted(parts: list[np.ndarray]) -> np.ndarray:
    """The numbers in all parts, each once; for few of them `np.unique` takes several times as long."""
    rows = np.concatenate(parts) if parts else np.arange(0)
    rows.sort()
    new = np.ones(len(rows), dtype=bool)
    new[1:] = rows[1:] != rows[:-1]
    return rows[new]


def _all_rows(param: Tensor) -> np.ndarray:
    return np.arange(len(param))


def _steps_to_rest(group: dict[str, Any]) -> int:
    """Steps with and after a gradient in which a row moves."""
    momentum = group["betas"][0]
    return 1 if momentum == 0 else max(1, math.ceil(math.log(SHARE_LEFT) / math.log(momentum)))
