"""Curves over the size of a perturbation, a line per method."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lerobot_swr.reproduction.stored_results import StoredCell
from lerobot_swr.reproduction.summary import Rate, Summary

Measure = Callable[[Summary], tuple[float, float, float] | None]
"""Value, and the ends of its interval; None where there is none."""

# Each has its colour and marker in all pictures; others take those after them, in the order of the picture.
METHODS = (
    *("zbc", "wzbc", "zbc corrective=noise", "zbc corrective=demos", "wzbc corrective=noise"),
    *("playback", "bc"),
)
MARKERS = "os^DvPx*<"
_ARM = ("start_radius", "action_noise", "box_push")


def plot_perturbations(path: Path, cells: Sequence[StoredCell], measures: Sequence[str]) -> bool:
    """A row of panels per kind of perturbation.

    Args:
        path: Where to write the picture.
        cells: Evaluations on one dataset.
        measures: What to draw, of `MEASURES`.

    Returns:
        Whether there was something to draw.
    """
    methods = list(dict.fromkeys(cell.labels.policy for cell in cells))
    names = short_names(methods)
    places = {name: k for k, name in enumerate(dict.fromkeys((*METHODS, *names.values())))}
    env_type = cells[0].demonstrations.env["type"]
    sizes = {label: size for label, size in SIZES[env_type].items() if len(_drawn(cells, size)) > 1}
    if not sizes:
        return False
    figure = Figure(figsize=(4.1 * len(measures), 3.2 * len(sizes) + 0.5), layout="constrained")
    grid = figure.subplots(len(sizes), len(measures), squeeze=False)
    for row, (x_label, size) in zip(grid, sizes.items(), strict=True):
        ticks = sorted(_drawn(cells, size))
        apart = 0.012 * (ticks[-1] - ticks[0])  # so that intervals stand side by side
        for axes, name in zip(row, measures, strict=True):
            for i, method in enumerate(methods):
                points = []
                for cell in cells:
                    x, y = size(cell.definition["env"]), MEASURES[name](cell.best)
                    if cell.labels.policy == method and x is not None and y is not None:
                        points.append((x, *y))
                if points:
                    x_values, y_values, low, high = np.array(sorted(points)).T
                    x_values = x_values + apart * (i - (len(methods) - 1) / 2)
                    k = places[names[method]]
                    marker, color = MARKERS[k % len(MARKERS)] + "-", f"C{k}"
                    axes.plot(x_values, y_values, marker, color=color, label=names[method], markersize=4)
                    axes.vlines(x_values, low, high, color=color, linewidth=1.5, alpha=0.6)
            axes.set(xlabel=x_label, ylabel=name, xticks=ticks)
            if name.startswith("L1"):
                axes.set_ylim(0, 2)
            elif name in ("success", "style match"):
                axes.set_ylim(0, 1.03)
            else:
                axes.set_ylim(bottom=0)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=min(len(labels), 3), fontsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    return True


def short_names(methods: Sequence[str]) -> dict[str, str]:
    """Names without the options that all methods have."""
    options = [method.split(" ")[1:] for method in methods]
    shared = set(options[0]).intersection(*options[1:]) if len(methods) > 1 else set()
    return {
        method: " ".join([method.split(" ")[0], *(word for word in words if word not in shared)])
        for method, words in zip(methods, options, strict=True)
    }


def _drawn(cells: Sequence[StoredCell], size: Callable[[Mapping[str, Any]], float | None]) -> set[float]:
    """The sizes that there are."""
    found = {size(cell.definition["env"]) for cell in cells}
    return {one for one in found if one is not None}


def _rate(rate: Rate | None) -> tuple[float, float, float] | None:
    return None if rate is None else (rate.mean, rate.interval.low, rate.interval.high)


def _length_error(summary: Summary) -> tuple[float, float, float] | None:
    interval = summary.length_error_interval
    if summary.length_error is None or interval is None:
        return None
    return summary.length_error, interval.low, interval.high


MEASURES: dict[str, Measure] = {
    "success": lambda s: _rate(s.success),
    "style match": lambda s: _rate(s.fidelity),
    "L1 (each style once)": lambda s: (
        (s.l1, s.l1_interval.low, s.l1_interval.high) if s.protocol == "stratified" else None
    ),
    "median length error (steps)": _length_error,
}


def _start_radius(env: Mapping[str, Any]) -> float | None:
    if env["transition_noise"] or env["sticky_walls"] or env["start"] == "random":
        return None
    return env["start_radius"] if env["start"] == "pseudo_random" else 0.0


def _noise(env: Mapping[str, Any]) -> float | None:
    return None if env["sticky_walls"] or env["start"] != "fixed" else env["transition_noise"]


def _alone(key: str) -> Callable[[Mapping[str, Any]], float | None]:
    """The size of one perturbation of the arm where there is no other."""
    others = [other for other in _ARM if other != key]
    return lambda env: None if any(env[other] for other in others) else env[key]


SIZES: dict[str, dict[str, Callable[[Mapping[str, Any]], float | None]]] = {
    "maze2d": {
        "half-width of the start square (of the side)": _start_radius,
        "standard deviation of the noise (largest steps)": _noise,
    },
    "d3il": {
        "half-width of the start square (m)": _alone("start_radius"),
        "standard deviation of the action noise (m)": _alone("action_noise"),
        "free slide of the pushed box (m)": _alone("box_push"),
    },
}
"""By type of the environment: label of the axis to the size of an environment's perturbation."""
