"""Seed-steps per second of `lerobot-swr-train` beside `lerobot-train`, for wzbc on medium_maze-only_forward.

The paper's five seeds, and ten: the more seeds a process trains, the less a seed costs.

One run after the other, each on all cores of the machine as its defaults have it. A rate is that between two
checkpoints, which leaves start-up out.

Then the largest parts of a step, each alone, of five stacked seeds on one thread: the matrix products forward
and backward, and Adam.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from torch.utils.benchmark import Timer

from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset

COUNTS_OF_SEEDS = (5, 10)
BATCH_SIZE = 16


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=40_000, help="of lerobot-swr-train, per seed")
    steps = parser.parse_args().steps
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "only_forward"
        write_dataset(get_recipe("medium_maze-only_forward"), root)
        single = lerobot_train(root, Path(folder) / "single", steps // 5)
        one_thread = lerobot_train(root, Path(folder) / "one_thread", steps // 5, OMP_NUM_THREADS="1")
        print(
            f"lerobot-train:     {single:7.1f} steps/s, {one_thread:.1f} with OMP_NUM_THREADS=1", flush=True
        )
        for count in COUNTS_OF_SEEDS:
            many, whole = seed_train(root, Path(folder) / f"{count}_seeds", steps, range(count))
            print(
                f"lerobot-swr-train: {many:7.1f} seed-steps/s ({count} seeds), {many / single:.1f} times, "
                f"{many / one_thread:.1f} times that of one thread; on the whole {whole:.1f}",
                flush=True,
            )
        each = ", ".join(f"{name} {1e6 * seconds:.0f} µs" for name, seconds in largest_parts(root).items())
        print(f"a seed's step on one thread: {each}")


def largest_parts(root: Path) -> dict[str, float]:
    """Seconds of a seed's step, where `COUNTS_OF_SEEDS[0]` are stacked on one thread, by what takes them."""
    config = make_policy_config("wzbc", device="cpu", push_to_hub=False)
    policy = make_policy(config, ds_meta=LeRobotDatasetMetadata("local/only_forward", root=root))
    seeds = COUNTS_OF_SEEDS[0]
    layers = []  # inputs (seeds, batch, in), weights (seeds, in, out), gradients of outputs
    for weight in policy.backbone.parameters():
        if weight.dim() == 2:
            out, size = weight.shape
            shapes = ((seeds, BATCH_SIZE, size), (seeds, size, out), (seeds, BATCH_SIZE, out))
            layers.append(tuple(torch.randn(shape) for shape in shapes))
    blocks = [torch.nn.Parameter(torch.randn(seeds, p.numel())) for p in policy.parameters()]
    for block in blocks:
        block.grad = torch.randn_like(block)
    adam = torch.optim.Adam(blocks, lr=1e-6, fused=True)

    def multiply() -> None:
        for inputs, weights, gradients in layers:
            torch.bmm(inputs, weights)
            torch.bmm(gradients, weights.transpose(1, 2))
            torch.bmm(inputs.transpose(1, 2), gradients)

    statements = {"matrix products": multiply, "Adam": adam.step}
    return {
        name: Timer("f()", globals={"f": f}, num_threads=1).blocked_autorange(min_run_time=2).median / seeds
        for name, f in statements.items()
    }


def flags(root: Path, output_dir: Path, steps: int) -> list[str]:
    return [
        *("--policy.type=wzbc", "--policy.device=cpu", "--policy.push_to_hub=false"),
        *("--dataset.repo_id=local/only_forward", f"--dataset.root={root}", f"--batch_size={BATCH_SIZE}"),
        *("--num_workers=0", "--log_freq=0", f"--steps={steps}", f"--save_freq={steps // 4}"),
        f"--output_dir={output_dir}",
    ]


def run(command: str, *arguments: str, **environment: str) -> None:
    executable = str(Path(sys.executable).with_name(command))
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", **environment}
    done = subprocess.run([executable, *arguments], capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        sys.exit(done.stderr[-3000:])


def lerobot_train(root: Path, output_dir: Path, steps: int, **environment: str) -> float:
    """Steps/s."""
    run("lerobot-train", *flags(root, output_dir, steps), **environment)
    return rate(checkpoint_times(output_dir, steps), steps)


def seed_train(root: Path, output_dir: Path, steps: int, seeds: Sequence[int]) -> tuple[float, float]:
    """Seed-steps/s while all groups of seeds are under way, and on the whole from the first checkpoint on.

    The second is less where groups differ in size: the smaller one's core has nothing to do at the end.
    """
    run("lerobot-swr-train", *flags(root, output_dir, steps), f"--seeds={','.join(map(str, seeds))}")
    times = [checkpoint_times(output_dir / f"seed_{seed}", steps) for seed in seeds]
    elapsed = max(t[-1] for t in times) - min(t[0] for t in times)
    return sum(rate(t, steps) for t in times), len(seeds) * 3 * (steps // 4) / elapsed


def checkpoint_times(output_dir: Path, steps: int) -> list[float]:
    """When each of a run's four checkpoints was written, in seconds."""
    folders = [output_dir / f"checkpoints/{k * (steps // 4):06d}/training_state" for k in (1, 2, 3, 4)]
    return [(folder / "training_step.json").stat().st_mtime_ns / 1e9 for folder in folders]


def rate(times: Sequence[float], steps: int) -> float:
    """Steps/s of a run between its second and its third checkpoint."""
    return (steps // 4) / (times[2] - times[1])


if __name__ == "__main__":
    main()
