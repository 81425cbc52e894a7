"""Tables of the suites ``table1``, ``control`` and ``sweep``, from summaries."""

from collections.abc import Callable, Sequence

import numpy as np

from lerobot_swr.evaluation.checks.length import BIN_WIDTH, TOLERANCE
from lerobot_swr.evaluation.report import Table
from lerobot_swr.reproduction import paper
from lerobot_swr.reproduction.cell_texts import (
    INTERVALS,
    NOTHING,
    SCENES,
    deviating,
    floor,
    l1,
    named,
    quoted,
    rollouts,
    share,
    steps,
)
from lerobot_swr.reproduction.stored_results import StoredCell, SuiteResults
from lerobot_swr.reproduction.suites import LENGTH_BAND, ONE_SCENE, UNPERTURBED
from lerobot_swr.reproduction.summary import Summary, length_control


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
