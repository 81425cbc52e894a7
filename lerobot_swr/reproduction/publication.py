"""Published results: the small files alone, and the README's table made from them."""

import shutil
from pathlib import Path

from lerobot_swr.reproduction import figures, paper, tables
from lerobot_swr.reproduction.cells import write_text
from lerobot_swr.reproduction.stored_results import StoredCell, load_suites
from lerobot_swr.reproduction.suites import UNPERTURBED

START, END = "<!-- results: written by lerobot-swr-report -->", "<!-- end of results -->"
PICTURE = "result.png"
PICTURED = (("d3il_human_avoiding", "zbc"), ("medium_maze-only_forward", "wzbc"))
"""Dataset and policy of README's picture; the first one whose results are there."""


def publish(source: Path, target: Path) -> None:
    """Copy the stored results, without checkpoints and logs.

    Only what the suites' last runs consist of is copied; results in the target that they do not have go.

    Raises:
        FileNotFoundError: If the source has no results.
        ValueError: If source and target are the same folder.
    """
    if source.resolve() == target.resolve():
        raise ValueError(f"publish={str(target)!r}: is the folder of the results itself; choose another one")
    suites = load_suites(source)
    for folder in ("results", "suites"):
        shutil.rmtree(target / folder, ignore_errors=True)
        (target / folder).mkdir(parents=True)
    for suite in suites.values():
        shutil.copy(source / "suites" / f"{suite.name}.json", target / "suites")
        for file in suite.files:
            shutil.copy(source / "results" / file, target / "results")


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
    write_text(readme, with_block(readme.read_text(encoding="utf-8"), readme_block(root), readme))
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
        tables.rollouts(uniform),
        tables.NOTHING if stratified is None else tables.l1(stratified).replace("\n", " "),
        f"{uniform.l1:.3f} ({tables.floor(uniform)})".replace("\n", " "),
        f"{success.mean:.3f} {tables.bracket(success.interval)}",
        tables.NOTHING if fidelity is None else f"{fidelity.mean:.3f}",
        tables.quoted(paper.table1(cell.labels.dataset, cell.policy)).replace("\n", " "),
    )
