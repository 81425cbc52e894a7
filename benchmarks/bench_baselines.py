"""The baselines beside LeRobot's diffusion (configs/diffusion.yaml): training steps/s and actions/s.

Training is the recipes in configs/ on medium_maze-only_forward with the same batch size for all, by
`lerobot-train` and, with frames in memory, by `lerobot-swr-train`; loading and updating are told apart.
Inference is one environment step of 100 environments at once, in rounds that take turns.
"""

import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import yaml
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config

import lerobot_swr  # noqa: F401
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset

POLICIES = ("ddpm_gpt", "ddpm_act", "beso", "diffusion")
COMMANDS = {"lerobot-train": (), "lerobot-swr-train": ("--seeds=0", "--jobs=1")}
CONFIGS = Path(__file__).parent.parent / "configs"
BATCH, STEPS = 64, 100
N_ENVS, ENV_STEPS, ROUNDS = 100, 16, 5


def training(policy_type: str, command: str, root: Path, folder: str) -> None:
    flags = [
        f"--config_path={CONFIGS / policy_type}.yaml",
        *(f"--dataset.root={root}", f"--batch_size={BATCH}", f"--steps={STEPS}", f"--log_freq={STEPS // 2}"),
        f"--output_dir={folder}/{policy_type}-{command}",
    ]
    run = subprocess.run(
        [str(Path(sys.executable).with_name(command)), *flags, *COMMANDS[command]],
        capture_output=True,
        text=True,
        env={**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"},
    )
    if run.returncode != 0:
        sys.exit(run.stderr[-3000:])
    timings = re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", run.stdout + run.stderr)
    update, data = (float(value) for value in timings[-1])  # of the second half of the run
    print(
        f"{policy_type:>9}: {1 / (update + data):6.1f} training steps/s at batch {BATCH} by {command} "
        f"(update {1e3 * update:.0f} ms, data {1e3 * data:.0f} ms)",
        flush=True,
    )


def inference(meta: LeRobotDatasetMetadata) -> None:
    policies = {}
    for name in POLICIES:
        written = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())["policy"]
        known = {field.name for field in dataclasses.fields(make_policy_config(name, device="cpu"))}
        options = {key: value for key, value in written.items() if key in known}
        policies[name] = make_policy(make_policy_config(name, **options), ds_meta=meta).eval()
    observations = {
        "observation.state": torch.randn(N_ENVS, 2),
        "observation.environment_state": torch.zeros(N_ENVS, 2),
    }
    rates: dict[str, list[float]] = {name: [] for name in policies}
    for _ in range(ROUNDS):
        for name, policy in policies.items():
            policy.reset()
            start = time.perf_counter()
            for _ in range(ENV_STEPS):
                policy.select_action(dict(observations))
            rates[name].append(N_ENVS * ENV_STEPS / (time.perf_counter() - start))
    for name, values in rates.items():
        print(
            f"{name:>9}: {np.median(values):6.0f} actions/s for {N_ENVS} environments at once "
            f"(median of {ROUNDS}, {min(values):.0f} to {max(values):.0f})"
        )


def main() -> None:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "only_forward"
        write_dataset(get_recipe("medium_maze-only_forward"), root)
        for policy_type in POLICIES:
            for command in COMMANDS:
                training(policy_type, command, root, folder)
        inference(LeRobotDatasetMetadata("local/only_forward", root=root))


if __name__ == "__main__":
    main()
