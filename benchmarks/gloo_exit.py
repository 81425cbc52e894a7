"""How often does one of two processes hang at its exit, all work done? A minimal case of torch alone.

Two processes average the gradients of one linear layer over gloo (DistributedDataParallel) and end. Counted
are pairs of which one is still there after a minute; what it waits for is shown where py-spy is installed.

``python -m benchmarks.gloo_exit --runs=30`` destroys the process group at the end, as LeRobot does (through
accelerate); ``--keep`` leaves it to the interpreter.
"""

import argparse
import os
import shutil
import socket
import subprocess
import sys
import time

import torch
from torch import distributed, nn

PATIENCE = 60.0
STEPS = 20


def work(keep: bool) -> None:
    """What each of the two does."""
    distributed.init_process_group("gloo")
    model = nn.parallel.DistributedDataParallel(nn.Linear(8, 8))
    optimizer = torch.optim.Adam(model.parameters())
    for _ in range(STEPS):
        optimizer.zero_grad()
        model(torch.randn(4, 8)).square().mean().backward()
        optimizer.step()
    distributed.barrier()
    if not keep:
        distributed.destroy_process_group()
    print("done", flush=True)


def main() -> None:
    """Start pairs, one after the other, and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=30)
    parser.add_argument("--keep", action="store_true", help="do not destroy the process group")
    options = parser.parse_args()
    if "RANK" in os.environ:
        work(options.keep)
        return
    hangs = 0
    for run in range(options.runs):
        start = time.monotonic()
        hangs += _hangs(options.keep)
        print(f"pair {run + 1}: {time.monotonic() - start:.1f} s, {hangs} hung so far", flush=True)
    print(f"torch {torch.__version__}: {hangs} of {options.runs} pairs hang at their exit")


def _hangs(keep: bool) -> bool:
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    common = {**os.environ, "WORLD_SIZE": "2", "MASTER_ADDR": "localhost", "MASTER_PORT": f"{port}"}
    command = [sys.executable, "-m", "benchmarks.gloo_exit", *(["--keep"] if keep else [])]
    pair = [
        subprocess.Popen(command, env={**common, "RANK": f"{rank}"}, stdout=subprocess.PIPE, text=True)
        for rank in range(2)
    ]
    for process in pair:
        assert process.stdout is not None
        process.stdout.readline()  # done
    deadline = time.monotonic() + PATIENCE
    while any(process.poll() is None for process in pair) and time.monotonic() < deadline:
        time.sleep(0.1)
    left = [process for process in pair if process.poll() is None]
    for process in left:
        if shutil.which("py-spy"):
            subprocess.run(["py-spy", "dump", "--native", "--pid", f"{process.pid}"], check=False)
        process.kill()
        process.wait()
    return bool(left)


if __name__ == "__main__":
    main()
