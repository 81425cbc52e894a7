"""Tables of the suite ``contracting``: a row per condition, a column per method."""

from collections.abc import Callable
from dataclasses import replace

from lerobot_swr.evaluation.report import Table
from lerobot_swr.reproduction.cell_texts import INTERVALS, NOTHING, floor, l1, rollouts, share, steps
from lerobot_swr.reproduction.robustness_tables import PERTURBATIONS
from lerobot_swr.reproduction.stored_results import StoredCell, SuiteResults
from lerobot_swr.reproduction.suites import UNPERTURBED
from lerobot_swr.reproduction.summary import Summary


def length_error(summary: Summary) -> str:
    """The median length error with its interval."""
    if summary.length_error is None or summary.length_error_interval is None:
        return NOTHING
    return f"{summary.length_error:.1f}\n{summary.length_error_interval:.1f}"


def unperturbed(suite: SuiteResults, dataset: str) -> Table:
    """Diversity of every method in the environment as it is."""
    rows = []
    for cell in suite.evaluations(dataset):
        if cell.labels.condition == UNPERTURBED:
            uniform, stratified = cell.summaries["uniform"], cell.best
            rows.append(
                (
                    cell.labels.policy,
                    steps(cell),
                    rollouts(stratified),
                    l1(uniform),
                    floor(uniform),
                    l1(stratified),
                    f"{stratified.floor.mean:.3f}",
                    share(stratified.success),
                    share(stratified.fidelity),
                    length_error(stratified),
                )
            )
    header = (
        "method",
        "steps × batch",
        "seeds × n",
        "L1 uniform",
        "floor",
        "L1 stratified",
        "its floor",
        "success",
        "style match",
        "length error",
    )
    caption = (
        f"{dataset}, without perturbation. {INTERVALS} Each style equally often, except for L1 uniform "
        "and its floor. Length error: median difference of a rollout's length to its demonstration's "
        "in steps, over successful rollouts with the demonstrated behaviour [95 % bootstrap interval]. "
        "What the paper has of this is quoted with the suites table1 and robustness."
    )
    return Table(caption, header, rows)


def by_condition(suite: SuiteResults, dataset: str) -> list[Table]:
    """Success, style match and length error of every method under every condition."""
    wilson = "over all seeds' rollouts [Wilson 95 %], lowest to highest seed in parentheses"
    measures: dict[str, Callable[[Summary], str]] = {
        f"success {wilson}": lambda s: share(s.success),
        f"style match (rollouts with the behaviour of the demonstration whose style they use) {wilson}": (
            lambda s: share(s.fidelity)
        ),
        "median length error in steps, over successful rollouts with the demonstrated behaviour [95 % "
        "bootstrap interval]; a dash where there are none": length_error,
    }
    tables = [_table(suite, dataset, what, show) for what, show in measures.items()]
    explained = PERTURBATIONS.get(suite.datasets[dataset].env["type"], "")
    return [replace(tables[0], caption=f"{tables[0].caption} {explained}".strip()), *tables[1:]]


def _table(suite: SuiteResults, dataset: str, what: str, show: Callable[[Summary], str]) -> Table:
    cells = {(c.labels.condition, c.labels.policy): c for c in suite.evaluations(dataset)}
    conditions = dict.fromkeys(condition for condition, _ in cells)
    methods = dict.fromkeys(method for _, method in cells)
    rows = [
        (condition, *(_shown(cells.get((condition, method)), show) for method in methods))
        for condition in conditions
    ]
    first = {method: next(c for (_, m), c in cells.items() if m == method) for method in methods}
    header = (
        "condition\nseeds × n",
        *(f"{method.replace(' ', chr(10), 1)}\n{rollouts(c.best)}" for method, c in first.items()),
    )
    caption = f"{dataset}: {what}. Each style equally often."
    return Table(caption, _aligned(header), rows)


def _aligned(header: tuple[str, ...]) -> tuple[str, ...]:
    """Heads of the same number of lines, the last ones beside each other."""
    lines = max(text.count("\n") for text in header)
    return tuple(
        text.replace("\n", "\n" * (1 + lines - text.count("\n")), 1) if text.count("\n") < lines else text
        for text in header
    )


def _shown(cell: StoredCell | None, show: Callable[[Summary], str]) -> str:
    return NOTHING if cell is None else show(cell.best)
