"""Published results: the small files alone, and the README's table made from them."""

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_swr.reproduction import cell_texts, figures, paper
from lerobot_swr.reproduction.stored_results import StoredCell, load_suites
from lerobot_swr.reproduction.suites import UNPERTURBED
from lerobot_swr.whole_files import write_whole

START, END = "<!-- results: written by lerobot-swr-report -->", "<!-- end of results -->"
PICTURE = "result.png"
PICTURED = (("d3il_human_avoiding", "zbc"), ("medium_maze-only_forward", "wzbc"))
"""Dataset and policy of README's picture; the first one whose results are there."""


def publish(sources: Sequence[Path], target: Path, only: Sequence[str] | None = None) -> None:
    """Copy the stored results of one folder or several, without checkpoints and logs.

    Only what the suites' last runs consist of is copied; results in the target that they do not have go. Of a
    dataset, policy and condition that several folders have, the first one's finished result is taken.

    Args:
        sources: Folders of results.
        target: Where to.
        only: Names of the suites to copy; None copies all.

    Raises:
        FileNotFoundError: If a source has no results.
        ValueError: If a source and the target are the same folder, no suite is left, or the target has other
            files where results are written.
    """
    if target.resolve() in [source.resolve() for source in sources]:
        raise ValueError(f"publish={str(target)!r}: is the folder of the results itself; choose another one")
    _refuse_foreign(target)
    manifests: dict[str, dict[str, Any]] = {}
    origin: dict[str, Path] = {}
    for source in sources:
        for name, suite in load_suites(source).items():
            if only is None or name in only:
                manifest = json.loads((source / "suites" / f"{name}.json").read_text())
                origin = {**{file: source / "results" / file for file in suite.files}, **origin}
                manifests[name] = (
                    _merged(manifests[name], manifest, origin) if name in manifests else manifest
                )
    if not manifests:
        raise ValueError(f"suites={list(only or [])}: none of them is in {', '.join(map(str, sources))}")
    for folder in ("results", "suites"):
        shutil.rmtree(target / folder, ignore_errors=True)
        (target / folder).mkdir(parents=True)
    for name, manifest in manifests.items():
        write_whole(target / "suites" / f"{name}.json", json.dumps(manifest, indent=1) + "\n")
        for file in (*manifest["datasets"].values(), *manifest["cells"]):
            if file in origin:  # others are not finished
                shutil.copy(origin[file], target / "results")


def _refuse_foreign(target: Path) -> None:
    """Refuse to replace what is no published result."""
    there = [*target.glob("results/*"), *target.glob("suites/*")]
    others = [file for file in there if file.suffix != ".json" or not file.is_file()]
    if not others and any(target.glob("suites/*.json")):
        return
    for file in others or there:
        raise ValueError(
            f"publish={str(target)!r}: {str(file)!r} is no published result and would be deleted; choose "
            "another folder"
        )


def _merged(first: dict[str, Any], second: dict[str, Any], finished: Mapping[str, Path]) -> dict[str, Any]:
    """A suite's manifest from two folders' ones.

    Args:
        first: A manifest, whose finished cells are kept.
        second: Another one.
        finished: Where the files of both are that there are.

    Raises:
        ValueError: If both have different datasets of one name.
    """

    def stored(file: str) -> dict[str, Any]:
        return json.loads(finished[file].read_text())

    for name in first["datasets"].keys() & second["datasets"].keys():
        one, other = (stored(manifest["datasets"][name])["result"] for manifest in (first, second))
        if any(one[key] != other[key] for key in ("behavior", "length", "steps_to_end")):
            raise ValueError(
                f"the folders hold results on different datasets called {name!r}; publish them apart"
            )

    def what(file: str) -> str:
        """Kind, dataset, policy and condition, without the cell's key."""
        return file.rpartition("-")[0]

    there = {what(file) for file in first["cells"] if file in finished}
    instead = [file for file in second["cells"] if what(file) not in there]
    # An evaluation comes with the training that it needs.
    needed = {stored(file)["needs"] for file in instead if file in finished}
    instead += [f for f in second["cells"] if f.removesuffix(".json").rpartition("-")[2] in needed]
    kept = [f for f in first["cells"] if f in finished or what(f) not in map(what, instead)]
    return {
        **first,
        "command": "\n".join(dict.fromkeys([*first["command"].split("\n"), second["command"]])),
        "datasets": {**first["datasets"], **second["datasets"], **first["datasets"]},
        "cells": list(dict.fromkeys([*kept, *instead])),
    }


def readme_block(root: Path) -> str:
    """The README's results, in Markdown.

    Args:
        root: Published results with the suite ``table1``.

    Raises:
        ValueError: If that suite is not there.
    """
    suites = load_suites(root)
    if "table1" not in suites:
        raise ValueError(f"{str(root)!r} has no results of the suite table1")
    suite = suites["table1"]
    header = (
        "dataset",
        "policy",
        "steps",
        "seeds × n",
        "L1 stratified",
        "L1 uniform (floor)",
        "success",
        "style fidelity",
        "the paper's L1, success",
    )
    cells = [cell for name in suite.datasets for cell in suite.evaluations(name)]
    rows = [_readme_row(cell) for cell in cells if cell.labels.condition == UNPERTURBED]
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def update_readme(readme: Path, root: Path) -> None:
    """Replace what is between the README's markers, and draw its picture beside the published results.

    Raises:
        ValueError: If the file has no markers.
    """
    write_whole(readme, with_block(readme.read_text(encoding="utf-8"), readme_block(root), readme))
    suite = load_suites(root)["table1"]
    for dataset, policy in PICTURED:
        pictured = [cell for cell in suite.evaluations(dataset) if cell.policy == policy]
        if pictured:
            figures.plot_result(root / PICTURE, suite.datasets[dataset], pictured[0])
            return


def with_block(text: str, block: str, readme: Path) -> str:
    """A text with the block between its markers."""
    before, start, rest = text.partition(START)
    _, end, after = rest.partition(END)
    if not start or not end:
        raise ValueError(f"readme={str(readme)!r}: expected the lines {START!r} and {END!r} in it")
    return f"{before}{START}\n\n{block}\n\n{END}{after}"


def _readme_row(cell: StoredCell) -> tuple[str, ...]:
    uniform, stratified = cell.summaries["uniform"], cell.summaries.get("stratified")
    success, fidelity = cell.best.success, cell.best.fidelity
    assert cell.training is not None
    return (
        cell.labels.dataset.removeprefix("medium_maze-").removeprefix("d3il_"),
        cell.labels.policy,
        f"{cell.training['steps']:,}",
        cell_texts.rollouts(uniform),
        cell_texts.NOTHING if stratified is None else cell_texts.l1(stratified).replace("\n", " "),
        f"{uniform.l1:.3f} ({cell_texts.floor(uniform)})".replace("\n", " "),
        f"{success.mean:.3f} {success.interval:.3f}",
        cell_texts.NOTHING if fidelity is None else f"{fidelity.mean:.3f}",
        cell_texts.quoted(paper.table1(cell.labels.dataset, cell.policy)).replace("\n", " "),
    )
