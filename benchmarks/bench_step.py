"""Cost of a training step of WZBC beside ZBC, in turns, on one thread.

Twice: the bare step (forward, backward, fused Adam), and the step as `lerobot-train` takes it, which clips
gradients and keeps metrics, too; loading the batch is left out of both.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from accelerate import Accelerator
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker

import lerobot_swr  # noqa: F401
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset

ROUNDS, STEPS, BATCH = 15, 200, 16
METERS = ("loss", "grad_norm", "lr", "update_s")


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "only_forward"
        write_dataset(get_recipe("medium_maze-only_forward"), root)
        meta = LeRobotDatasetMetadata("local/only_forward", root=root)
        policies = {
            policy_type: make_policy(make_policy_config(policy_type, device="cpu"), ds_meta=meta).train()
            for policy_type in ("zbc", "wzbc")
        }
    compare("bare step", {name: bare_step(policy) for name, policy in policies.items()})
    compare("step of lerobot-train", {name: lerobot_step(policy) for name, policy in policies.items()})


def bare_step(policy: torch.nn.Module) -> Callable[[dict], None]:
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())

    def step(batch: dict) -> None:
        loss, _ = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def lerobot_step(policy: torch.nn.Module) -> Callable[[dict], None]:
    accelerator = Accelerator(cpu=True)
    preset = policy.config.get_optimizer_preset()
    optimizer = preset.build(policy.get_optim_params())
    schedule = policy.config.get_scheduler_preset().build(optimizer, 1_000_000)
    policy, optimizer, schedule = accelerator.prepare(policy, optimizer, schedule)
    meters = {name: AverageMeter(name) for name in METERS}
    tracker = MetricsTracker(BATCH, 1000, 100, meters, accelerator=accelerator)

    def step(batch: dict) -> None:
        update_policy(tracker, policy, batch, optimizer, preset.grad_clip_norm, accelerator, schedule)

    return step


def compare(title: str, steps: dict[str, Callable[[dict], None]]) -> None:
    batch = {
        "observation.state": torch.randn(BATCH, 2),
        "observation.environment_state": torch.zeros(BATCH, 2),
        "action": torch.randn(BATCH, 2),
    }
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(ROUNDS):
        for name, step in steps.items():
            start = time.perf_counter()
            for _ in range(STEPS):
                batch["episode_index"] = torch.randint(100, (BATCH,))
                step(batch)
            seconds[name].append((time.perf_counter() - start) / STEPS)
    for name, values in seconds.items():
        print(f"{title}, {name}: {1e3 * np.median(values):.2f} ms, {1 / np.median(values):.0f} steps/s")
    ratios = np.array(seconds["wzbc"]) / np.array(seconds["zbc"])
    low, high = ratios.min(), ratios.max()
    print(f"wzbc / zbc: median {np.median(ratios):.3f} of {ROUNDS} paired rounds ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
