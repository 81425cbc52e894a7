"""Pictures of cards: a policy's styles, a dataset's demonstrations."""

import io
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from lerobot_swr.styles.filters import Value, column_kind

MAX_POINTS = 2000
MAX_PATHS = 300
MAX_GROUPS = 20
"""More behaviours than this are drawn as one group each of the most frequent ones, and the rest."""
BINS = 10
WIDTH, HEIGHT, MIDDLE = 960, 420, 480
FINE = 2  # drawn at twice the size, for smooth edges
RADIUS = 4 * FINE
PALETTE = [
    "#1f77b4",
    "#ff7f0e",
    "#2ca02c",
    "#d62728",
    "#9467bd",
    "#8c564b",
    "#e377c2",
    "#7f7f7f",
    "#bcbd22",
    "#17becf",
    "#aec7e8",
    "#ffbb78",
    "#98df8a",
    "#ff9896",
    "#c5b0d5",
    "#c49c94",
    "#f7b6d2",
    "#c7c7c7",
    "#dbdb8d",
    "#9edae5",
]  # matplotlib's tab20


def groups_of(values: Sequence[Value]) -> list[str]:
    """The group of each value: the value itself; of numbers, the tenth of their range that it lies in."""
    if column_kind(values) == "number":
        numbers = np.array(values, dtype=float)
        edges = np.histogram_bin_edges(numbers, BINS)
        places = np.clip(np.searchsorted(edges, numbers, side="right") - 1, 0, BINS - 1)
        return [f"{edges[place]:.3g} to {edges[place + 1]:.3g}" for place in places]
    frequent = {str(value) for value, _ in Counter(values).most_common(MAX_GROUPS - 1)}
    several = len(set(values)) > MAX_GROUPS
    return [
        "others" if several and str(value) not in frequent else str(value) or "(none)" for value in values
    ]


def draw_groups(shapes: Sequence[np.ndarray], values: Sequence[Value], name: str, what: str) -> bytes:
    """A picture (PNG) of points or paths in their groups' colours, and of how many each group has.

    It takes some hundredths of a second, since every saved policy has one.

    Args:
        shapes: N points (1, 2) or paths (P, 2); of very many some are drawn.
        values: N values that the groups are made of.
        name: What the values are.
        what: What is drawn.
    """
    groups = groups_of(values)
    colors = _colors(groups, column_kind(values) == "number")
    image = Image.new("RGB", (WIDTH * FINE, HEIGHT * FINE), "white")
    canvas = ImageDraw.Draw(image)
    _write(canvas, (20, 12), f"{len(shapes)} {what}", 14)
    _write(canvas, (MIDDLE + 20, 12), f"demonstrations by {name}", 14)
    most = MAX_POINTS if len(shapes[0]) == 1 else MAX_PATHS
    shown = np.linspace(0, len(shapes) - 1, min(len(shapes), most)).round().astype(int)
    _draw_shapes(canvas, [shapes[i] for i in shown], [colors[groups[i]] for i in shown])
    _draw_bars(canvas, Counter(groups), colors)
    picture = io.BytesIO()
    image.resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS).save(picture, format="png", optimize=True)
    return picture.getvalue()


def _colors(groups: Sequence[str], numbers: bool) -> dict[str, tuple[int, int, int]]:
    """A colour for each group, in the order in which they are listed: by size, or from small to large."""
    if not numbers:
        names = [one for one, _ in Counter(groups).most_common()]
        return {one: _rgb(PALETTE[i % len(PALETTE)]) for i, one in enumerate(names)}
    names = sorted(set(groups), key=lambda one: float(one.split()[0]))
    low, middle, high = np.array([(68, 1, 84), (33, 145, 140), (222, 190, 20)])
    places = np.linspace(0, 2, len(names))[:, None]
    mixed = np.where(places <= 1, low + (middle - low) * places, middle + (high - middle) * (places - 1))
    return {one: (r, g, b) for one, (r, g, b) in zip(names, mixed.astype(int).tolist(), strict=True)}


def _rgb(text: str) -> tuple[int, int, int]:
    red, green, blue = ImageColor.getrgb(text)[:3]
    return red, green, blue


def _draw_shapes(
    canvas: ImageDraw.ImageDraw, shapes: Sequence[np.ndarray], colors: Sequence[tuple[int, int, int]]
) -> None:
    """Points or paths, in the left part, at one scale in both directions."""
    everything = np.concatenate(shapes)
    low, high = everything.min(axis=0), everything.max(axis=0)
    left, top, right, bottom = 24, 44, MIDDLE - 24, HEIGHT - 20
    room = np.array([right - left, bottom - top])
    scale = (room / np.maximum(high - low, 1e-9)).min()
    centre = np.array([left + right, top + bottom]) / 2
    for shape, color in zip(shapes, colors, strict=True):
        # Upwards, as in any diagram.
        places = (centre + (shape - (low + high) / 2) * scale * [1, -1]) * FINE
        if len(places) == 1:
            x, y = places[0]
            canvas.ellipse((x - RADIUS, y - RADIUS, x + RADIUS, y + RADIUS), fill=color)
        else:
            canvas.line([tuple(place) for place in places], fill=color, width=FINE)


def _draw_bars(
    canvas: ImageDraw.ImageDraw, counted: Mapping[str, int], colors: Mapping[str, tuple[int, int, int]]
) -> None:
    """A bar for each group, with its name and number, in the right part."""
    height = min(24.0, (HEIGHT - 60) / len(colors))
    start, longest = MIDDLE + 190, WIDTH - MIDDLE - 250
    for i, (one, color) in enumerate(colors.items()):
        top = 44 + i * height
        end = start + longest * counted[one] / max(counted.values())
        canvas.rectangle((start * FINE, top * FINE, end * FINE, (top + height * 0.8) * FINE), fill=color)
        size = min(13.0, height * 0.75)
        _write(canvas, (MIDDLE + 20, top), one if len(one) <= 24 else f"{one[:23]}…", size)
        _write(canvas, (end + 6, top), str(counted[one]), size)


def _write(canvas: ImageDraw.ImageDraw, place: tuple[float, float], text: str, size: float) -> None:
    x, y = place
    canvas.text((x * FINE, y * FINE), text, fill="#222222", font=ImageFont.load_default(size * FINE))
