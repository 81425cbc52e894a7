"""Several policies of one configuration, trained as one: their parameters are stacked along a new axis."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from lerobot.configs.train import TrainPipelineConfig
from torch import Tensor, nn
from torch.func import functional_call, vmap
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LRScheduler

from lerobot_swr.policies.lessons import Lesson
from lerobot_swr.policies.row_adam import RowAdam
from lerobot_swr.policies.style_policy import StylePolicy
from lerobot_swr.training.early_updates import EarlyUpdates
from lerobot_swr.training.parameter_blocks import ParameterBlock
from lerobot_swr.training.traced_gradients import TracedGradients


class _LessonLoss(nn.Module):
    """A policy's loss as a module's call, in which `functional_call` can replace the parameters."""

    def __init__(self, policy: StylePolicy):
        super().__init__()
        self.policy = policy

    def forward(self, lesson: dict[str, Tensor]) -> Tensor:
        return self.policy.loss(Lesson.of_tensors(lesson))[0]


class StackedPolicies:
    """K policies as one: `vmap` of the policy's own loss over stacked parameters, and one optimizer.

    Every policy learns from its own batches alone, as it would by itself.

    Args:
        policies: K policies of one configuration, in training mode.
        optimizers: Their optimizers, fresh or loaded, which differ in nothing but their state.
        scheduler: The first one's learning-rate schedule, if any; the same for all.
        config: The run of one of them.
    """

    def __init__(
        self,
        policies: Sequence[StylePolicy],
        optimizers: Sequence[Optimizer],
        scheduler: LRScheduler | None,
        config: TrainPipelineConfig,
    ):
        assert config.optimizer is not None
        self.policies = policies
        self._max_norm = config.optimizer.grad_clip_norm
        own = [dict(policy.named_parameters()) for policy in policies]
        names = _group_names(policies[0], optimizers[0])
        self._groups = [
            {name: ParameterBlock([parameters[name] for parameters in own]) for name in group}
            for group in names
        ]
        self._blocks = {name: block for group in self._groups for name, block in group.items()}
        left_out = ("params", "by_rows")  # of all policies together most rows move
        self._by_rows = [{k: g[k] for k in ("by_rows",) if k in g} for g in optimizers[0].param_groups]
        options = [{k: v for k, v in g.items() if k not in left_out} for g in optimizers[0].param_groups]
        for optimizer in optimizers:
            if isinstance(optimizer, RowAdam):
                optimizer.settle()
        self.optimizer = config.optimizer.build(
            [
                {**o, "params": [block.flat for block in group.values()]}
                for o, group in zip(options, self._groups, strict=True)
            ]
        )
        for place, group in enumerate(self._groups):
            for i, block in enumerate(group.values()):
                states = [o.state.get(o.param_groups[place]["params"][i], {}) for o in optimizers]
                self.optimizer.state[block.flat].update(block.stack_state(states))
        self.scheduler: LRScheduler | None = None
        if config.scheduler is not None and scheduler is not None:
            self.scheduler = config.scheduler.build(self.optimizer, config.steps)
            assert self.scheduler is not None
            self.scheduler.load_state_dict(scheduler.state_dict())
            for options_, rate in zip(self.optimizer.param_groups, scheduler.get_last_lr(), strict=True):
                options_["lr"] = rate
        one = _LessonLoss(policies[0])

        def loss(parameters: Mapping[str, Tensor], lesson: Mapping[str, Tensor]) -> Tensor:
            return functional_call(one, {f"policy.{k}": v for k, v in parameters.items()}, (lesson,))

        stacked = {name: block.stacked for name, block in self._blocks.items()}
        self._gradients = TracedGradients(vmap(loss), stacked)
        self._early: EarlyUpdates | None = None
        if EarlyUpdates.are_possible(self.optimizer) and self._max_norm <= 0:
            self._early = EarlyUpdates(self.optimizer, self._groups)
            self._descent = TracedGradients(vmap(loss), stacked, self._early.consume)

    def losses_and_gradients(self, lesson: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Each policy's loss and its gradient.

        Args:
            lesson: The tensors of what the policies' `draw` returned, stacked: (K, B, ...).

        Returns:
            (K,) losses, and parameter name to (K, ...) gradients.
        """
        return self._gradients(lesson)

    def step(self, lesson: Mapping[str, Tensor]) -> Tensor:
        """Train every policy on its own frames.

        Args:
            lesson: As for `losses_and_gradients`.

        Returns:
            (K,) losses before the step.
        """
        if self._early is not None:
            self._early.begin()
            losses, _ = self._descent(lesson)
            self._early.finish()
        else:
            losses, gradients = self.losses_and_gradients(lesson)
            for name, block in self._blocks.items():
                block.flat.grad = block.rows(gradients[name])
            self._clip_gradients()
            self.optimizer.step()
        if self.scheduler is not None:
            self.scheduler.step()
        return losses

    def _clip_gradients(self) -> None:
        """Limit the norm of each policy's gradient, as `clip_grad_norm_` does for a single policy."""
        if self._max_norm <= 0:
            return
        gradients = [block.flat.grad for block in self._blocks.values() if block.flat.grad is not None]
        norms = torch.stack([gradient.norm(dim=1) for gradient in gradients]).norm(dim=0)  # (K,)
        if norms.max() <= self._max_norm:
            return
        factors = (self._max_norm / (norms + 1e-6)).clamp(max=1)
        for gradient in gradients:
            gradient.mul_(factors[:, None])

    def unstack(self) -> None:
        """Copy the parameters back into the policies."""
        with torch.no_grad():
            for k, policy in enumerate(self.policies):
                for name, parameter in policy.named_parameters():
                    if name in self._blocks:  # else it is not trained
                        parameter.copy_(self._blocks[name].stacked[k])

    def optimizer_state(self, k: int) -> dict[str, Any]:
        """State of policy k's optimizer, as `Optimizer.state_dict` of a single one."""
        states: list[dict[str, Tensor]] = []
        groups = []
        of_all = self.optimizer.state_dict()["param_groups"]
        for group, options, by_rows in zip(self._groups, of_all, self._by_rows, strict=True):
            own = [block.state_of(self.optimizer.state[block.flat], k) for block in group.values()]
            places = list(range(len(states), len(states) + len(own)))
            groups.append({**options, **by_rows, "params": places})
            states += own
        return {"state": dict(enumerate(states)), "param_groups": groups}


def _group_names(policy: StylePolicy, optimizer: Optimizer) -> list[list[str]]:
    """Names of the parameters in each group of a policy's optimizer."""
    names = {id(parameter): name for name, parameter in policy.named_parameters()}
    return [[names[id(parameter)] for parameter in group["params"]] for group in optimizer.param_groups]
