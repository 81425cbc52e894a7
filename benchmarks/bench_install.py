"""What each dependency brings: its size, what only it needs, and the CPU seconds of importing it."""

import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement

from lerobot_swr.installation import DISTRIBUTION, extras

MODULES = {
    "jinja2": "jinja2",
    "pillow": "PIL.Image",
    "scipy": "scipy.stats",
    "matplotlib": "matplotlib.figure",
    "plotly": "plotly.offline",
    "gym-pusht": "gym_pusht",
}
MEGABYTE = 1e6


def main() -> None:
    """Print the table, then what LeRobot's command pays for this plugin."""
    print(f"{'dependency':<24}{'own MB':>8}{'with what only it needs':>25}{'import CPU s':>14}")
    hard = _asked(DISTRIBUTION, "")
    needed = _reachable(hard)
    for name in sorted(hard):
        alone = needed - _reachable(hard - {name})
        _print(name, alone)
    for extra in extras():
        for name in sorted(_asked(DISTRIBUTION, extra) - hard):
            _print(f"{name} [{extra}]", _reachable({name}) - needed)
    print(f"all that is needed: {sum(map(_size, needed)) / MEGABYTE:,.0f} MB in {len(needed)} packages")
    plain, ours = (_fastest(f"import lerobot.scripts.lerobot_train{more}") for more in ("", ", lerobot_swr"))
    print(f"import of lerobot-train {plain:.2f} s, with this plugin {ours:.2f} s ({ours - plain:+.2f} s)")


def _print(label: str, packages: set[str]) -> None:
    name = label.split()[0]
    if not _is_installed(name):
        print(f"{label:<24}{'not installed':>15}")
        return
    seconds = _fastest(f"import {MODULES.get(name, name.replace('-', '_'))}") - _fastest("pass")
    brings = sum(map(_size, packages)) / MEGABYTE
    print(f"{label:<24}{_size(name) / MEGABYTE:8.1f}{brings:25.1f}{seconds:14.2f}", flush=True)


def _asked(name: str, extra: str) -> set[str]:
    """Distributions that one asks for, with an extra."""
    return {key for key, _ in _requirements(name, frozenset({extra}))}


def _requirements(name: str, wanted: frozenset[str]) -> Iterator[tuple[str, frozenset[str]]]:
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in wanted | {""}):
            key = re.sub(r"[-_.]+", "-", requirement.name).lower()
            if key == re.sub(r"[-_.]+", "-", name).lower():  # extras that name others of the same package
                yield from _requirements(name, frozenset(requirement.extras))
            else:
                yield key, frozenset(requirement.extras)


def _reachable(names: set[str]) -> set[str]:
    """The distributions and all that they need, as far as they are installed."""
    asked = {key: more for key, more in _requirements(DISTRIBUTION, frozenset()) if key in names}
    waiting = [(name, asked.get(name, frozenset())) for name in names]
    found: set[str] = set()
    seen: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        name, wanted = waiting.pop()
        if (name, wanted) in seen or not _is_installed(name):
            continue
        seen.add((name, wanted))
        found.add(name)
        waiting += _requirements(name, wanted)
    return found


def _is_installed(name: str) -> bool:
    try:
        distribution(name)
    except PackageNotFoundError:
        return False
    return True


def _size(name: str) -> int:
    one: Distribution = distribution(name)
    return sum(file.size or 0 for file in one.files or ())


def _fastest(code: str, times: int = 2) -> float:
    timed = f"import time; start = time.process_time(); exec({code!r}); print(time.process_time() - start)"
    runs = [
        subprocess.run([sys.executable, "-c", timed], capture_output=True, text=True) for _ in range(times)
    ]
    seconds = [float(run.stdout.split()[-1]) for run in runs if run.returncode == 0]
    return min(seconds, default=float("nan"))


if __name__ == "__main__":
    main()
