"""Draws docs/images/pusht_first_push.png and compares rules for PushT: --dataset=FOLDER of the recordings.

docs/pusht.md explains the table that it prints.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.pusht.behavior import PUSH, STILL, first_push
from lerobot_swr.envs.pusht.block import GOAL_POSE, KEYPOINTS, OUTLINE, SIDES, block_pose, nearest_side
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_demonstrations

PICTURE = Path(__file__).parent / "images" / "pusht_first_push.png"
NEIGHBOURS = 5
SHARE = 0.1  # of the work, below which a push is none

Episode = dict[str, np.ndarray]


def agent_and_block(episode: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Agent (T, 2), keypoints (T, 8, 2) and pose (T, 3) with an angle that does not jump."""
    keypoints = episode["observation.environment_state"].reshape(-1, 8, 2).astype(float)
    pose = block_pose(keypoints)
    pose[:, 2] = np.unwrap(pose[:, 2])
    return episode["observation.state"].astype(float), keypoints, pose


def in_block(agent: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(T, 2) the agent in the block's own frame."""
    offset, cos, sin = agent - pose[:, :2], np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return np.stack([cos * offset[:, 0] + sin * offset[:, 1], cos * offset[:, 1] - sin * offset[:, 0]], 1)


def pushes(episode: Episode) -> list[tuple[str, float]]:
    """Side and share of the work of all pushes, one after the other."""
    agent, keypoints, _ = agent_and_block(episode)
    moved = np.linalg.norm(np.diff(keypoints, axis=0), axis=2).mean(axis=1)
    found: list[tuple[str, float]] = []
    for side, work in zip(nearest_side(agent[1:], keypoints[1:]), moved, strict=True):
        if work >= STILL:
            before = found.pop()[1] if found and found[-1][0] == SIDES[side] else 0.0
            found.append((SIDES[side], before + work / moved.sum()))
    return found


def turning(episode: Episode) -> str:
    """The sense in which the block is turned, from start to end."""
    angle = agent_and_block(episode)[2][:, 2]
    return "right" if angle[-1] > angle[0] else "left"


def main_side(episode: Episode) -> str:
    """The side from which most of the pushing is done."""
    work: Counter[str] = Counter()
    for side, share in pushes(episode):
        work[side] += share  # type: ignore[assignment]
    return work.most_common(1)[0][0]


def last_push(episode: Episode) -> str:
    """The side of the last push that counts."""
    return next((side for side, share in reversed(pushes(episode)) if share >= SHARE), "none")


def order(episode: Episode) -> str:
    """The sides of all pushes that count, in order."""
    sides = [side for side, share in pushes(episode) if share >= SHARE]
    return "-".join(side for k, side in enumerate(sides) if k == 0 or side != sides[k - 1])


def way_round(episode: Episode) -> str:
    """How far the agent walks round the block, as seen from the block: a quarter turn or more either way."""
    agent, _, pose = agent_and_block(episode)
    offset = in_block(agent, pose) - KEYPOINTS.mean(axis=0)
    angle = np.unwrap(np.arctan2(offset[:, 1], offset[:, 0]))
    turned = float(angle[-1] - angle[0])
    return "none" if abs(turned) < np.pi / 2 else "right" if turned > 0 else "left"


def starts(episodes: list[Episode]) -> np.ndarray:
    """(N, 6) what describes a start, in numbers about 1: block from the goal, agent in the block's frame."""
    rows = []
    for episode in episodes:
        agent, _, pose = agent_and_block(episode)
        turn = pose[0, 2] - GOAL_POSE[2]
        place = in_block(agent[:1], pose[:1])[0]
        rows.append([*(pose[0, :2] - GOAL_POSE[:2]) / 100, 2 * np.cos(turn), 2 * np.sin(turn), *place / 100])
    return np.array(rows)


def noisy(episode: Episode) -> Episode:
    """A pixel of noise on the agent, a third on the keypoints."""
    rng = np.random.default_rng(len(episode["action"]))
    sizes = {"observation.state": 1.0, "observation.environment_state": 0.3, "action": 0.0}
    return {key: value + rng.normal(0, sizes[key], value.shape) for key, value in episode.items()}


CHANGES: dict[str, Callable[[Episode], Episode]] = {
    "noise": noisy,
    "5 frames later": lambda episode: {key: value[5:] for key, value in episode.items()},
    "every other frame": lambda episode: {k: v[(len(v) - 1) % 2 :: 2] for k, v in episode.items()},
}


def compare(episodes: list[Episode], rules: dict[str, BehaviorRule]) -> None:
    """Print how every rule's labels spread, whether starts settle them, and what changes them."""
    features = starts(episodes)
    distances = np.linalg.norm(features[:, None] - features, axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = np.argsort(distances, axis=1)[:, :NEIGHBOURS]
    print("| rule | labels | most frequent | told by the start |", *(f" {name} |" for name in CHANGES))
    for name, rule in rules.items():
        labels = [rule(episode) for episode in episodes]
        told = [Counter(labels[k] for k in row).most_common(1)[0][0] for row in nearest]
        figures = [max(Counter(labels).values()) / len(labels), agreement(told, labels)]
        figures += [agreement([rule(change(e)) for e in episodes], labels) for change in CHANGES.values()]
        print(f"| {name} | {len(set(labels))} |", *(f" {figure:.2f} |" for figure in figures))


def agreement(first: list[str], second: list[str]) -> float:
    """Share of equal labels."""
    return float(np.mean([a == b for a, b in zip(first, second, strict=True)]))


def draw(episodes: list[Episode]) -> None:
    """The agent's ways to the first push and through it, in the block's frame, one panel for each side."""
    labels = [first_push(episode) for episode in episodes]
    figure = Figure(figsize=(13, 3.2), layout="constrained")
    outline = KEYPOINTS[[*OUTLINE, OUTLINE[0]]]
    for axes, side in zip(figure.subplots(1, len(SIDES)), SIDES, strict=True):
        for episode in (e for e, label in zip(episodes, labels, strict=True) if label == side):
            agent, keypoints, pose = agent_and_block(episode)
            path = in_block(agent, pose)
            moved = np.linalg.norm(np.diff(keypoints, axis=0), axis=2).mean(axis=1)
            begun = int((moved >= STILL).argmax())
            pushed = begun + int((np.cumsum(moved[begun:]) >= PUSH).argmax()) + 1
            axes.plot(*path[: begun + 1].T, color="0.75", linewidth=0.6)
            axes.plot(*path[begun : pushed + 1].T, color="tab:red", linewidth=1.0)
        axes.fill(*outline.T, color="lightsteelblue")
        axes.set(xlim=(-200, 200), ylim=(260, -140), xticks=[], yticks=[], aspect="equal")
        axes.set_title(f"{side}: {labels.count(side)}", fontsize=10)
    figure.savefig(PICTURE, dpi=100)
    print(PICTURE)


def main() -> None:
    """Print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, required=True)
    trajectories = load_demonstrations(DatasetSource(root=parser.parse_args().dataset).metadata())
    episodes = list(trajectories.episodes())
    rules = {
        "side of the first push": first_push,
        "side of most pushing": main_side,
        "side of the last push": last_push,
        "order of the sides": order,
        "sense of turning": turning,
        "way round the block": way_round,
    }
    compare(episodes, rules)  # type: ignore[arg-type]
    draw(episodes)


if __name__ == "__main__":
    main()
