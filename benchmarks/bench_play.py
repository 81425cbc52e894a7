"""The page's beat and latency, and the time from nothing to a steered policy, measured through its websocket.

python -m benchmarks.bench_play rate --env.type=maze2d --env.task=medium [--seconds=600]
python -m benchmarks.bench_play rate --env.type=d3il --env.task=avoiding
python -m benchmarks.bench_play loop [--demonstrations=20 --steps=10000]
"""

import argparse
import itertools
import json
import random
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

MAZE = ["--env.type=maze2d", "--env.task=medium"]
DOORS = {"6": 0.27, "7": 0.73, "3": 0.17, "4": 0.5, "5": 0.83, "1": 0.27, "2": 0.73}


@contextmanager
def page(flags: list[str], root: Path) -> Iterator[ClientConnection]:
    """A connection to a server of its own."""
    command = [
        *[sys.executable, "-m", "lerobot_swr.cli.play", *flags],
        *[f"--dataset.root={root}", "--port=0", "--open=false", "--seed=0"],
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        found = next(filter(None, (re.search(r"http://(\S+)", line) for line in process.stdout)))
        with connect(f"ws://{found[1]}/ws?tab=bench", max_size=None, compression=None) as socket:
            yield socket
    finally:
        process.terminate()
        process.wait(20)


def hear(socket: ClientConnection) -> dict[str, Any]:
    """The next event, or what is said of the next picture, with its time of arrival."""
    said = socket.recv(timeout=300)
    arrived = time.perf_counter()
    text = said if isinstance(said, str) else said[4 : 4 + int.from_bytes(said[:4], "little")].decode()
    return {**json.loads(text), "arrived": arrived}


def hear_until(socket: ClientConnection, kind: str, **fields: Any) -> dict[str, Any]:
    """The next event of a type that has these fields."""
    while True:
        event = hear(socket)
        if event["type"] == "error":
            raise RuntimeError(event["message"])
        if event["type"] == kind and all(event.get(key) == value for key, value in fields.items()):
            return event


def say(socket: ClientConnection, kind: str, **fields: Any) -> None:
    socket.send(json.dumps({"type": kind, **fields}))


def measure_rate(flags: list[str], seconds: float) -> None:
    """Move the hand at random moments and look when its picture comes."""
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as folder, page(flags, Path(folder) / "mine") as socket:
        rate = hear_until(socket, "welcome")["rate"]
        hear_until(socket, "frame")
        sent: dict[int, float] = {}
        latencies, arrivals, number, due = [], [], 0, time.perf_counter()
        first = last = None
        place = [0.5, 0.6]
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:
            if time.perf_counter() >= due and len(sent) == 0:
                number += 1
                place = [min(0.9, max(0.1, x + rng.uniform(-0.1, 0.1))) for x in place]
                sent[number] = time.perf_counter()
                say(socket, "hand", place=place, push=[0, 0, 0], n=number)
                due = time.perf_counter() + rng.uniform(0.1, 0.4)
            frame = hear(socket)
            if frame["type"] != "frame":
                continue
            for n in [n for n in sent if n <= frame["seen"]]:
                latencies.append(frame["arrived"] - sent.pop(n))
            if frame["phase"] == "over":
                say(socket, "discard")
                number += 1
                say(socket, "hand", place=place, push=[0, 0, 0], n=number)
                continue
            first = first or frame
            arrivals.append(frame["arrived"])
            last = frame
        assert first is not None
        assert last is not None
        beats, late = last["beats"] - first["beats"], last["late"] - first["late"]
        gaps = sorted(b - a for a, b in itertools.pairwise(arrivals))
        print(
            f"{' '.join(flags)}: {rate} Hz wanted, {beats / (last['arrived'] - first['arrived']):.2f} beats/s"
        )
        print(f"late beats {late}/{beats} = {late / beats:.2%} in {last['arrived'] - first['arrived']:.0f} s")
        median, most = 1e3 * statistics.median(gaps), 1e3 * gaps[int(0.99 * len(gaps))]
        print(f"pictures apart: median {median:.1f} ms, 99 % within {most:.1f} ms")
        latencies.sort()
        print(
            f"input to picture: median {1e3 * statistics.median(latencies):.0f} ms, "
            f"95 % {1e3 * latencies[int(0.95 * len(latencies))]:.0f} ms, n {len(latencies)}"
        )


def scripted_way(behavior: str, rng: random.Random) -> list[tuple[float, float]]:
    """Places in the picture that lead through the doors of a behaviour to the goal."""
    way = []
    for door, wall in zip(behavior, (0.75, 0.5, 0.25), strict=False):
        x = DOORS[door] + rng.uniform(-0.02, 0.02)
        way += [(x, wall + 0.03), (x, wall - 0.03)]
    return [*way, (0.5, 0.08)]


def measure_loop(demonstrations: int, steps: int) -> None:
    """Record by a scripted hand, train, steer: from nothing to a behaviour on request."""
    began = time.perf_counter()
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as folder, page(MAZE, Path(folder) / "mine") as socket:
        hear_until(socket, "frame", phase="waiting")
        print(f"page shows the maze after {time.perf_counter() - began:.0f} s")
        number = 0
        for k in range(demonstrations):
            for x, y in scripted_way(["6410", "7420", "6310", "7520"][k % 4], rng):
                number += 1
                say(socket, "hand", place=[x, y], push=[0, 0, 0], n=number)
                while True:
                    frame = hear_until(socket, "frame")
                    near = max(abs(frame["tool"][0] - x), abs(frame["tool"][1] - y)) < 0.015
                    if frame["phase"] == "over" or (frame["seen"] >= number and near):
                        break
                if frame["phase"] == "over":
                    break
            number += 1
            say(socket, "hand", place=None, push=[0, 0, 0], n=number)
            if not frame["success"]:
                raise RuntimeError(f"the scripted hand failed: {frame}")
            say(socket, "keep")
            hear_until(socket, "frame", phase="waiting")
        print(f"{demonstrations} demonstrations recorded after {time.perf_counter() - began:.0f} s")
        say(socket, "train", steps=steps)
        hear_until(socket, "training", state="done")
        print(f"trained after {time.perf_counter() - began:.0f} s")
        welcome = hear_until(socket, "welcome", mode="steer")
        labels = welcome["map"]["columns"]["behavior"]
        outcomes: Counter[bool] = Counter()
        say(socket, "speed", factor=4)
        for behavior in sorted(set(labels)):
            say(socket, "style", episodes=[welcome["map"]["episodes"][labels.index(behavior)]])
            say(socket, "restart")
            hear_until(socket, "frame", requested=behavior, steps=1)
            frame = hear_until(socket, "frame", phase="over")
            outcomes[frame["behavior"] == behavior] += 1
        total = time.perf_counter() - began
        print(f"steered after {total:.0f} s: {outcomes[True]} of {outcomes.total()} as asked")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("what", choices=("rate", "loop"))
    options.add_argument("--seconds", type=float, default=60)
    options.add_argument("--demonstrations", type=int, default=20)
    options.add_argument("--steps", type=int, default=10_000)
    args, flags = options.parse_known_args()
    if args.what == "rate":
        measure_rate(flags or MAZE, args.seconds)
    else:
        measure_loop(args.demonstrations, args.steps)


if __name__ == "__main__":
    main()
