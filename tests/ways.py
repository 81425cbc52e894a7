"""Small datasets in which the ways of doing the task are known."""

import numpy as np

from lerobot_swr.trajectories import Trajectories

STATE = "observation.state"


def way(via: np.ndarray, rng: np.random.Generator, start: np.ndarray | None = None) -> np.ndarray:
    """(T, 2) from a start by way of a point to (1, 1), at a varying pace, with a pause."""
    frames = int(rng.integers(50, 120))
    corners = np.stack([np.zeros(2) if start is None else start, via, np.ones(2)])
    pace = np.exp(0.4 * rng.standard_normal(frames)).cumsum()
    place = (pace - pace[0]) / (pace[-1] - pace[0])
    place = np.insert(place, frames // 2, np.full(rng.integers(0, 15), place[frames // 2]))
    path = np.stack([np.interp(place, [0, 0.5, 1], corners[:, k]) for k in range(2)], axis=1)
    return path + 0.002 * rng.standard_normal(path.shape)


def dataset(episodes: list[np.ndarray], **more: list[np.ndarray]) -> Trajectories:
    """Episodes (T_i, d) as a dataset."""
    columns = {STATE: np.concatenate(episodes).astype(np.float32)}
    columns |= {key: np.concatenate(values).astype(np.float32) for key, values in more.items()}
    return Trajectories(np.array([len(e) for e in episodes]), columns, 10, "memory")


def three_ways(count: int = 40, seed: int = 0) -> tuple[list[np.ndarray], list[str]]:
    """Episodes over the left, the middle and the right, of unequal shares, and their labels."""
    rng = np.random.default_rng(seed)
    points = {"left": np.array([0.1, 0.9]), "middle": np.array([0.5, 0.5]), "right": np.array([0.9, 0.1])}
    labels = rng.choice(list(points), count, p=[0.5, 0.3, 0.2]).tolist()
    return [way(points[label] + 0.03 * rng.standard_normal(2), rng) for label in labels], labels


def one_way(count: int, seed: int = 0) -> list[np.ndarray]:
    """Episodes of one way, from starts that are spread out."""
    rng = np.random.default_rng(seed)
    vias = np.array([0.5, 0.6]) + 0.1 * rng.standard_normal((count, 2))
    return [way(via, rng, rng.uniform(-0.2, 0.2, 2)) for via in vias]
