"""Pictures of behaviour and offline evaluations, drawn from their results."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from lerobot.envs import EnvConfig
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.metrics import Histogram, histogram
from lerobot_swr.whole_files import replacing

MAX_BARS = 24
MAX_IN_LEGEND = 20  # behaviours
PANELS_IN_A_ROW = 4
DEMONSTRATIONS, ROLLOUTS = "0.6", "tab:blue"

Paths = Sequence[tuple[np.ndarray, str]]
"""Paths (T, 2) and their behaviour labels."""


def behavior_colors(labels: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """One colour per label."""
    palette = [*colormaps["tab20"].colors[::2], *colormaps["tab20"].colors[1::2]]  # type: ignore[attr-defined]
    return {label: palette[i % len(palette)] for i, label in enumerate(dict.fromkeys(labels))}


def plot_behaviors(
    path: Path,
    demonstrations: Paths,
    rollouts: Paths,
    reference: Histogram,
    shown: Histogram,
    env_cfg: EnvConfig,
    title: str,
) -> None:
    """Trajectories of demonstrations and rollouts, coloured by behaviour, and both histograms.

    Args:
        path: Where to write the picture (the suffix tells the format).
        demonstrations: Paths of the demonstrations.
        rollouts: Paths of the rollouts.
        reference: Histogram of the demonstrations.
        shown: Histogram of the rollouts.
        env_cfg: Its task draws the scene.
        title: Heading.
    """
    figure = Figure(figsize=(13, 4.4), layout="constrained")
    # Apart, so that long labels under the histograms do not squeeze the paths.
    scenes, bars = figure.subfigures(1, 2, squeeze=False, width_ratios=(2, 1.35))[0]
    left, middle = scenes.subplots(1, 2)
    colors = behavior_colors([*reference, *shown])
    for axes, paths, name in ((left, demonstrations, "demonstrations"), (middle, rollouts, "rollouts")):
        draw_paths(axes, paths, colors, env_cfg)
        axes.set_title(f"{len(paths)} {name}")
    histograms = bars.subplots()
    draw_histograms(histograms, reference, shown)
    histograms.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    figure.suptitle(title)
    save_figure(figure, path)


def plot_comparison(
    path: Path, demonstrations: Paths, policies: Mapping[str, Paths], env_cfg: EnvConfig, title: str
) -> None:
    """Demonstrations beside the rollouts of several policies, at most four panels in a row.

    Args:
        path: Where to write the picture.
        demonstrations: Paths of the demonstrations.
        policies: Heading of each further panel and its paths.
        env_cfg: Its task draws the scene.
        title: Heading of the picture.
    """
    panels = {"demonstrations": demonstrations, **policies}
    columns = min(len(panels), PANELS_IN_A_ROW)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3.3 * columns, 3.9 * rows), layout="constrained")
    demonstrated = list(histogram([label for _, label in demonstrations]))
    shown = [label for paths in policies.values() for _, label in paths]
    colors = behavior_colors([*demonstrated, *shown])
    grid = iter(figure.subplots(rows, columns, squeeze=False).flat)
    for (name, paths), axes in zip(panels.items(), grid, strict=False):
        draw_paths(axes, paths, colors, env_cfg)
        axes.set_title(name)
    for axes in grid:  # those that are left over
        axes.set_axis_off()
    if len(demonstrated) <= MAX_IN_LEGEND:
        lines = [Line2D([], [], color=colors[x], label=x) for x in demonstrated]  # type: ignore[arg-type]
        figure.legend(handles=lines, loc="outside right center", fontsize=8, title="demonstrated")
    figure.suptitle(title)
    save_figure(figure, path)


def draw_paths(axes: Axes, paths: Paths, colors: Mapping[str, tuple[float, ...]], env_cfg: EnvConfig) -> None:
    """Paths in the scene, coloured by behaviour."""
    task_of(env_cfg).draw_scene(axes)
    for points, label in paths:
        axes.plot(*points.T, color=colors[label], linewidth=0.8, alpha=0.8)
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])


def draw_histograms(axes: Axes, reference: Histogram, shown: Histogram) -> None:
    """Shares of the behaviours of demonstrations and rollouts side by side, most demonstrated first."""
    labels = list({**reference, **shown})
    most = MAX_BARS if len(labels) > MAX_BARS + 1 else len(labels)  # one more has room for its own name
    kept, others = labels[:most], labels[most:]
    rows: list[tuple[str, float, float]] = [
        (label or "(none)", reference.get(label, 0.0), shown.get(label, 0.0)) for label in kept
    ]
    if others:
        rest = [sum(source.get(label, 0.0) for label in others) for source in (reference, shown)]
        rows.append((f"{len(others)} others", rest[0], rest[1]))
    place = np.arange(len(rows))
    axes.bar(place - 0.2, [row[1] for row in rows], 0.4, label="demonstrations", color=DEMONSTRATIONS)
    axes.bar(place + 0.2, [row[2] for row in rows], 0.4, label="rollouts", color=ROLLOUTS)
    axes.set_xticks(place, [row[0] for row in rows], rotation=90 if len(rows) > 6 else 0)
    axes.set(xlabel="behaviour", ylabel="share of episodes")
    axes.legend()


def plot_offline(
    path: Path,
    errors: Mapping[str, np.ndarray],
    phase: np.ndarray,
    describe: Callable[[str], str],
    title: str,
) -> None:
    """Action error by kind of style: over all frames, and along the episode.

    Args:
        path: Where to write the picture.
        errors: Kind of style to (F,) squared error of each frame, in normalised units.
        phase: (F,) place of each frame in its episode, 0 to 1.
        describe: Legend of a kind of style.
        title: Heading.
    """
    figure = Figure(figsize=(11, 4), layout="constrained")
    bars, along = figure.subplots(1, 2, width_ratios=(1, 1.6))
    colors = {kind: f"C{i}" for i, kind in enumerate(errors)}
    means = [np.nanmean(values) for values in errors.values()]
    drawn = bars.bar(list(errors), means, color=list(colors.values()))
    bars.bar_label(drawn, fmt="%.3g")
    bars.set(ylabel="mean squared action error\n(normalised units)", xlabel="style")
    bins = np.minimum((phase * 20).astype(int), 19)
    for kind, values in errors.items():
        known = ~np.isnan(values)
        parts = [values[(bins == b) & known] for b in range(20)]
        mean = [part.mean() if len(part) else np.nan for part in parts]
        along.plot((np.arange(20) + 0.5) / 20, mean, color=colors[kind])
    along.set(xlabel="share of the episode", ylabel="mean squared action error", yscale="log")
    along.legend([Line2D([], [], color=colors[kind]) for kind in errors], [describe(kind) for kind in errors])
    figure.suptitle(title)
    save_figure(figure, path)


def save_figure(figure: Figure, path: Path) -> None:
    """Write a picture, all or nothing; the suffix tells the format."""
    with replacing(path) as unfinished:
        figure.savefig(unfinished, dpi=110, format=path.suffix[1:])
