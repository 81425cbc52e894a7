"""Runs every benchmark of this folder, each in its own process."""

import subprocess
import sys
from pathlib import Path


def main() -> None:
    """Run the benchmarks in the order of their names."""
    for path in sorted(Path(__file__).parent.glob("bench_*.py")):
        print(f"\n=== {path.stem} ===", flush=True)
        subprocess.run([sys.executable, "-m", f"benchmarks.{path.stem}"], check=True)


if __name__ == "__main__":
    main()
