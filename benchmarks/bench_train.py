"""Steps per second of `lerobot-train`: zbc and wzbc beside LeRobot's act with its default network."""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset

RUNS = {"zbc": (1000, 16, ()), "wzbc": (1000, 16, ()), "act": (12, 16, ("--policy.chunk_size=100",))}


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "only_forward"
        write_dataset(get_recipe("medium_maze-only_forward"), root)
        for policy_type, (steps, batch_size, more) in RUNS.items():
            command = [
                str(Path(sys.executable).with_name("lerobot-train")),
                f"--policy.type={policy_type}",
                *(
                    "--policy.device=cpu",
                    "--policy.push_to_hub=false",
                    "--dataset.repo_id=local/only_forward",
                ),
                *(f"--dataset.root={root}", f"--batch_size={batch_size}", "--num_workers=0"),
                *(f"--steps={steps}", f"--log_freq={steps // 2}", "--save_checkpoint=false"),
                f"--output_dir={folder}/{policy_type}",
                *more,
            ]
            run = subprocess.run(
                command, capture_output=True, text=True, env={**os.environ, "HF_HUB_OFFLINE": "1"}
            )
            if run.returncode != 0:
                sys.exit(run.stderr[-3000:])
            timings = re.findall(r"updt_s:([\d.]+) data_s:([\d.]+)", run.stdout + run.stderr)
            update, data = (float(value) for value in timings[-1])  # of the second half of the run
            print(
                f"{policy_type:>5}: {1 / (update + data):7.1f} steps/s at batch {batch_size} "
                f"(update {1e3 * update:.0f} ms, data {1e3 * data:.0f} ms)",
                flush=True,
            )


if __name__ == "__main__":
    main()
