"""Adam with PyTorch's fused kernel as a LeRobot optimizer: twice as fast for small networks on CPU."""

from dataclasses import asdict, dataclass
from typing import Any

import torch
from lerobot.optim.optimizers import AdamConfig, OptimizerConfig, OptimizerParams

from lerobot_swr.policies.row_adam import RowAdam, SettlingAdam


@OptimizerConfig.register_subclass("adam_fused")
@dataclass
class FusedAdamConfig(AdamConfig):
    """LeRobot's `AdamConfig` with ``fused=True``; by rows in groups that ask for it, see `RowAdam`."""

    def build(self, params: OptimizerParams) -> torch.optim.Optimizer:
        """The optimizer over `params`."""
        kwargs = asdict(self)
        kwargs.pop("grad_clip_norm")
        groups: Any = list(params)
        rows = [
            p for group in groups if isinstance(group, dict) and group.get("by_rows") for p in group["params"]
        ]
        by_rows = bool(rows) and all(p.device.type == "cpu" and p.dtype == torch.float32 for p in rows)
        # Several processes exchange whole gradients; weight decay moves all rows in every step.
        alone = not (torch.distributed.is_available() and torch.distributed.is_initialized())
        if by_rows and alone and self.weight_decay == 0:
            return RowAdam(groups, **kwargs)
        return SettlingAdam(groups, fused=True, **kwargs)
