"""Pictures of the steering checks, drawn from their results."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from lerobot.envs import EnvConfig
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure

from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.blending import BlendResult
from lerobot_swr.evaluation.counterfactual import CounterfactualResult
from lerobot_swr.evaluation.length_control import BIN_WIDTH, LengthControlResult


def plot_counterfactual(path: Path, result: CounterfactualResult, title: str) -> None:
    """The confusion matrix, requested × shown, as shares of each row.

    Args:
        path: Where to write the picture.
        result: The check.
        title: Heading.
    """
    labels = list(result.confusion)
    strangers = sorted({shown for row in result.confusion.values() for shown in row} - set(labels))
    columns = labels + strangers
    counts = np.array([[row.get(shown, 0) for shown in columns] for row in result.confusion.values()])
    shares = counts / counts.sum(axis=1, keepdims=True)
    figure = Figure(figsize=(2.4 + 0.48 * len(columns), 1.9 + 0.4 * len(labels)), layout="constrained")
    axes = figure.subplots()
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1, aspect="auto")
    for i, j in np.argwhere(counts):
        color = "white" if shares[i, j] > 0.5 else "black"
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", color=color, fontsize=9)
    axes.set_xticks(range(len(columns)), [label or "(none)" for label in columns], rotation=90)
    axes.set_yticks(range(len(labels)), labels)
    axes.set(xlabel="shown behaviour", ylabel="requested behaviour")
    axes.set_title(title, fontsize=10)
    _save(figure, path)


def plot_length_control(path: Path, result: LengthControlResult, title: str) -> None:
    """Histograms of lengths: demonstrations in the band and rollouts.

    Args:
        path: Where to write the picture.
        result: The check.
        title: Heading.
    """
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    bins = sorted({int(b) for b in (*result.histogram, *result.reference_histogram)})
    reference = [result.reference_histogram.get(str(b), 0.0) for b in bins]
    shown = [result.histogram.get(str(b), 0.0) for b in bins]
    place = np.array(bins) + BIN_WIDTH / 2
    axes.bar(
        place - 1, reference, 2, color="0.6", label=f"{result.n_demonstrations} demonstrations in the band"
    )
    axes.bar(place + 1, shown, 2, color="tab:blue", label=f"{result.n_episodes} rollouts")
    axes.axvspan(result.band[0], result.band[1] + 1, color="tab:green", alpha=0.12, linewidth=0, zorder=0)
    axes.set(xlabel="length in frames", ylabel="share of episodes")
    axes.set_xticks([*bins, bins[-1] + BIN_WIDTH], [*map(str, bins), str(bins[-1] + BIN_WIDTH)], rotation=90)
    axes.legend()
    axes.set_title(title, fontsize=10)
    _save(figure, path)


def plot_blends(
    path: Path,
    result: BlendResult,
    paths: Sequence[np.ndarray],
    env_cfg: EnvConfig,
    title: str,
    examples: int = 2,
) -> None:
    """Blends of the first pairs of each kind in the scene, and how often blends succeed.

    Args:
        path: Where to write the picture.
        result: The check.
        paths: Path (T, 2) of every rollout.
        env_cfg: Its task draws the scene.
        title: Heading.
        examples: Pairs of each kind to draw.
    """
    kinds = list(result.n_pairs)
    figure = Figure(figsize=(4.2 * len(kinds) + 4.6, 8.4), layout="constrained")
    grid = figure.subplots(examples, len(kinds) + 1, squeeze=False)
    colors = colormaps["viridis"]
    for column, kind in enumerate(kinds):
        mine = [k for k, record in enumerate(result.episodes) if record["pair"] == kind]
        for row in range(examples):
            axes = grid[row, column]
            axes.set(xticks=[], yticks=[], aspect="equal")
            chosen = mine[row * len(result.shares) : (row + 1) * len(result.shares)]
            if not chosen:
                axes.set_axis_off()
                continue
            task_of(env_cfg).draw_scene(axes)
            for k in chosen:
                record = result.episodes[k]
                style = "-" if record["success"] else ":"
                axes.plot(*paths[k].T, style, color=colors(record["share"]), linewidth=1.8)
            i, j = result.episodes[chosen[0]]["episodes"]
            ends = result.episodes[chosen[0]]["ends"]
            axes.set_title(f"{kind}: {i} ({ends[0]}) to {j} ({ends[1]})", fontsize=10)
    for row, (name, rates) in enumerate(
        (("success rate", result.success_rate), ("shows the behaviour of an end", result.end_behavior_rate))
    ):
        axes = grid[row, -1]
        for kind in kinds:
            axes.plot(result.shares, rates[kind], "o-", label=f"{result.n_pairs[kind]} pairs, {kind}")
        axes.set(xlabel="share of the second style", ylabel=name, ylim=(-0.03, 1.03))
        axes.legend(loc="lower left")
    for row in range(2, examples):
        grid[row, -1].set_axis_off()
    scale = ScalarMappable(cmap=colors)
    scale.set_clim(0, 1)
    figure.colorbar(
        scale, ax=grid[:, :-1], shrink=0.5, label="share of the second style (dotted: no success)"
    )
    figure.suptitle(title)
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
