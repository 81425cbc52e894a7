"""Tables of the suite ``robustness``: the paper's Table 2, WZBC beside ZBC, and who teaches a style."""

from lerobot_swr.evaluation.report import Table
from lerobot_swr.reproduction import paper
from lerobot_swr.reproduction.cell_texts import INTERVALS, NOTHING, floor, l1, quoted, rollouts, share
from lerobot_swr.reproduction.stored_results import StoredCell, SuiteResults
from lerobot_swr.reproduction.suites import CONDITIONS
from lerobot_swr.reproduction.summary import difference_interval

PERTURBATIONS = {
    "maze2d": (
        "pseudo-random start, start radius: uniform in a square of that half-width (pseudo-random: 0.10) "
        "around the start, as a share of the side; random start: anywhere; noise: on every step, standard "
        "deviation in largest steps of 0.02 of the side (transition noise: 1); sticky walls: an agent that "
        "hits a wall stays where it was."
    ),
    "d3il": (
        "start: the tool starts anywhere in a square of that half-width; action noise: standard deviation on "
        "each coordinate of every action; box pushed: once per episode, by that much where it stands free. "
        "Without perturbation the start of the tool is that of the task."
    ),
}
"""By type of the environment."""


def robustness(suite: SuiteResults, dataset: str) -> Table:
    """Perturbed starts and transitions: the paper's Table 2."""
    rows: list[tuple[str, ...]] = []
    in_maze = suite.datasets[dataset].env["type"] == "maze2d"
    found = dict.fromkeys(cell.labels.condition for cell in suite.evaluations(dataset))
    for condition in CONDITIONS if in_maze else found:
        for cell in suite.evaluations(dataset):
            if cell.labels.condition == condition:
                summary, uniform = cell.best, cell.summaries.get("uniform")
                styled = "stratified" in cell.summaries
                rows.append(
                    (
                        condition,
                        cell.labels.policy,
                        rollouts(summary),
                        share(summary.success),
                        share(summary.fidelity),
                        l1(summary) if styled else NOTHING,
                        l1(uniform),
                        floor(uniform),
                        quoted(paper.TABLE2.get((dataset, condition, cell.policy))),
                    )
                )
    header = (
        "condition",
        "policy",
        "seeds × n",
        "success",
        "style match",
        "L1 stratified",
        "L1 uniform",
        "floor",
        "paper's L1,\nsuccess",
    )
    explained = PERTURBATIONS.get(suite.datasets[dataset].env["type"], "")
    caption = (
        f"{dataset}. {explained} {INTERVALS} Style match: rollouts with the behaviour of the demonstration "
        "whose style they use. "
    )
    if in_maze:
        caption += (
            "Of its doors those ahead of the start count; L1 counts all doors, so it cannot be small from "
            "random starts. "
        )
    caption += "The paper's figures, if any, are of its own maze and perturbations."
    return Table(caption, header, rows)


def robustness_differences(suite: SuiteResults, dataset: str) -> Table:
    """Every WZBC against ZBC under the same starts and noise."""
    evaluations = suite.evaluations(dataset)
    cells = {(c.labels.policy, c.labels.condition): c for c in evaluations}
    references = {c.labels.condition: c for c in evaluations if c.policy == "zbc"}
    policies = [name for name in dict.fromkeys(name for name, _ in cells) if name.startswith("wzbc")]
    rows = []
    for condition in dict.fromkeys(condition for _, condition in cells):
        reference = references.get(condition)
        if reference is not None:
            pairs = [(cells.get((policy, condition)), reference) for policy in policies]
            rows.append((condition, *(_difference(*pair, column) for column in (0, 1) for pair in pairs)))
    caption = (
        f"{dataset}: WZBC minus ZBC, each style once [95 % bootstrap interval over seeds and rollouts; "
        "* it leaves out 0]."
    )
    header = (
        "condition",
        *(f"{what}\n{policy}" for what in ("success", "style match") for policy in policies),
    )
    return Table(caption, header, rows)


def _difference(cell: StoredCell | None, reference: StoredCell, column: int) -> str:
    if cell is None:
        return NOTHING
    first, second = ([outcomes[:, column] for outcomes in c.best.outcomes] for c in (cell, reference))
    mean, interval = difference_interval(first, second)
    clear = interval.low > 0 or interval.high < 0
    mean = round(mean, 3) + 0.0  # no -0.000
    return f"{mean:+.3f}{' *' if clear else '  '}\n{interval:.3f}"


def teaching(cell: StoredCell) -> Table:
    """Who teaches a style, for each beta and p."""
    same, other = cell.result["nu_same"], cell.result["nu_other"]
    rows = [
        (
            f"{row['beta']:g}",
            f"{row['p']:g}",
            f"{row['own']:.3f}",
            f"{row['same']:.3f}",
            f"{row['other']:.3f}",
        )
        for row in cell.result["shares"]
    ]
    caption = (
        f"{cell.labels.dataset}: who teaches a style, as shares of its total weight in algorithm 1's "
        f"expected loss, mean over styles. ν of pairs with the same behaviour: 10 %, 50 %, 90 % quantiles "
        f"{', '.join(f'{v:.2f}' for v in same)}; with another: {', '.join(f'{v:.2f}' for v in other)}."
    )
    header = ("β", "p", "own demonstration", "others, same behaviour", "other behaviours")
    return Table(caption, header, rows)
