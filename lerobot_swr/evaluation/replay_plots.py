"""Picture of a replay."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lerobot_swr.envs.task import Task
from lerobot_swr.evaluation.plots import save_figure
from lerobot_swr.evaluation.time_offsets import OFFSETS, ColumnGroup

RECORDED, SUCCEEDED, FAILED = "0.6", "tab:blue", "tab:red"
LEGEND = {RECORDED: "recorded", SUCCEEDED: "replayed, success", FAILED: "replayed, no success"}


def plot_replay(
    path: Path,
    succeeded: Sequence[bool],
    offsets: Sequence[ColumnGroup],
    recorded: Sequence[Mapping[str, np.ndarray]],
    observed: Sequence[Mapping[str, np.ndarray]],
    task: Task,
    title: str,
) -> None:
    """Recorded and replayed paths in the scene, and how far they are apart at every shift in time.

    Args:
        path: Where to write the picture.
        succeeded: Whether each replay did.
        offsets: Mean deviations of groups of columns at every shift.
        recorded: Observations of every recording.
        observed: Observations of every replay.
        task: Draws the scene and tells the paths.
        title: Heading.
    """
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    scene, shifts = figure.subplots(1, 2, width_ratios=(1, 1.2))
    task.draw_scene(scene)
    for k, (one, other) in enumerate(zip(recorded, observed, strict=True)):
        scene.plot(*task.plot_path(one).T, color=RECORDED, linewidth=2.2, alpha=0.6)
        color = SUCCEEDED if succeeded[k] else FAILED
        scene.plot(*task.plot_path(other).T, color=color, linewidth=0.8)
    for color, label in LEGEND.items():
        scene.plot([], [], color=color, label=label)
    scene.set(xticks=[], yticks=[], aspect="equal")
    figure.legend(*scene.get_legend_handles_labels(), loc="outside lower left", ncols=3, fontsize=8)
    for group in offsets:
        if group.deviation_by_offset is not None:
            columns = ", ".join(group.columns[:4]) + (" …" if len(group.columns) > 4 else "")
            label = f"{group.feature.removeprefix('observation.')}: {columns}"
            shifts.plot(OFFSETS, list(group.deviation_by_offset.values()), "o-", label=label)
    shifts.set(
        xlabel="shift of the recording in steps (right of 0: it is behind)",
        ylabel="mean deviation, in the feature's units",
        ylim=(0, None),
    )
    if shifts.lines:
        shifts.legend(fontsize=8)
    figure.suptitle(title)
    save_figure(figure, path)
