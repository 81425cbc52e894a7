"""benchmarks/gpu.sh, without a GPU and with tiny networks."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parent.parent
REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", Path(__file__).parents[2] / "shared"))
PUSHT = REFERENCE / "human_demos" / "pusht_human"


@pytest.mark.slow
@pytest.mark.skipif(
    not (PUSHT / "meta" / "info.json").is_file(),
    reason=f"{PUSHT} is absent: point LEROBOT_SWR_REFERENCE at the folder that holds human_demos",
)
def test_every_part_of_the_script_runs(tmp_path):
    """Agreement, four trainings with their rates, two evaluations."""
    environment = {"TINY": "1", "DEVICE": "cpu", "BATCH": "2", "WORKERS": "0", "EPISODES": "1"}
    run = subprocess.run(
        ["bash", REPOSITORY / "benchmarks/gpu.sh", PUSHT, tmp_path],
        env={**os.environ, **environment, "PYTHON": sys.executable, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    for part in ("chunk: relative difference", "zbc_act on PushT:", "wzbc_diffusion on PushT:"):
        assert part in run.stdout
    assert run.stdout.count("steps/s with loading") == 4
