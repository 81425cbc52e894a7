"""Tables of the report, from summaries."""

from collections.abc import Callable, Sequence

import numpy as np

from lerobot_swr.evaluation.length_control import BIN_WIDTH, TOLERANCE
from lerobot_swr.evaluation.report import Table
from lerobot_swr.reproduction import paper
from lerobot_swr.reproduction.stored_results import StoredCell, SuiteResults
from lerobot_swr.reproduction.suites import CONDITIONS, LENGTH_BAND, ONE_SCENE, UNPERTURBED
from lerobot_swr.reproduction.summary import Rate, Summary, difference_interval, length_control

NOTHING = "–"

INTERVALS = (
    "L1: mean over seeds [95 % bootstrap interval over seeds and rollouts; stratified: over seeds]. Floor: "
    "what perfect reproducers "
    "would score as the mean over as many seeds [central 95 %]; * L1 uniform lies outside of it. "
    "Success and style fidelity: over all rollouts [Wilson 95 %], lowest to highest seed in parentheses."
)


SCENES = (
    f"{ONE_SCENE}: all rollouts of a training seed start with box and target in one place, another one for "
    "each seed; otherwise every rollout has places of its own. A policy without styles or noise then repeats "
    "one rollout, and its interval of success says nothing. The paper does not say which it does; its BC, "
    "which succeeds in all rollouts of one seed and in almost none of the others, fits one scene."
)
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


def quoted(figures: paper.Quoted | None) -> str:
    """The paper's L1 and success, or a dash."""
    if figures is None:
        return NOTHING
    return f"{deviating(figures.l1)},\n{deviating(figures.success)}"


def deviating(figure: paper.Deviating) -> str:
    """Mean and standard deviation over training seeds."""
    return f"{figure[0]:.3f} ± {figure[1]:.3f}"


def share(rate: Rate | None) -> str:
    """A share with its interval and the range over seeds."""
    if rate is None:
        return NOTHING
    seeds = f"({min(rate.by_seed):.2f} to {max(rate.by_seed):.2f})"
    return f"{rate.mean:.3f}\n{rate.interval:.3f}\n{seeds}"


def l1(summary: Summary | None) -> str:
    """L1 with its interval; a star if styles were drawn uniformly and it lies outside the floor's band."""
    if summary is None:
        return NOTHING
    inside = summary.floor.band.low <= summary.l1 <= summary.floor.band.high
    star = "" if inside or summary.protocol != "uniform" else " *"
    return f"{summary.l1:.3f}{star}\n{summary.l1_interval:.3f}"


def floor(summary: Summary | None) -> str:
    """The floor with its band."""
    return NOTHING if summary is None else f"{summary.floor.mean:.3f}\n{summary.floor.band:.3f}"


def steps(cell: StoredCell) -> str:
    """Training steps and batch size."""
    return NOTHING if cell.training is None else f"{cell.training['steps']:,} × {cell.training['batch_size']}"


def rollouts(summary: Summary) -> str:
    """Seeds and rollouts."""
    return f"{summary.n_seeds} × {summary.n_rollouts}"


def table1(suite: SuiteResults, dataset: str) -> Table:
    """Diversity on one dataset: the paper's Table 1."""
    rows = []
    for cell in suite.evaluations(dataset):
        uniform, stratified = cell.summaries["uniform"], cell.summaries.get("stratified")
        rows.append(
            (
                named(cell),
                steps(cell),
                rollouts(uniform),
                l1(uniform),
                floor(uniform),
                l1(stratified),
                NOTHING if stratified is None else f"{stratified.floor.mean:.3f}",
                share(cell.best.success),
                quoted(paper.table1(dataset, cell.policy)),
                share(cell.best.fidelity),
                f"{cell.best.coverage:.3f}",
            )
        )
    header = (
        "policy",
        "steps × batch",
        "seeds × n",
        "L1 uniform",
        "floor",
        "L1 stratified",
        "its floor",
        "success",
        "paper's L1,\nsuccess",
        "style fidelity",
        "coverage",
    )
    description = suite.datasets[dataset]
    caption = (
        f"{dataset}: {len(description.result['behavior'])} demonstrations, {len(description.histogram)} "
        f"behaviours. {INTERVALS} Success, fidelity and coverage are those of the stratified rollouts, where "
        "the policy has styles."
    )
    if any(cell.labels.condition == ONE_SCENE for cell in suite.evaluations(dataset)):
        caption += f" {SCENES}"
    return Table(caption, header, rows)


def named(cell: StoredCell) -> str:
    """A policy's name, and the condition where it is not the usual one."""
    usual = cell.labels.condition == UNPERTURBED
    return cell.labels.policy if usual else f"{cell.labels.policy},\n{cell.labels.condition}"


def whole_table1(suite: SuiteResults) -> list[Table]:
    """The paper's Table 1 as it stands there, ours and the paper's figures one above the other."""
    return [
        _whole(suite, "L1 of the behaviour histograms", lambda s: s.l1_by_seed, lambda quoted: quoted.l1),
        _whole(suite, "Success", lambda s: s.success.by_seed, lambda quoted: quoted.success),
    ]


def _whole(
    suite: SuiteResults,
    what: str,
    by_seed: Callable[[Summary], list[float]],
    theirs: Callable[[paper.Quoted], paper.Deviating],
) -> Table:
    rows = []
    for dataset in suite.datasets:
        # Policies with their usual options alone.
        cells = {(c.labels.condition, c.labels.policy): c for c in suite.evaluations(dataset)}
        for condition in dict.fromkeys(condition for condition, _ in cells):
            row = [dataset if condition == UNPERTURBED else f"{dataset},\n{condition}"]
            for policy in paper.POLICIES:
                cell, quoted = cells.get((condition, policy)), paper.table1(dataset, policy)
                ours = NOTHING
                if cell is not None:
                    values = by_seed(cell.summaries["uniform"])
                    ours = deviating((float(np.mean(values)), float(np.std(values))))
                row.append(f"{ours}\n{NOTHING if quoted is None else deviating(theirs(quoted))}")
            rows.append(tuple(row))
    caption = (
        f"{what}, styles drawn uniformly: ours, and below it the paper's; mean ± standard deviation over "
        "training seeds (of those that were trained, as the paper's are). Only the 96 human "
        "recordings of avoiding are data that both have; the unbalanced selection of them is ours."
    )
    if any(cell.labels.condition == ONE_SCENE for cell in suite.cells):
        caption += f" {SCENES}"
    return Table(caption, ("dataset", *paper.POLICIES), rows)


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


def control(suite: SuiteResults, dataset: str) -> Table:
    """Control of the episode length."""
    rows = []
    description = suite.datasets[dataset].result
    for cell in suite.evaluations(dataset):
        found, summary = length_control(cell.result, description, LENGTH_BAND), cell.summaries["uniform"]
        rows.append(
            (
                cell.labels.policy,
                "controlled" if cell.labels.condition == "controlled" else "free",
                rollouts(summary),
                f"{found.l1:.3f}\n{found.l1_interval:.3f}\n"
                f"({min(found.l1_by_seed):.3f} to {max(found.l1_by_seed):.3f})",
                f"{found.floor.mean:.3f}\n{found.floor.band:.3f}",
                share(found.in_band),
                share(summary.success),
            )
        )
    low, high = LENGTH_BAND
    n = sum(low <= length <= high for length in description["length"])
    caption = (
        f"{dataset}: lengths of rollouts against those of the {n} demonstrations of {low} to {high} frames; "
        f"bins of {BIN_WIDTH} steps, styles drawn uniformly. Controlled: only styles of demonstrations in "
        f"the band. L1: mean over seeds [95 % bootstrap interval over seeds and rollouts], lowest to highest "
        "seed in parentheses. Floor: what perfect reproducers of those demonstrations would score as the "
        f"mean over as many seeds [central 95 %]. In band: rollouts within it, ± {TOLERANCE} steps [Wilson "
        "95 %]. "
        f"{description['frames_after_end']} frames, which demonstrations record after the environment would "
        "have ended them, are added to the rollouts' lengths. The paper shows this as a figure, without "
        "numbers."
    )
    header = (
        "policy",
        "styles",
        "seeds × n",
        "L1",
        "floor",
        "in band",
        "success",
    )
    return Table(caption, header, rows)


def sweep(cells: Sequence[StoredCell]) -> Table:
    """Effect of beta and p."""
    rows = []
    for cell in cells:
        assert cell.training is not None
        options = cell.training["config"]
        rows.append(
            (
                f"{options['beta']:g}",
                f"{options['p']:g}",
                steps(cell),
                rollouts(cell.best),
                l1(cell.summaries["uniform"]),
                floor(cell.summaries["uniform"]),
                l1(cell.summaries["stratified"]),
                share(cell.best.success),
                share(cell.best.fidelity),
            )
        )
    header = (
        "β",
        "p",
        "steps × batch",
        "seeds × n",
        "L1 uniform",
        "floor",
        "L1 stratified",
        "success",
        "style fidelity",
    )
    return Table(f"{cells[0].labels.dataset}: WZBC with other β and p. {INTERVALS}", header, rows)
