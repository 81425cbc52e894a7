"""Markdown from data that may hold anything."""

from collections.abc import Sequence


def escaped(text: object) -> str:
    """Text in one line, in which neither Markdown nor HTML of the data means anything."""
    flat = " ".join(str(text).split())
    flat = flat.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return "".join(f"\\{c}" if c in "\\`*_[]|#" else c for c in flat)


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Lines of a table; cells are escaped."""
    lines = [header, ["---"] * len(header), *([escaped(cell) for cell in row] for row in rows)]
    return [f"| {' | '.join(map(str, line))} |" for line in lines]


def code(*lines: str) -> list[str]:
    """A block of commands."""
    return ["```bash", *lines, "```"]
