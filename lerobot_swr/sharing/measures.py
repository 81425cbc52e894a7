"""Figures of the result files that the evaluation commands write, each with its interval."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ENDINGS = ("_interval", "_band")
SKIPPED = ("provenance", "episodes")
PICTURES = (".png",)


@dataclass(frozen=True)
class Measure:
    """One figure.

    Attributes:
        name: What it is of.
        value: The figure.
        interval: Its 95 % interval; None where there is none.
    """

    name: str
    value: float
    interval: tuple[float, float] | None

    def __str__(self) -> str:
        """The figure and its interval."""
        bounds = "" if self.interval is None else f" [{self.interval[0]:.3f}, {self.interval[1]:.3f}]"
        return f"{self.value:.3f}{bounds}"


@dataclass(frozen=True)
class ResultFile:
    """What a result file holds.

    Attributes:
        path: The file.
        measures: Its figures that have an interval.
        command: The command that made it; empty if it does not say.
        rollouts: How many; None if it does not say.
    """

    path: Path
    measures: list[Measure]
    command: str
    rollouts: int | None


def find_results(places: Sequence[Path]) -> list[ResultFile]:
    """The result files at some places.

    Args:
        places: Files, or folders, all of whose ``*.json`` with figures are taken.

    Raises:
        FileNotFoundError: If a place does not exist.
        ValueError: If a file is no JSON, or a place holds no figures.
    """
    found: list[ResultFile] = []
    for place in places:
        if not place.exists():
            raise FileNotFoundError(f"results={str(place)!r}: no such file or folder")
        files = sorted(place.glob("*.json")) if place.is_dir() else [place]
        here = [one for one in map(read_result, files) if one.measures]
        if not here:
            raise ValueError(
                f"results={str(place)!r}: no figures with intervals in it; give what lerobot-swr-eval wrote "
                "(its --output_dir)"
            )
        found += here
    return found


def read_result(path: Path) -> ResultFile:
    """One file's figures.

    Raises:
        ValueError: If it is no JSON.
    """
    try:
        content = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"results={str(path)!r}: not a JSON file ({error})") from error
    if not isinstance(content, dict):
        return ResultFile(path, [], "", None)
    provenance = content.get("provenance")
    command = provenance.get("command", "") if isinstance(provenance, dict) else ""
    rollouts = content.get("n_episodes")
    return ResultFile(
        path, list(_measures(content)), str(command), rollouts if isinstance(rollouts, int) else None
    )


def _measures(content: Mapping[str, Any], prefix: str = "") -> Iterator[Measure]:
    """Every figure whose interval stands beside it; conditions in lists and mappings are gone into."""
    for key, value in content.items():
        names = [key + ending for ending in ENDINGS] + [key.removesuffix("_rate") + ENDINGS[0]]
        intervals = [content[name] for name in names if name in content]
        if key in SKIPPED or key.endswith(ENDINGS):
            continue
        if intervals and isinstance(value, dict) and isinstance(intervals[0], dict):
            for kind, number in value.items():
                yield from _measure(f"{prefix}{_words(key)}, {kind}", number, intervals[0].get(kind))
        elif intervals:
            yield from _measure(prefix + _words(key), value, intervals[0])
        elif isinstance(value, list) and value and all(isinstance(one, dict) for one in value):
            for one in value:
                names = [text for text in one.values() if isinstance(text, str)]
                yield from _measures(one, f"{prefix}{names[0]}: " if names else prefix)
        elif isinstance(value, dict):
            for name, one in value.items():
                if isinstance(one, dict):
                    yield from _measures(one, f"{prefix}{name}: ")


def _measure(name: str, value: Any, interval: Any) -> Iterator[Measure]:
    if isinstance(value, int | float) and not isinstance(value, bool):
        yield Measure(name, float(value), _bounds(interval))


def _bounds(interval: Any) -> tuple[float, float] | None:
    ends = interval.values() if isinstance(interval, dict) else interval
    if isinstance(ends, str) or ends is None:
        return None
    numbers = [float(end) for end in ends if isinstance(end, int | float)]
    return (numbers[0], numbers[1]) if len(numbers) == 2 else None


def _words(key: str) -> str:
    return key.replace("_", " ").replace("l1", "L1")
