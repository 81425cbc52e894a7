"""Time and memory of finding the behaviours of 10,000 episodes of 100 steps in 14 dimensions.

    python -m benchmarks.bench_behaviors
    python -m benchmarks.bench_behaviors --episodes=2000
    python -m benchmarks.bench_behaviors --known data/only_forward data/avoiding d3il_inserting_120.npz

The last one compares what is found with known labels: by the rules of this package's own datasets, or of an
archive with the arrays states, episode_index and behavior.
"""

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np
from lerobot.datasets import LeRobotDatasetMetadata
from sklearn.metrics import adjusted_rand_score

from lerobot_swr.behavior_rules import dataset_behavior_rule
from lerobot_swr.discovery.discover import discover
from lerobot_swr.discovery.sources import Source
from lerobot_swr.evaluation.checkpoint import load_demonstrations
from lerobot_swr.trajectories import Trajectories

STEPS, DIM, WAYS = 100, 14, 8
STATE = "observation.state"


def synthetic(count: int, seed: int = 0) -> tuple[Trajectories, np.ndarray]:
    """Episodes by way of one of eight places, at a varying pace, and their labels."""
    rng = np.random.default_rng(seed)
    corners, places = rng.standard_normal((3, DIM)), rng.standard_normal((WAYS, DIM))
    labels = rng.choice(WAYS, count, p=np.arange(1, WAYS + 1) / np.arange(1, WAYS + 1).sum())
    frames = np.empty((count * STEPS, DIM), dtype=np.float32)
    for i, label in enumerate(labels):
        pace = np.exp(0.5 * rng.standard_normal(STEPS)).cumsum()
        via = corners + 0.2 * rng.standard_normal(corners.shape)
        via[1] += places[label]
        share = (pace - pace[0]) / (pace[-1] - pace[0])
        path = np.stack([np.interp(share, [0, 0.5, 1], via[:, d]) for d in range(DIM)], axis=1)
        frames[i * STEPS : (i + 1) * STEPS] = path + 0.02 * rng.standard_normal(path.shape)
    return Trajectories(np.full(count, STEPS), {STATE: frames}, 30, "synthetic"), labels


def known(path: Path) -> tuple[Trajectories, list[str]]:
    """Episodes and their known labels."""
    if path.suffix == ".npz":
        archive = np.load(path)
        lengths = np.bincount(archive["episode_index"])
        return Trajectories(lengths, {STATE: archive["states"]}, 30, path.stem), archive["behavior"].tolist()
    meta = LeRobotDatasetMetadata(f"local/{path.name}", root=path)
    trajectories = load_demonstrations(meta)
    rule = dataset_behavior_rule(None, meta.robot_type)
    if rule is None:
        raise SystemExit(f"{path}: no rule of this package labels it")
    return trajectories, [rule(episode) for episode in trajectories.episodes()]


def compare(path: Path) -> None:
    """Print how well the behaviours that are found agree with known labels."""
    trajectories, labels = known(path)
    found = discover(trajectories, Source((STATE,)))
    result = {
        "dataset": path.stem,
        "episodes": len(trajectories),
        "behaviors": len(found.names),
        "of": len(set(labels)),
        "adjusted_rand_index": round(float(adjusted_rand_score(labels, found.labels)), 3),
        "outliers": len(found.reasons),
    }
    print(json.dumps(result), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--known", type=Path, nargs="+", help="datasets with known labels")
    options = parser.parse_args()
    if options.known:
        for path in options.known:
            compare(path)
        return
    episodes = options.episodes
    trajectories, labels = synthetic(episodes)
    start = time.perf_counter()
    found = discover(trajectories, Source((STATE,)))
    seconds = time.perf_counter() - start
    result = {
        "episodes": episodes,
        "seconds": round(seconds, 1),
        "peak_gb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2),
        "behaviors": len(found.names),
        "of": WAYS,
        "adjusted_rand_index": round(float(adjusted_rand_score(labels, found.labels)), 3),
        "outliers": len(found.reasons),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
