"""The accelerator of resumed runs: data and random numbers are those of the run that was not interrupted."""

import itertools

import pytest
import torch
from accelerate import Accelerator
from lerobot.datasets import EpisodeAwareSampler, compute_sampler_state
from lerobot.policies.factory import make_policy_config
from lerobot.utils.utils import cycle
from torch.utils.data import DataLoader, TensorDataset

from lerobot_swr.training.exact_accelerator import ExactAccelerator, precision_of

BATCH, STEPS = 4, 11  # an epoch has 4 steps, the last one of 2 frames
FRAMES = TensorDataset(torch.arange(20))
WORKERS = {"num_workers": 2, "multiprocessing_context": "fork"}
LOADING = {
    "without workers": {"num_workers": 0},
    "with workers": WORKERS,
    "with lasting workers": WORKERS | {"persistent_workers": True},
}


def train(accelerator: Accelerator, options: dict, start: int, state: torch.Tensor | None = None) -> list:
    """What LeRobot's loop does with data and random numbers, from a step on; what it saw, drew, and kept."""
    sampler = EpisodeAwareSampler([0, 7, 12], [7, 12, 20], [0, 2], drop_n_last_frames=1, shuffle=True, seed=5)
    torch.manual_seed(7)
    if state is not None:
        torch.set_rng_state(state)
        sampler.load_state_dict(compute_sampler_state(start, len(sampler), BATCH, 1))
    loader = accelerator.prepare(DataLoader(FRAMES, BATCH, sampler=sampler, **options))
    batches = itertools.islice(cycle(loader), STEPS - start)
    return [(batch.tolist(), torch.rand(1).item(), torch.get_rng_state()) for (batch,) in batches]


@pytest.mark.parametrize("options", LOADING.values(), ids=LOADING)
def test_a_resumed_run_sees_and_draws_what_it_would_have(options):
    """From steps within three epochs and at their ends, beside a run of a plain accelerator."""
    whole = train(Accelerator(cpu=True), options, 0)
    for start in (2, 4, 9) if options["num_workers"] else range(1, STEPS):
        resumed = train(ExactAccelerator(cpu=True), options, start, whole[start - 1][2])
        for (seen, drawn, _), expected in zip(resumed, whole[start:], strict=True):
            assert (seen, drawn) == expected[:2], start


def test_a_new_run_is_that_of_any_accelerator():
    """It sees and draws the same."""
    options = LOADING["without workers"]
    plain, exact = (train(make(cpu=True), options, 0) for make in (Accelerator, ExactAccelerator))
    assert [step[:2] for step in plain] == [step[:2] for step in exact]


def test_evaluations_draw_in_vain():
    """Under `torch.no_grad`, as LeRobot evaluates; a training step's draws count."""
    accelerator = ExactAccelerator(cpu=True)
    torch.manual_seed(0)
    expected = torch.rand(2)
    torch.manual_seed(0)
    with torch.no_grad(), accelerator.autocast():
        torch.rand(5)
    with accelerator.autocast():
        first = torch.rand(1)
    assert torch.equal(torch.cat([first, torch.rand(1)]), expected)


@pytest.mark.parametrize(("use_amp", "precision"), [(False, None), (True, "bf16")])
def test_the_precision_is_what_the_policy_asks_for(use_amp, precision):
    """In 16 bits with ``use_amp``; on the CPU those of bfloat16."""
    assert precision_of(make_policy_config("act", device="cpu", use_amp=use_amp)) == precision
