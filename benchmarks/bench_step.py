"""Cost of one training step (forward, backward, fused Adam) beside ZBC's, in turns, on one thread."""

import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config

import lerobot_swr  # noqa: F401
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset

ROUNDS, STEPS, BATCH = 15, 200, 16
RUNS = {
    "zbc": ("zbc", {}),
    "wzbc": ("wzbc", {}),
    "zbc, corrective=noise": ("zbc", {"corrective": "noise"}),
    "zbc, corrective=demos": ("zbc", {"corrective": "demos"}),
}


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "only_forward"
        write_dataset(get_recipe("medium_maze-only_forward"), root)
        meta = LeRobotDatasetMetadata("local/only_forward", root=root)
        runs = {}
        for name, (policy_type, options) in RUNS.items():
            policy = make_policy(
                make_policy_config(policy_type, device="cpu", **options), ds_meta=meta
            ).train()
            policy.styles.mark_trained(torch.arange(100))
            optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
            runs[name] = (policy, optimizer)
    batch = {
        "observation.state": torch.randn(BATCH, 2),
        "observation.environment_state": torch.zeros(BATCH, 2),
        "action": torch.randn(BATCH, 2),
    }
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, (policy, optimizer) in runs.items():
            start = time.perf_counter()
            for _ in range(STEPS):
                batch["episode_index"] = torch.randint(100, (BATCH,))
                batch["index"] = torch.randint(meta.total_frames, (BATCH,))
                loss, _ = policy.forward(batch)
                loss.backward()
                optimizer.step()
                optimizer.zero_grad()
            seconds[name].append((time.perf_counter() - start) / STEPS)
    for name, values in seconds.items():
        print(f"{name:>22}: {1e3 * np.median(values):.2f} ms per step, {1 / np.median(values):.0f} steps/s")
    for name in list(RUNS)[1:]:
        ratios = np.array(seconds[name]) / np.array(seconds["zbc"])
        low, high = ratios.min(), ratios.max()
        print(
            f"{name} / zbc: median {np.median(ratios):.3f} of {ROUNDS} paired rounds ({low:.3f} to {high:.3f})"
        )


if __name__ == "__main__":
    main()
