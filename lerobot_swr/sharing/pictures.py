"""Pictures of cards: a policy's styles, a dataset's demonstrations."""

import io
from collections import Counter
from collections.abc import Sequence

import numpy as np

from lerobot_swr.styles.filters import Value, column_kind

MAX_POINTS = 2000
MAX_PATHS = 300
MAX_GROUPS = 20
"""More behaviours than this are drawn as one group each of the most frequent ones, and the rest."""
BINS = 10


def groups_of(values: Sequence[Value]) -> list[str]:
    """The group of each value: the value itself; of numbers, the tenth of their range that it lies in."""
    if column_kind(values) == "number":
        numbers = np.array(values, dtype=float)
        edges = np.histogram_bin_edges(numbers, BINS)
        places = np.clip(np.searchsorted(edges, numbers, side="right") - 1, 0, BINS - 1)
        return [f"{edges[place]:g} to {edges[place + 1]:g}" for place in places]
    frequent = {str(value) for value, _ in Counter(values).most_common(MAX_GROUPS - 1)}
    several = len(set(values)) > MAX_GROUPS
    return [
        "others" if several and str(value) not in frequent else str(value) or "(none)" for value in values
    ]


def draw_groups(shapes: Sequence[np.ndarray], values: Sequence[Value], name: str, what: str) -> bytes:
    """A picture (PNG) of points or paths in their groups' colours, and of how many each group has.

    Args:
        shapes: N points (1, 2) or paths (P, 2); of very many some are drawn.
        values: N values that the groups are made of.
        name: What the values are.
        what: What is drawn.
    """
    from matplotlib import colormaps  # half a second that a policy which is not saved does not pay
    from matplotlib.figure import Figure

    groups = groups_of(values)
    numbers = column_kind(values) == "number"
    counted = Counter(groups)
    names = (
        sorted(counted, key=lambda one: float(one.split()[0])) if numbers else [*dict(counted.most_common())]
    )
    palette = colormaps["viridis" if numbers else "tab20"]
    colors = {
        one: palette(i / max(len(names) - 1, 1)) if numbers else palette(i % 20)
        for i, one in enumerate(names)
    }
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, bars = figure.subplots(1, 2, width_ratios=(1.4, 1))
    most = MAX_POINTS if len(shapes[0]) == 1 else MAX_PATHS
    shown = np.linspace(0, len(shapes) - 1, min(len(shapes), most)).round().astype(int)
    for i in shown:
        left.plot(*shapes[i].T, ".-" if len(shapes[i]) == 1 else "-", color=colors[groups[i]], linewidth=0.8)
    left.set(title=f"{len(shapes)} {what}", xticks=[], yticks=[])
    bars.barh(range(len(names)), [counted[one] for one in names], color=[colors[one] for one in names])
    bars.set(title=f"demonstrations by {name}", ylim=(len(names) - 0.4, -0.6))
    bars.set_yticks(range(len(names)), names)
    bars.tick_params(axis="y", labelsize=8)
    picture = io.BytesIO()
    # Without a date, so that the same policy has the same picture.
    figure.savefig(picture, format="png", dpi=110, metadata={"Software": None})
    return picture.getvalue()
