"""The house from the outside: which part may know which."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import lerobot_swr

PACKAGE = Path(lerobot_swr.__file__).parent
FLOORS = (
    # What knows nothing of the method.
    {"errors", "whole_files", "version", "random_streams", "run_context", "dataset_files", "dataset_checks"}
    | {"configuration", "dataset_statistics", "behaviors", "scene_variation", "metrics"}
    | {"progress", "ffmpeg", "installation", "checkpoint_files", "object_poses", "user_functions"}
    | {"html_pages"},
    {"trajectories", "frame_rows", "pauses", "envs", "similarity", "demos"},
    {"sampling", "styles", "style_encoding", "corrective", "discovery", "behavior_rules"},
    {"sharing"},
    {"policies"},
    {"training", "evaluation"},
    {"reproduction", "interactive"},
    {"cli", "__main__"},
)
"""Parts of the package, from the ground up: a part knows those of its own floor and of the floors below."""


def modules() -> dict[str, set[str]]:
    """Every module of the package to the modules of the package that it imports."""
    files = {
        ".".join(("lerobot_swr", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
            ".__init__"
        ): path
        for path in PACKAGE.rglob("*.py")
    }
    return {name: _imports(path, set(files)) - {name} for name, path in files.items()}


def _imports(path: Path, known: set[str]) -> set[str]:
    """Also within functions; what is imported for the type checker alone does not count."""
    tree, found = ast.parse(path.read_text()), set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None and node.level == 0:
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names & known or {node.module}
    return found & known


def part(module: str) -> str:
    """The part of the package that a module belongs to; metrics are for everybody."""
    names = module.split(".")
    return names[2] if names[1:] == ["evaluation", "metrics"] else names[1]


def test_no_modules_import_each_other_in_a_circle():
    """Raises a CycleError that names the circle."""
    TopologicalSorter(modules()).prepare()


def test_parts_know_only_what_lies_below():
    """Of the same floor, too, but not in a circle."""
    floors = {name: level for level, names in enumerate(FLOORS) for name in names}
    arrows = {
        (part(module), part(other))
        for module, others in modules().items()
        for other in others
        if module.count(".") and other.count(".") and part(module) != part(other)
    }
    assert {name for arrow in arrows for name in arrow} <= floors.keys(), "a part without a floor"
    assert [arrow for arrow in arrows if floors[arrow[0]] < floors[arrow[1]]] == []
    known: dict[str, set[str]] = {}
    for above, below in arrows:
        known.setdefault(above, set()).add(below)
    TopologicalSorter(known).prepare()


@pytest.mark.parametrize("text", ["import a.b", "from a import b", "from a.b import C"])
def test_imports_of_every_kind_are_seen(tmp_path, text):
    """The test's own eyes."""
    (tmp_path / "one.py").write_text(f"def f():\n    {text}\n")
    assert _imports(tmp_path / "one.py", {"a", "a.b"}) == {"a.b"}
