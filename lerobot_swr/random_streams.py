"""Random numbers of every training step, the same in a run that was interrupted and in one that was not."""

import numpy as np
import torch
from torch import Tensor, nn

NUMBERS_PER_BLOCK = 2**14  # random numbers that are drawn together: many cost little more than a few


class StepGenerator(nn.Module):
    """Random numbers of every training step, a pure function of seed, process and step.

    Seed and step are buffers, so they travel with a checkpoint and a resumed run draws what the uninterrupted
    one would have drawn. (Torch's global generator, although LeRobot restores it, does not give that: making
    a data loader's iterator draws from it, once more in a resumed run than in one that goes on.)

    Args:
        stream: Generators of different streams are independent of each other.
    """

    def __init__(self, stream: int = 0) -> None:
        super().__init__()
        self._stream = stream
        self._drawn: tuple[tuple[int, ...], np.ndarray] | None = None  # the last block
        self.seed: Tensor
        self.step: Tensor
        self.register_buffer("seed", torch.tensor(torch.initial_seed() % 2**63))
        self.register_buffer("step", torch.tensor(0))

    def next(self) -> torch.Generator:
        """A generator for the next step, on the CPU."""
        entropy = self._entropy(int(self.step))
        self.step.add_(1)
        seed = np.random.SeedSequence(entropy).generate_state(1, np.uint32)[0]
        return torch.Generator().manual_seed(int(seed))

    def uniforms(self, steps: int, count: int) -> np.ndarray:
        """(steps * count,) float64 numbers in [0, 1), `count` for each of the next steps."""
        first = int(self.step)
        self.step.add_(steps)
        return self.uniforms_at(first, steps, count)

    def uniforms_at(self, first: int, steps: int, count: int) -> np.ndarray:
        """The numbers of `uniforms` for steps `first` to `first` + `steps` - 1, whichever is the next one."""
        per_block = max(1, NUMBERS_PER_BLOCK // count)  # steps
        parts = []
        while steps > 0:
            block, place = divmod(first, per_block)
            parts.append(self._block(block, per_block, count)[place : place + steps])
            first, steps = first + len(parts[-1]), steps - len(parts[-1])
        return (parts[0] if len(parts) == 1 else np.concatenate(parts)).reshape(-1)

    def _block(self, block: int, steps: int, count: int) -> np.ndarray:
        """(steps, count) numbers of consecutive steps."""
        entropy = (*self._entropy(block), count)
        if self._drawn is None or self._drawn[0] != entropy:
            numbers = np.random.default_rng(entropy).random((steps, count))
            # A little below 1, lest a product with such a number be rounded up to its other factor.
            self._drawn = (entropy, np.minimum(numbers, 1 - 1e-9))
        return self._drawn[1]

    def _entropy(self, place: int) -> tuple[int, ...]:
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        process = torch.distributed.get_rank() if distributed else 0
        return int(self.seed), process, place, self._stream
