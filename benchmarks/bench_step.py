"""Cost of a training step of WZBC, and of ZBC with corrective labels, beside ZBC, in turns, on one thread.

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
RUNS: dict[str, tuple[str, dict]] = {
    "zbc": ("zbc", {}),
    "wzbc": ("wzbc", {}),
    "zbc corrective=noise": ("zbc", {"corrective": "noise"}),
    "zbc corrective=demos": ("zbc", {"corrective": "demos"}),
}
METERS = ("loss", "grad_norm", "lr", "update_s")


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "only_forward"
        write_dataset(get_recipe("medium_maze-only_forward"), root)
        meta = LeRobotDatasetMetadata("local/only_forward", root=root)
        policies = {
            name: make_policy(make_policy_config(policy_type, device="cpu", **options), ds_meta=meta).train()
            for name, (policy_type, options) in RUNS.items()
        }
    frames = torch.repeat_interleave(
        torch.arange(100), torch.from_numpy(policies["zbc"].trajectories.lengths)
    )
    compare("bare step", {name: bare_step(policy) for name, policy in policies.items()}, frames)
    compare(
        "step of lerobot-train", {name: lerobot_step(policy) for name, policy in policies.items()}, frames
    )


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


def compare(title: str, steps: dict[str, Callable[[dict], None]], frames: torch.Tensor) -> None:
    """Time the steps in turns; `frames` (F,) is the episode of every frame."""
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
                batch["index"] = torch.randint(len(frames), (BATCH,))
                batch["episode_index"] = frames[batch["index"]]
                step(batch)
            seconds[name].append((time.perf_counter() - start) / STEPS)
    for name, values in seconds.items():
        print(f"{title}, {name}: {1e3 * np.median(values):.2f} ms, {1 / np.median(values):.0f} steps/s")
    for name in list(steps)[1:]:
        ratios = np.array(seconds[name]) / np.array(seconds["zbc"])
        low, high, middle = ratios.min(), ratios.max(), np.median(ratios)
        print(f"{name} / zbc: median {middle:.3f} of {ROUNDS} paired rounds ({low:.3f} to {high:.3f})")


if __name__ == "__main__":
    main()
