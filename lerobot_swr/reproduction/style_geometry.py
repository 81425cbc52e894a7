"""What figures show without rollouts: dissimilarities, eq. 3, who teaches whom, maps of styles."""

from pathlib import Path
from typing import Any

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from scipy.spatial import KDTree

from lerobot_swr.envs.task import task_of
from lerobot_swr.html_pages import principal_components
from lerobot_swr.reproduction.cells import Cell, Store
from lerobot_swr.reproduction.demonstrations import environment, load_low_dimensional
from lerobot_swr.reproduction.measurement import load_policy
from lerobot_swr.reproduction.training import checkpoint_folder
from lerobot_swr.similarity import Dissimilarity, similarity_of, similarity_weights
from lerobot_swr.trajectories import Trajectories

GRID = 40  # cells per side of the picture of eq. 3
INSPECTED = 1024  # demonstrations whose dissimilarities to all others are counted


def input_distribution(positions: list[np.ndarray], weights: np.ndarray, grid: int) -> np.ndarray:
    """ρ(s̃ | z_i) on a uniform grid of the unit square (eq. 3).

    ρ(s̃ | z_i) = Σ_j Σ_t 1{s_t^j ∈ s̃} W(τ_i, τ_j) / (|D| |τ_j|)

    Args:
        positions: N arrays (T_j, 2) in the unit square.
        weights: (N,) weights W(τ_i, τ_j) of style i.
        grid: Cells per side.

    Returns:
        (grid, grid), rows from low to high y; it sums to the mean weight.
    """
    edges = np.linspace(0, 1, grid + 1)
    total = np.zeros((grid, grid))
    for episode, weight in zip(positions, weights, strict=True):
        counts, _, _ = np.histogram2d(episode[:, 1], episode[:, 0], bins=(edges, edges))
        total += counts * weight / (len(positions) * len(episode))
    return total


def teaching_shares(
    dissimilarity: Dissimilarity, behaviors: np.ndarray, beta: float, p: float
) -> dict[str, float]:
    """Who teaches a style: shares of its total loss weight in algorithm 1, averaged over styles.

    A frame of τ_i counts 1 − p for its own style and p W(τ_i, τ_j) / (N − 1) for each other style j.

    Args:
        dissimilarity: ν of the demonstrations.
        behaviors: (N,) their behaviours.
        beta: Inverse temperature.
        p: Relabelling probability.

    Returns:
        Shares of the own demonstration, of others of the same behaviour and of those of other behaviours.
    """
    n = len(behaviors)
    everyone = np.arange(n)
    shares = {"own": 0.0, "same": 0.0, "other": 0.0}
    for style in range(n):
        teaches = p / (n - 1) * similarity_weights(dissimilarity.nu(everyone, style), beta)
        teaches[style] = 1 - p
        total, same = teaches.sum(), teaches[behaviors == behaviors[style]].sum()
        shares["own"] += (1 - p) / total / n
        shares["same"] += (same - (1 - p)) / total / n
        shares["other"] += (total - same) / total / n
    return {kind: float(share) for kind, share in shares.items()}


def compute_similarity(cell: Cell, dataset: Path) -> dict[str, Any]:
    """The result of a ``similarity`` cell: ν to some reference demonstrations, ρ for some β, shares.

    The references are the first demonstrations of the most frequent behaviours.
    """
    trajectories = load_low_dimensional(dataset)
    everyone = np.arange(len(trajectories))
    similarity = similarity_of(trajectories, _observations(trajectories), dataset)
    dissimilarity = Dissimilarity(similarity, everyone)
    rule = task_of(environment(cell.definition["env"])).behavior_rule()
    behaviors = np.array([rule(episode) for episode in trajectories.episodes()])
    names, counts = np.unique(behaviors, return_counts=True)
    frequent = names[np.argsort(-counts, kind="stable")][: cell.definition["references"]]
    references = [int(np.flatnonzero(behaviors == name)[0]) for name in frequent]
    nu = {i: dissimilarity.nu(i, everyone) for i in references}
    same, other = _nu_by_behavior(dissimilarity, behaviors)
    result: dict[str, Any] = {
        "references": references,
        "nu": [np.round(nu[i], 4).tolist() for i in references],
        "nu_same": _quantiles(same),
        "nu_other": _quantiles(other),
        "shares": [
            {"beta": beta, "p": p, **teaching_shares(dissimilarity, behaviors, beta, p)}
            for beta, p in cell.definition["teaching"]
        ],
    }
    if cell.definition["betas"]:
        positions = trajectories.states([OBS_STATE])
        result["rho"] = {
            str(beta): np.round(
                input_distribution(positions, similarity_weights(nu[references[0]], beta), GRID), 8
            ).tolist()
            for beta in cell.definition["betas"]
        }
    return result


def compute_style_map(cell: Cell, store: Store, dataset: Path) -> dict[str, Any]:
    """The result of a ``styles`` cell: the first seed's styles in the plane, and how they cluster.

    ``neighbour_agreement`` is, for every seed, the share of styles whose nearest other style belongs to a
    demonstration of the same behaviour.
    """
    assert cell.needs is not None
    rule = task_of(environment(cell.definition["env"])).behavior_rule()
    behaviors = np.array([rule(episode) for episode in load_low_dimensional(dataset).episodes()])
    agreement, flat = [], None
    for seed in cell.needs.definition["seeds"]:
        policy: Any = load_policy(checkpoint_folder(cell.needs, store, seed), None, None).policy
        styles = policy.styles.embedding.weight.detach().numpy().astype(float)
        _, nearest = KDTree(styles).query(styles, k=2)
        agreement.append(float((behaviors[nearest[:, 1]] == behaviors).mean()))
        flat = principal_components(styles) if flat is None else flat
    assert flat is not None
    return {"points": np.round(flat, 4).tolist(), "neighbour_agreement": agreement}


def _nu_by_behavior(dissimilarity: Dissimilarity, behaviors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ν of pairs of different demonstrations with the same behaviour, and of those with different ones.

    Of all demonstrations i, or an even selection of `INSPECTED`, with all others.
    """
    everyone = np.arange(len(behaviors))
    same, other = [], []
    for i in everyone[:: -(-len(everyone) // INSPECTED)]:
        alike = behaviors == behaviors[i]
        same.append(dissimilarity.nu(i, everyone[alike & (everyone != i)]))
        other.append(dissimilarity.nu(i, everyone[~alike]))
    return np.concatenate(same), np.concatenate(other)


def _observations(trajectories: Trajectories) -> list[str]:
    return [key for key in (OBS_STATE, OBS_ENV_STATE) if key in trajectories.columns]


def _quantiles(values: np.ndarray) -> list[float]:
    """10 %, 50 % and 90 %."""
    return np.round(np.quantile(values, [0.1, 0.5, 0.9]), 4).tolist() if len(values) else []
