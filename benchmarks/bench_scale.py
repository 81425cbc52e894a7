"""Time and peak memory of creating a wzbc policy, and its training step, for datasets of many episodes.

    python -m benchmarks.bench_scale                      # 1,000, 10,000 and 100,000 episodes; steps in turns
    python -m benchmarks.bench_scale --episodes=100000    # one size; the last line is a JSON object
    python -m benchmarks.bench_scale --episodes=100000 --data=noise

Datasets have 100 steps and 14 dimensions; they are written to a temporary folder, which is removed. Each
policy is created through LeRobot's `make_policy` in a process of its own with all cores; steps (forward,
backward, fused Adam, batch 16) are timed on one thread.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config

import lerobot_swr  # noqa: F401
from benchmarks.synthetic_dataset import DIM, KINDS, STEPS, write_synthetic_dataset

SIZES = (1_000, 10_000, 100_000)
ROUNDS, STEPS_A_ROUND, BATCH = 15, 100, 16


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, help="one size alone")
    parser.add_argument("--data", choices=KINDS, default="paths")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--measure", type=Path, nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.write is not None:
        write_synthetic_dataset(options.write, options.episodes, options.data)
    elif options.measure is not None:
        measure(options.measure)
    else:
        bench(SIZES if options.episodes is None else (options.episodes,), options.data)


def bench(sizes: tuple[int, ...], data: str) -> None:
    """Write the datasets and measure each; of several, then, the steps in turns and how memory grows."""
    with tempfile.TemporaryDirectory() as folder:
        roots = [Path(folder) / str(size) for size in sizes]
        results = []
        for size, root in zip(sizes, roots, strict=True):
            child(folder, f"--write={root}", f"--episodes={size}", f"--data={data}")
            (result,) = child(folder, "--measure", root)
            results.append(result)
            if len(sizes) > 1:
                print(json.dumps(result), flush=True)
        if len(sizes) > 1:
            in_turns = child(folder, "--measure", *roots)
            for one in in_turns[1:]:
                ratio = one["step_ms"] / in_turns[0]["step_ms"]
                print(f"step at {one['episodes']} / at {in_turns[0]['episodes']}, in turns: {ratio:.3f}")
            growth = np.log(results[-1]["peak_gb"] / results[-2]["peak_gb"]) / np.log(sizes[-1] / sizes[-2])
            print(f"peak memory grows from {sizes[-2]} to {sizes[-1]} episodes with exponent {growth:.2f}")
    print(json.dumps(results[-1]))


def child(folder: str, *options: object) -> list[dict]:
    """Run this module in a process of its own; the JSON object of each line that it prints."""
    command = [sys.executable, "-m", "benchmarks.bench_scale", *map(str, options)]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": f"{folder}/cache"}
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
    return [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]


def measure(roots: list[Path]) -> None:
    """Create a policy for each dataset, and train them for some steps in turns."""
    policies, results = [], []
    for root in roots:
        start = time.perf_counter()
        meta = LeRobotDatasetMetadata("local/synthetic", root=root)
        config = make_policy_config("wzbc", device="cpu", push_to_hub=False)
        policies.append(make_policy(config, ds_meta=meta).train())
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        results.append(
            {"episodes": meta.total_episodes, "seconds": round(seconds, 1), "peak_gb": round(peak, 2)}
        )
    torch.set_num_threads(1)
    optimizers = [
        policy.config.get_optimizer_preset().build(policy.get_optim_params()) for policy in policies
    ]
    milliseconds = [[] for _ in policies]
    for _ in range(ROUNDS):
        for policy, optimizer, times in zip(policies, optimizers, milliseconds, strict=True):
            start = time.perf_counter()
            for _ in range(STEPS_A_ROUND):
                step(policy, optimizer)
            times.append(1e3 * (time.perf_counter() - start) / STEPS_A_ROUND)
    for result, times in zip(results, milliseconds, strict=True):
        print(json.dumps({**result, "step_ms": round(float(np.median(times)), 3)}), flush=True)


def step(policy: torch.nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """A training step on random frames."""
    index = torch.randint(len(policy.styles) * STEPS, (BATCH,))
    batch = {key: torch.randn(BATCH, DIM) for key in ("observation.state", "action")}
    loss, _ = policy.forward({**batch, "index": index, "episode_index": index // STEPS})
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()


if __name__ == "__main__":
    main()
