"""Runs the ```bash blocks of a README, one after the other, in the project's virtual environment.

Blocks whose fence line says more than "bash" (```bash long) are left out.
"""

import os
import re
import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Run the blocks; stop at the first command that fails."""
    blocks = re.findall(r"^```bash\n(.*?)^```", Path(sys.argv[1]).read_text(), flags=re.DOTALL | re.MULTILINE)
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "HF_HUB_OFFLINE": "1",
    }
    for block in blocks:
        print(f"--- README:\n{block}", flush=True)
        subprocess.run(["bash", "-euo", "pipefail", "-c", block], env=environment, check=True)
    print(f"{len(blocks)} README blocks passed")


if __name__ == "__main__":
    main()
