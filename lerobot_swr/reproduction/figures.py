"""Pictures of the report, drawn from stored results alone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure

from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checks.length import BIN_WIDTH
from lerobot_swr.evaluation.metrics import histogram
from lerobot_swr.evaluation.plots import (
    behavior_colors,
    draw_histograms,
    plot_behaviors,
    plot_comparison,
)
from lerobot_swr.reproduction.demonstrations import environment
from lerobot_swr.reproduction.stored_results import DatasetDescription, StoredCell
from lerobot_swr.reproduction.suites import LENGTH_BAND
from lerobot_swr.reproduction.summary import length_control

Paths = list[tuple[np.ndarray, str]]


def plot_paths(path: Path, demonstrations: DatasetDescription, cells: Sequence[StoredCell]) -> None:
    """Demonstrations, and the first seed's rollouts of every policy, coloured by behaviour."""
    panels = {cell.labels.policy: rollout_paths(cell) for cell in cells}
    plot_comparison(path, demonstration_paths(demonstrations), panels, environment(demonstrations.env), "")


def plot_histograms(path: Path, demonstrations: DatasetDescription, cells: Sequence[StoredCell]) -> None:
    """Behaviour histograms of every policy beside the demonstrations'."""
    columns = min(3, len(cells))
    rows = -(-len(cells) // columns)
    figure = Figure(figsize=(5.0 * columns, 3.3 * rows), layout="constrained")
    grid = iter(figure.subplots(rows, columns, squeeze=False, sharey=True).flat)
    for cell, axes in zip(cells, grid, strict=False):
        summary = cell.best
        draw_histograms(axes, demonstrations.histogram, summary.histogram)
        axes.set_title(f"{cell.labels.policy}: L1 {summary.l1:.3f} ({summary.protocol})", fontsize=10)
        axes.tick_params(axis="x", labelsize=7)
        axes.set(xlabel="behaviour")
        if cell is not cells[0]:
            axes.get_legend().remove()
        if axes.get_subplotspec().colspan.start > 0:
            axes.set_ylabel("")
    for axes in grid:
        axes.set_axis_off()
    _save(figure, path)


def plot_result(path: Path, demonstrations: DatasetDescription, cell: StoredCell) -> None:
    """One policy's paths and histogram beside the demonstrations'."""
    shown = rollout_paths(cell)
    plot_behaviors(
        path,
        demonstration_paths(demonstrations),
        shown,
        demonstrations.histogram,
        histogram([label for _, label in shown]),
        environment(demonstrations.env),
        "",
    )


def plot_control(path: Path, demonstrations: DatasetDescription, cells: Sequence[StoredCell]) -> None:
    """Histograms of lengths: all demonstrations, those in the band, free and controlled rollouts; and L1."""
    by_policy: dict[str, dict[str, StoredCell]] = {}
    for cell in cells:
        by_policy.setdefault(cell.labels.policy, {})[cell.labels.condition] = cell
    controlled = {name: pair for name, pair in by_policy.items() if "controlled" in pair}
    low, high = LENGTH_BAND
    lengths = np.array(demonstrations.result["length"])
    after_end = demonstrations.result["frames_after_end"]
    figure = Figure(figsize=(15, 2.9 * len(controlled)), layout="constrained")
    grid = figure.subplots(len(controlled), 5, squeeze=False, width_ratios=(1, 1, 1, 1, 0.7))
    for row, (policy, pair) in zip(grid, controlled.items(), strict=True):
        panels = {
            "training": (lengths, "0.6"),
            "filtered training": (lengths[(lengths >= low) & (lengths <= high)], "0.6"),
            f"{policy}, free": (_lengths(pair["deterministic"]) + after_end, "tab:blue"),
            f"{policy}, controlled": (_lengths(pair["controlled"]) + after_end, "tab:blue"),
        }
        edges = np.arange(low - 8 * BIN_WIDTH, high + 12 * BIN_WIDTH, BIN_WIDTH)
        for axes, (name, (values, color)) in zip(row[:4], panels.items(), strict=True):
            shares = np.full(len(values), 1 / len(values))
            axes.hist(np.clip(values, edges[0], edges[-1]), edges, weights=shares, color=color)
            axes.axvspan(low, high + 1, color="tab:green", alpha=0.12, linewidth=0, zorder=0)
            axes.set(title=name, xlabel=f"length (bins of {BIN_WIDTH} frames)", ylim=(0, 0.75))
        row[0].set_ylabel("share of episodes")
        bars = {
            "free": length_control(pair["deterministic"].result, demonstrations.result, LENGTH_BAND),
            "controlled": length_control(pair["controlled"].result, demonstrations.result, LENGTH_BAND),
        }
        row[4].bar(list(bars), [found.l1 for found in bars.values()], color="tab:blue", width=0.6)
        for i, found in enumerate(bars.values()):
            row[4].plot([i] * len(found.l1_by_seed), found.l1_by_seed, ".", color="0.2")
            row[4].text(i, max(found.l1_by_seed) + 0.05, f"{found.l1:.2f}", ha="center")
        row[4].set(ylabel="L1 to filtered training", ylim=(0, 2))
    _save(figure, path)


def plot_dissimilarity(path: Path, demonstrations: DatasetDescription, cell: StoredCell) -> None:
    """All demonstrations in the scene, coloured by ν to each reference demonstration."""
    references = cell.result["references"]
    figure = Figure(figsize=(4.1 * len(references) + 0.8, 4.3), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(references)))
    colors = colormaps["viridis_r"]
    for axes, reference, nu in zip(panels, references, cell.result["nu"], strict=True):
        task_of(environment(demonstrations.env)).draw_scene(axes)
        paths = dict(zip(demonstrations.result["path_episodes"], demonstrations.result["paths"], strict=True))
        for episode in sorted(paths, key=lambda i: -nu[i]):  # the similar ones on top
            axes.plot(*np.array(paths[episode]).T, color=colors(nu[episode]), linewidth=0.9)
        if reference in paths:
            axes.plot(*np.array(paths[reference]).T, color="tab:red", linewidth=2.2)
        behavior = demonstrations.result["behavior"][reference]
        axes.set(title=f"to demonstration {reference} ({behavior})", xticks=[], yticks=[], aspect="equal")
    scale = ScalarMappable(cmap=colors)
    scale.set_clim(0, 1)
    figure.colorbar(scale, ax=list(panels), shrink=0.8, label="dissimilarity ν")
    _save(figure, path)


def plot_input_distributions(path: Path, demonstrations: DatasetDescription, cell: StoredCell) -> None:
    """ρ(s̃ | z) of one style on a grid of the maze, for several β."""
    rho = cell.result["rho"]
    figure = Figure(figsize=(3.6 * len(rho), 3.9), layout="constrained")
    for axes, (beta, values) in zip(figure.subplots(1, len(rho), squeeze=False)[0], rho.items(), strict=True):
        grid = np.array(values)
        axes.imshow(
            grid, origin="lower", extent=(0, 1, 0, 1), cmap="magma_r", norm=PowerNorm(0.5, 0, grid.max())
        )
        task_of(environment(demonstrations.env)).draw_scene(axes)
        axes.set(title=f"β = {float(beta):g}", xticks=[], yticks=[], aspect="equal")
    _save(figure, path)


def plot_style_maps(path: Path, demonstrations: DatasetDescription, cells: Sequence[StoredCell]) -> None:
    """The first seed's styles in the plane of their two main directions, coloured by behaviour."""
    behaviors = demonstrations.result["behavior"]
    colors = behavior_colors(list(demonstrations.histogram))
    figure = Figure(figsize=(5.2 * len(cells) + 1.2, 4.6), layout="constrained")
    panels = figure.subplots(1, len(cells), squeeze=False)[0]
    for axes, cell in zip(panels, cells, strict=True):
        points = np.array(cell.result["points"])
        for label, color in colors.items():
            mine = points[[behavior == label for behavior in behaviors]]
            axes.scatter(*mine.T, color=color, s=22, label=label)
        agreement = np.mean(cell.result["neighbour_agreement"])
        title = f"{cell.labels.policy}: nearest style has the same behaviour in {agreement:.2f}"
        axes.set_title(title, fontsize=10)
        axes.set(xlabel="first principal component", ylabel="second principal component")
    handles, labels = panels[-1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=8)
    _save(figure, path)


def plot_sweep(path: Path, cells: Sequence[StoredCell]) -> None:
    """Effect of β (at one p) and of p (at one β) on L1, success and style fidelity."""
    options = [cell.training["config"] for cell in cells if cell.training is not None]
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    for axes, name, other in zip(figure.subplots(1, 2), ("beta", "p"), ("p", "beta"), strict=True):
        values = [o[other] for o in options]
        fixed = max(set(values), key=values.count)
        chosen = [(o[name], cell) for o, cell in zip(options, cells, strict=True) if o[other] == fixed]
        chosen.sort(key=lambda pair: pair[0])
        _draw_sweep(axes, [str(f"{x:g}") for x, _ in chosen], [cell for _, cell in chosen])
        symbols = {"beta": "β", "p": "p"}
        axes.set_xlabel(f"{symbols[name]} ({symbols[other]} = {fixed:g})")
        axes.set_ylim(bottom=0)
    _save(figure, path)


def _draw_sweep(axes: Axes, names: list[str], cells: Sequence[StoredCell]) -> None:
    lines = {
        "L1 uniform": [cell.summaries["uniform"].l1 for cell in cells],
        "floor of L1 uniform": [cell.summaries["uniform"].floor.mean for cell in cells],
        "L1 stratified": [cell.summaries["stratified"].l1 for cell in cells],
        "success": [cell.best.success.mean for cell in cells],
        "style fidelity": [cell.best.fidelity.mean if cell.best.fidelity else np.nan for cell in cells],
    }
    styles = {"L1 uniform": "C0o-", "floor of L1 uniform": "C0:", "L1 stratified": "C1o-"}
    for name, values in lines.items():
        style = styles.get(name, "C2s--" if name == "success" else "C3s--")
        axes.plot(names, values, style, label=name, markersize=4)
    axes.set_ylabel("L1, share of rollouts")
    axes.legend(fontsize=8)


def demonstration_paths(demonstrations: DatasetDescription) -> Paths:
    """Paths (T, 2) of the demonstrations and their labels."""
    stored = zip(demonstrations.result["path_episodes"], demonstrations.result["paths"], strict=True)
    return [(np.array(points), demonstrations.result["behavior"][i]) for i, points in stored]


def rollout_paths(cell: StoredCell) -> Paths:
    """Paths (T, 2) of the rollouts that a cell has kept, and their labels."""
    first_seed = next(iter(cell.result["rollouts"].values()))
    labels = first_seed[cell.protocols[-1]]["behavior"]
    return [(np.array(points), label) for points, label in zip(cell.result["paths"], labels, strict=True)]


def _lengths(cell: StoredCell) -> np.ndarray:
    """Of all seeds' uniform rollouts."""
    return np.concatenate([parts["uniform"]["length"] for parts in cell.result["rollouts"].values()])


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
