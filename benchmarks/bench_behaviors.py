"""Time and memory of finding the behaviours of 10,000 episodes of 100 steps in 14 dimensions.

    python -m benchmarks.bench_behaviors
    python -m benchmarks.bench_behaviors --episodes=2000
    python -m benchmarks.bench_behaviors --known data/only_forward data/avoiding d3il_inserting_120.npz
    python -m benchmarks.bench_behaviors --known data/aligning --features=my_module:tool_from_box
    python -m benchmarks.bench_behaviors --spoiled data/only_forward data/avoiding
    python -m benchmarks.bench_behaviors --rollouts CHECKPOINT data/only_forward

With --known what is found is compared with known labels: by the rules of this package's own datasets, or of
an archive with the arrays states, episode_index and behavior. With --spoiled five episodes are cut, reversed,
frozen, full of noise, or on another way, before. With --rollouts the rule that was found labels 500 rollouts
of a policy, beside the hand-written one.
"""

import argparse
import json
import resource
import time
from collections import Counter
from pathlib import Path

import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from sklearn.metrics import adjusted_rand_score

from lerobot_swr.behavior_rules import dataset_behavior_rule
from lerobot_swr.discovery.discover import OUTLIER, discover
from lerobot_swr.discovery.rule import DiscoveredRule
from lerobot_swr.discovery.sources import Source
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.evaluation.checkpoint import load_checkpoint, load_demonstrations
from lerobot_swr.evaluation.rollouts import run_rollouts
from lerobot_swr.trajectories import Trajectories

STEPS, DIM, WAYS = 100, 14, 8
SEEDS, ROLLOUTS = 3, 500
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


def compare(path: Path, function: str | None) -> None:
    """Print how well the behaviours that are found agree with known labels."""
    trajectories, labels = known(path)
    found = discover(trajectories, Source((STATE,), function))
    result = {
        "dataset": path.stem,
        "episodes": len(trajectories),
        "behaviors": len(found.names),
        "of": len(set(labels)),
        "adjusted_rand_index": round(float(adjusted_rand_score(labels, found.labels)), 3),
        "outliers": len(found.reasons),
    }
    print(json.dumps(result), flush=True)


def spoiled(path: Path, seed: int) -> None:
    """Print how many of five spoiled episodes are told, and how many good ones."""
    trajectories, _ = known(path)
    rng = np.random.default_rng(seed)
    states = [np.array(episode[STATE], float) for episode in trajectories.episodes()]
    frames = np.concatenate(states)
    size, chosen = frames.std(axis=0), rng.choice(len(states), 5, replace=False).tolist()
    cut, backwards, frozen, noisy, other = chosen
    states[cut] = states[cut][: len(states[cut]) // 2]
    states[backwards] = states[backwards][::-1]
    states[frozen] = np.repeat(states[frozen][:1], len(states[frozen]), axis=0)
    states[noisy] = states[noisy] + 0.3 * size * rng.standard_normal(states[noisy].shape)
    corners = frames.mean(axis=0) + 1.2 * size * rng.standard_normal((5, len(size)))
    along = np.linspace(0, 4, len(states[other]))
    states[other] = np.stack([np.interp(along, range(5), c) for c in corners.T], axis=1)
    columns = {STATE: np.concatenate(states).astype(np.float32)}
    changed = Trajectories(np.array([len(s) for s in states]), columns, trajectories.fps, path.stem)
    found = discover(changed, Source((STATE,)))
    result = {
        "dataset": path.stem,
        "seed": seed,
        "spoiled_told": sum(i in found.reasons for i in chosen),
        "reasons": [found.reasons.get(i, "none").split(":")[0] for i in chosen],
        "good_told": len(set(found.reasons) - set(chosen)),
        "good": len(states) - 5,
    }
    print(json.dumps(result), flush=True)


def label_rollouts(checkpoint: Path, path: Path) -> None:
    """Print in how many rollouts the rule that was found agrees with the hand-written one."""
    trajectories, labels = known(path)
    found = discover(trajectories, Source((STATE,)))
    rule = DiscoveredRule(found.features, found.names, found.groups, found.places, found.reach)
    name = {
        n: Counter(np.array(labels)[np.array(found.labels) == n]).most_common(1)[0][0] for n in found.names
    }
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    hand = dataset_behavior_rule(None, LeRobotDatasetMetadata(f"local/{path.name}", root=path).robot_type)
    rollouts = run_rollouts(load_checkpoint(config), Maze2DEnvConfig(task="medium"), hand, ROLLOUTS, 100, 0)
    demonstrated = set(labels)
    told = [name.get(rule(r.observations), OUTLIER) for r in rollouts]
    wanted = [r.behavior if r.behavior in demonstrated else OUTLIER for r in rollouts]
    result = {
        "dataset": path.stem,
        "rollouts": len(rollouts),
        "agree": round(float(np.mean([t == w for t, w in zip(told, wanted, strict=True)])), 3),
        "success": round(float(np.mean([r.success for r in rollouts])), 3),
        "outliers": [told.count(OUTLIER), wanted.count(OUTLIER)],
    }
    print(json.dumps(result), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=10_000)
    parser.add_argument("--known", type=Path, nargs="+", help="datasets with known labels")
    parser.add_argument("--spoiled", type=Path, nargs="+", help="datasets of which five episodes are spoiled")
    parser.add_argument(
        "--rollouts", type=Path, nargs=2, help="a checkpoint and its dataset of a medium maze"
    )
    parser.add_argument("--features", help="for --known, as lerobot-swr-behaviors takes it")
    options = parser.parse_args()
    for path in options.known or []:
        compare(path, options.features)
    for path in options.spoiled or []:
        for seed in range(SEEDS):
            spoiled(path, seed)
    if options.rollouts:
        label_rollouts(*options.rollouts)
    if options.known or options.spoiled or options.rollouts:
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
