"""The accelerator with which LeRobot's own training loop goes on with a run exactly where it was."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.data_loader import DataLoaderShard
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import EpisodeAwareSampler
from lerobot.utils.random_utils import get_rng_state, set_rng_state
from torch.utils.data import DataLoader


class ExactAccelerator(Accelerator):
    """Accelerate for LeRobot's loop, in which a resumed run sees and draws what it would have anyway.

    LeRobot restores the place in the data and the state of the random numbers. Then they are lost:

    * Accelerate's loader counts epochs from 0 and tells the sampler (huggingface/lerobot#4692).
    * A loader's iterator draws a random number. The run that was interrupted drew it when its epoch began.
    * An evaluation after a checkpoint draws what a resumed run does not. Here evaluations draw in vain.

    The last two matter to policies that draw from torch's global generators, as LeRobot's own do.
    """

    def prepare_data_loader(self, data_loader: DataLoader, *args: Any, **options: Any) -> Any:
        """Prepare a loader; one whose sampler has been restored goes on from there."""
        loader = super().prepare_data_loader(data_loader, *args, **options)
        if not isinstance(data_loader.sampler, EpisodeAwareSampler):
            return loader  # of an evaluation
        place = data_loader.sampler.state_dict()
        loader.set_epoch(place["epoch"])
        # Workers that stay are started once a run, others in every epoch.
        started = place["start_index"] > 0 or (place["epoch"] > 0 and data_loader.persistent_workers)
        return _BatchesOfStartedLoader(loader) if started else loader

    @contextmanager
    def autocast(self, *args: Any, **options: Any) -> Iterator[None]:
        """Mixed precision within the block; LeRobot evaluates in such a block, without gradients."""
        evaluates = not torch.is_grad_enabled()
        with super().autocast(*args, **options), kept_random_state() if evaluates else nullcontext():
            yield


class _BatchesOfStartedLoader:
    """The batches of a loader, which draws no random number when it starts."""

    def __init__(self, loader: DataLoaderShard):
        self._loader = loader
        self._is_started = False

    def __iter__(self) -> Iterator[dict[str, Any]]:
        batches = iter(self._loader)
        if not self._is_started:
            self._is_started = True
            with kept_random_state():
                first = next(batches)
            yield first
        yield from batches


@contextmanager
def kept_random_state() -> Iterator[None]:
    """Let what the block draws from the global generators be drawn once more after it."""
    state = get_rng_state()
    try:
        yield
    finally:
        set_rng_state(state)


def exact_accelerator(policy: PreTrainedConfig) -> ExactAccelerator:
    """The accelerator of a single process that trains a policy, otherwise as LeRobot's loop would make it."""
    return ExactAccelerator(
        step_scheduler_with_optimizer=False,
        mixed_precision=precision_of(policy),
        cpu=policy.device == "cpu",
    )


def precision_of(policy: PreTrainedConfig) -> str | None:
    """Accelerate's name of the precision that a policy's options ask for; None leaves it to accelerate.

    Source: ``lerobot.scripts.lerobot_train.train``.
    """
    if hasattr(policy, "dtype"):
        return {"bfloat16": "bf16", "float16": "fp16", "float32": "no"}.get(policy.dtype)
    if not policy.use_amp:
        return None
    half = torch.get_autocast_dtype(torch.device(policy.device or "cpu").type)
    return {torch.bfloat16: "bf16", torch.float16: "fp16"}[half]
