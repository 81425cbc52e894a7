"""The table of demonstrations and the preview of a filter, for the terminal."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lerobot_swr.styles.filters import Value, column_kind, describe_column
from lerobot_swr.styles.table import StyleTable

BAR = 40
BINS = 10


def format_table(table: StyleTable, episodes: Sequence[int], rows: int, title: str) -> str:
    """Columns with their ranges, named filters, and the first rows.

    Args:
        table: The table.
        episodes: Those that have a style.
        rows: How many rows to print.
        title: Heading.
    """
    columns = {name: [values[i] for i in episodes] for name, values in table.columns.items()}
    lines = [f"{title}: {len(episodes)} styles of {len(table)} demonstrations", ""]
    lines += [f"  {name:<14} {describe_column(values)}" for name, values in columns.items()]
    lines += ["", "named filters: " + ("none" if not table.filters else "")]
    for name, text in table.filters.items():
        keeps = table.matches(text)
        lines.append(f"  {name!r}: {text}  ({sum(keeps[i] for i in episodes)} styles)")
    # Components of states and task strings fill the width without telling much.
    shown = [name for name in columns if not name.startswith(("first_", "last_")) and name != "task"]
    lines += ["", "  ".join(f"{name:>11}" for name in shown)]
    lines += [
        "  ".join(f"{_cell(columns[name][r]):>11}" for name in shown) for r in range(min(rows, len(episodes)))
    ]
    if rows < len(episodes):
        lines.append(f"... {len(episodes) - rows} more; --rows=N prints N")
    return "\n".join(lines)


def format_preview(table: StyleTable, episodes: Sequence[int], kept: Sequence[int], text: str) -> str:
    """What a filter keeps, and the histogram of it in all demonstrations that have a style.

    Args:
        table: The table.
        episodes: Those that have a style.
        kept: Those that the filter keeps.
        text: The filter.
    """
    lines = [f"{len(kept)} of {len(episodes)} demonstrations: {', '.join(map(str, kept))}"]
    for name in ("behavior", "length"):
        if name in table.columns:
            values = table.columns[name]
            lines += ["", f"{name:<14} kept / all"]
            lines += _histogram([values[i] for i in episodes], [values[i] for i in kept])
    lines += ["", f'use it: --policy.style_filter="{text}"']
    return "\n".join(lines)


def _histogram(everything: Sequence[Value], kept: Sequence[Value]) -> list[str]:
    if column_kind(everything) == "number":
        numbers = np.array(everything, dtype=float)
        edges = np.histogram_bin_edges(numbers, BINS)
        counts = [np.histogram(np.array(part, dtype=float), edges)[0] for part in (kept, everything)]
        names = [f"{low:g} to {high:g}" for low, high in pairwise(edges)]
        pairs = list(zip(names, *(c.tolist() for c in counts), strict=True))
    else:
        among, total = Counter(kept), Counter(everything)
        pairs = [(str(label) or "(none)", among[label], n) for label, n in total.most_common()]
    largest = max(total for _, _, total in pairs)
    return [
        f"  {name:<14} {part:4d} /{total:4d}  {'#' * round(BAR * part / largest)}"
        f"{'.' * (round(BAR * total / largest) - round(BAR * part / largest))}"
        for name, part, total in pairs
    ]


def _cell(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
