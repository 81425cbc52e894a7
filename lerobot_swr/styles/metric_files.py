"""Values of a dataset's episodes that other programs wrote, as JSON or CSV (graders of LeRobot datasets do).

JSON holds a list of records with an episode number, or such a list under any key; or an object from episode
number to record; or an object of columns, each a list in the order of the episodes or an object by episode
number. CSV holds one record a row. Without a column of episode numbers, records are in their order. Several
records of one episode (one a camera) are averaged. Names of nested values are joined by ``_``.
"""

import csv
import json
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_swr.styles.filters import Value, column_kind
from lerobot_swr.user_functions import is_metric_file, listed

EPISODE_NAMES = ("episode_index", "episode", "episode_id", "episode_idx", "ep_idx")

logger = logging.getLogger(__name__)


def read_metric_files(style_metrics: str | None, count: int) -> dict[str, list[Value]]:
    """The columns of all files that ``style_metrics`` names.

    Args:
        style_metrics: Files and ``module:function``, separated by commas.
        count: N, episodes of the dataset.
    """
    files = [Path(path) for path in listed(style_metrics) if is_metric_file(path)]
    return {name: column for path in files for name, column in read_metric_file(path, count).items()}


def read_metric_file(path: Path, count: int) -> dict[str, list[Value]]:
    """Columns of a file of per-episode values.

    Args:
        path: The file.
        count: N, episodes of the dataset.

    Returns:
        Name to N values. Columns with gaps are left out, with a warning.

    Raises:
        FileNotFoundError: If there is no file.
        ValueError: If it holds no values of episodes, or of episodes that the dataset lacks.
    """
    where = f"style_metrics={str(path)!r}"
    if not path.is_file():
        raise FileNotFoundError(f"{where} does not exist")
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = list(csv.DictReader(text.splitlines())) if path.suffix.lower() == ".csv" else json.loads(text)
        records = list(_records(rows, count))
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{where} cannot be read: {error}") from error
    beyond = sorted({episode for episode, _ in records if not 0 <= episode < count})
    if beyond:
        raise ValueError(
            f"{where} has values of episodes {beyond[:10]}; the dataset has episodes 0 to {count - 1}"
        )
    values: dict[str, list[list[Any]]] = {}
    for episode, record in records:
        for name, value in _leaves(record):
            values.setdefault(name, [[] for _ in range(count)])[episode].append(_typed(value))
    columns = {}
    for name, cells in values.items():
        column = _column(cells)
        if column is None:
            empty = [i for i, cell in enumerate(cells) if not cell]
            why = f"no value of episodes {empty[:10]}" if empty else "values of different kinds"
            logger.warning("%s: left out %r: %s", where, name, why)
        else:
            columns[name] = column
    if not columns:
        raise ValueError(
            f"{where} has no column with a value of each of the {count} episodes; expected records such as "
            '{"episode_index": 0, "quality": 0.9}'
        )
    return columns


def _records(data: Any, count: int) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """(episode, record) pairs of whatever the file holds."""
    if isinstance(data, list) and all(isinstance(row, dict) for row in data):
        for place, row in enumerate(data):
            key = next((k for name in EPISODE_NAMES for k in row if k.strip().lower() == name), None)
            episode = place if key is None else _number(row[key])
            yield episode, {k: v for k, v in row.items() if k != key}
        return
    if not isinstance(data, dict):
        raise ValueError("expected a list of records or an object")
    if data and all(re.fullmatch(r"(episode_?)?\d+", str(key)) for key in data):
        for key, row in data.items():
            yield int(re.sub(r"\D", "", key)), row if isinstance(row, dict) else {"value": row}
        return
    lists = [v for v in data.values() if isinstance(v, list) and v and all(isinstance(r, dict) for r in v)]
    if lists:
        yield from _records(max(lists, key=len), count)
        return
    nested = [v for v in data.values() if isinstance(v, dict) and v]
    tables = [v for v in nested if all(isinstance(r, dict) and str(k).isdigit() for k, r in v.items())]
    if tables:
        yield from _records(max(tables, key=len), count)
        return
    for name, column in data.items():
        if isinstance(column, list) and len(column) == count:
            yield from ((episode, {name: value}) for episode, value in enumerate(column))
        elif isinstance(column, dict) and column and all(str(key).isdigit() for key in column):
            yield from ((int(key), {name: value}) for key, value in column.items())


def _number(value: Any) -> int:
    try:
        return int(float(value))
    except (TypeError, ValueError) as error:
        digits = re.fullmatch(r"\D*(\d+)", str(value))  # episode_000012
        if digits is None:
            raise ValueError(f"{value!r} is no episode number") from error
        return int(digits[1])


def _leaves(record: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names, fit for filters, and values; lists have no place in a filter."""
    for key, value in record.items():
        name = prefix + re.sub(r"\W+", "_", str(key).strip()).strip("_")
        if isinstance(value, dict):
            yield from _leaves(value, f"{name}_")
        elif name and not isinstance(value, list | tuple) and value is not None and value != "":
            yield (name if not name[0].isdigit() else f"_{name}"), value


def _typed(value: Any) -> Value:
    """A cell of a CSV file as the number or truth value that it means."""
    if not isinstance(value, str):
        return value
    if value.strip().lower() in ("true", "false"):
        return value.strip().lower() == "true"
    try:
        return float(value)
    except ValueError:
        return value


def _column(cells: Sequence[Sequence[Value]]) -> list[Value] | None:
    """One value for each episode; None if some have none, or they are of different kinds."""
    flat = [value for cell in cells for value in cell]
    if any(not cell for cell in cells) or len({column_kind([value]) for value in flat}) > 1:
        return None
    if any(value != value or value in (float("inf"), float("-inf")) for value in flat):
        return None
    if column_kind(flat) == "number":
        return [cell[0] if len(cell) == 1 else sum(cell) / len(cell) for cell in cells]  # type: ignore[arg-type]
    return [cell[0] for cell in cells] if all(len(set(cell)) == 1 for cell in cells) else None
