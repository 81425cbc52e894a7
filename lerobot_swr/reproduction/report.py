"""The report: a results section drawn from the stored cells, without computing any of them again."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_swr.evaluation.report import Picture, Section, write_markdown, write_report
from lerobot_swr.reproduction import (
    cell_texts,
    contracting_tables,
    figures,
    robustness_tables,
    scene_tables,
    tables,
)
from lerobot_swr.reproduction.paper import SOURCE
from lerobot_swr.reproduction.perturbation_curves import plot_perturbations
from lerobot_swr.reproduction.stored_results import StoredCell, SuiteResults, load_suites
from lerobot_swr.reproduction.suites import UNPERTURBED
from lerobot_swr.whole_files import write_whole

INTRODUCTION = (
    f"Experiments of {SOURCE}, repeated with the policies and environments of lerobot_swr. The mazes, the "
    "scripted demonstrators and the sizes of the perturbations are this package's own, so the paper's "
    "numbers beside ours tell the order of magnitude and nothing more, except on the benchmark's human "
    "recordings; a dash stands where we have none to quote. L1 is the distance of the behaviour histograms "
    "of rollouts and demonstrations, 0 (equal) to 2 (disjoint); failed rollouts are behaviours of their own. "
    "Drawing styles uniformly (the paper's protocol), even a perfect reproducer scores the floor; with each "
    "style used once (stratified) its L1 is 0."
)


def write_results_report(root: Path) -> Path:
    """Write ``report.html``, ``report.md``, their pictures and ``summaries.json`` from the stored results.

    Args:
        root: Folder with ``suites/`` and ``results/``.

    Returns:
        The HTML file.

    Raises:
        FileNotFoundError: If the folder has no results.
    """
    suites = load_suites(root)
    pictures = root / "figures"
    build = {
        "table1": _diversity,
        "robustness": _robustness,
        "contracting": _contracting,
        "control": _control,
        "scenes": _scenes,
        "figures": _figures,
    }
    sections = [
        section
        for name, make in build.items()
        if name in suites
        for section in (*make(suites[name], pictures), *_missing(suites[name]))
    ]
    write_whole(root / "summaries.json", json.dumps(_summaries(suites), indent=1) + "\n")
    report = root / "report.html"
    commands = [suite.command for suite in suites.values() if suite.command]
    content = (
        "Reproducing and controlling the diversity of demonstrations",
        INTRODUCTION,
        sections,
        [*dict.fromkeys(commands), f"lerobot-swr-report {_told(root)}"],
        _versions(suites),
    )
    write_report(report, *content)
    write_markdown(root / "report.md", *content)
    return report


def _told(root: Path) -> Path:
    """A folder as others may call it, too: from here, or by its name alone."""
    here = Path.cwd()
    return root.resolve().relative_to(here) if root.resolve().is_relative_to(here) else Path(root.name)


def _diversity(suite: SuiteResults, pictures: Path) -> Iterator[Section]:
    yield Section("Table 1", tables.whole_table1(suite), [])
    for name, demonstrations in suite.datasets.items():
        cells = suite.evaluations(name)
        if not cells:
            continue
        paths, histograms = pictures / f"paths-{name}.png", pictures / f"histograms-{name}.png"
        usual = [cell for cell in cells if cell.labels.condition == UNPERTURBED]
        figures.plot_paths(paths, demonstrations, usual)
        figures.plot_histograms(histograms, demonstrations, usual)
        yield Section(
            f"Diversity: {name}",
            [tables.table1(suite, name)],
            [
                Picture(
                    "Paths coloured by behaviour: demonstrations, and the rollouts of each policy's first "
                    "training seed (each style once, where the policy has styles).",
                    paths,
                ),
                Picture(
                    "Behaviour histograms: demonstrations, and all seeds' rollouts of each policy (each "
                    "style once, where it has styles).",
                    histograms,
                ),
            ],
            _baseline_note(suite, name),
        )


def _baseline_note(suite: SuiteResults, dataset: str) -> list[str]:
    others = [c for c in suite.evaluations(dataset) if c.policy not in ("bc", "zbc", "wzbc")]
    if not others:
        return []
    names = ", ".join(c.labels.policy for c in others)
    return [
        f"{names}: small networks that a CPU trains, and fewer steps and seeds than ours (see the table). "
        "They show how other kinds of policy behave on these data, not what they could reach."
    ]


def _robustness(suite: SuiteResults, pictures: Path) -> Iterator[Section]:
    for name in suite.datasets:
        cells = suite.evaluations(name)
        if not cells:
            continue
        curves = pictures / f"robustness-{name}.png"
        plot_perturbations(curves, cells, ("success", "style match", "L1 (each style once)"))
        teaching = suite.of_kind("similarity", name)
        yield Section(
            f"Robustness: {name}",
            [
                robustness_tables.robustness(suite, name),
                robustness_tables.robustness_differences(suite, name),
                *map(robustness_tables.teaching, teaching),
            ],
            [
                Picture(
                    f"{name}: success, style match and L1 over the half-width of the starts' square (top) "
                    "and the noise on every step (bottom), each style once; bars: 95 % intervals as in the "
                    "table. "
                    f"{cells[0].best.n_seeds} seeds × {cells[0].best.n_rollouts} rollouts per point.",
                    curves,
                )
            ],
            [_who_teaches(cell) for cell in teaching],
        )


def _contracting(suite: SuiteResults, pictures: Path) -> Iterator[Section]:
    for name in suite.datasets:
        cells = suite.evaluations(name)
        if not cells:
            continue
        curves = pictures / f"contracting-{name}.png"
        measures = ("success", "style match", "median length error (steps)")
        has_curves = plot_perturbations(curves, cells, measures)
        yield Section(
            f"Contracting styles: {name}",
            [contracting_tables.unperturbed(suite, name), *contracting_tables.by_condition(suite, name)],
            [
                Picture(
                    f"{name}: success, style match and length error over the size of each perturbation, each "
                    "style equally often; bars: 95 % intervals as in the tables. "
                    f"{cells[0].best.n_seeds} seeds × {cells[0].best.n_rollouts} rollouts per point.",
                    curves,
                )
            ]
            if has_curves
            else [],
            [
                "Beyond the paper. zbc and wzbc are the paper's; corrective=noise and corrective=demos also "
                "teach every style the way back to its demonstration, from states with noise or, where some "
                "are near, those of other demonstrations (demos); with wzbc, to similar demonstrations, too, "
                "as far as these teach the style. All are trained with the same steps and batches. Playback "
                "with feedback has no policy: it plays the demonstration back that a policy would take its "
                "style from, and corrects deviations as the corrective labels do; it needs the "
                "demonstrations when it acts. Its seeds are those of starts and noise, the same as for the "
                "policies."
            ],
        )


def _who_teaches(cell: StoredCell) -> str:
    paper = cell.result["shares"][0]
    return (
        "How much others teach a style on the demonstrated paths (last table): with "
        f"β = {paper['beta']:g} and p = {paper['p']:g}, its own demonstration carries {paper['own']:.0%} of "
        f"its weight here, others of the same behaviour {paper['same']:.0%}. Beside its own path, others are "
        "all that teaches it, however small their weight: their actions lead along their paths, not back."
    )


def _control(suite: SuiteResults, pictures: Path) -> Iterator[Section]:
    for name, demonstrations in suite.datasets.items():
        cells = suite.evaluations(name)
        drawn = []
        if any(cell.labels.condition == "controlled" for cell in cells):
            picture = pictures / f"control-{name}.png"
            figures.plot_control(picture, demonstrations, cells)
            drawn.append(
                Picture(
                    "Lengths of all demonstrations, of those in the band (green), of free and of controlled "
                    "rollouts of all seeds; right: L1 to the demonstrations in the band, mean (bar) and each "
                    "seed (dots).",
                    picture,
                )
            )
        if cells:
            yield Section(f"Control: {name}", [tables.control(suite, name)], drawn)


def _scenes(suite: SuiteResults, pictures: Path) -> Iterator[Section]:
    for name in suite.datasets:
        if suite.evaluations(name):
            yield Section(f"Scenes: {name}", [scene_tables.scenes(suite, name)], [])


def _figures(suite: SuiteResults, pictures: Path) -> Iterator[Section]:
    for name, demonstrations in suite.datasets.items():
        drawn, shown = [], []
        for cell in suite.of_kind("similarity", name):
            nu, rho = pictures / f"dissimilarity-{name}.png", pictures / f"input_distribution-{name}.png"
            figures.plot_dissimilarity(nu, demonstrations, cell)
            figures.plot_input_distributions(rho, demonstrations, cell)
            drawn += [
                Picture("Dissimilarity ν of all demonstrations to a reference demonstration (red).", nu),
                Picture(
                    "ρ(s̃ | z), eq. 3: which states teach the style of the first of these references, on a "
                    "grid, for several β; colours on a square-root scale up to each panel's maximum.",
                    rho,
                ),
            ]
            shown.append(robustness_tables.teaching(cell))
        maps = suite.of_kind("styles", name)
        if maps:
            picture = pictures / f"styles-{name}.png"
            figures.plot_style_maps(picture, demonstrations, maps)
            seeds = len(maps[0].result["neighbour_agreement"])
            drawn.append(
                Picture(
                    "Styles of the first training seed by behaviour, in the plane of their two main "
                    f"directions. Titles: share of styles whose nearest other style belongs to a "
                    f"demonstration of the same behaviour, mean over {seeds} seeds; by chance "
                    f"{demonstrations.same_by_chance:.2f}.",
                    picture,
                )
            )
        swept = suite.evaluations(name)
        if swept:
            picture = pictures / f"sweep-{name}.png"
            figures.plot_sweep(picture, swept)
            drawn.append(
                Picture(
                    f"Effect of β and p on WZBC, {cell_texts.steps(swept[0])} training steps × batch, "
                    f"{cell_texts.rollouts(swept[0].best)} seeds × rollouts; intervals in the table.",
                    picture,
                )
            )
            shown.append(tables.sweep(swept))
        yield Section(f"Similarity and styles: {name}", shown, drawn)


def _missing(suite: SuiteResults) -> Iterator[Section]:
    if suite.missing:
        text = f"{len(suite.missing)} cells of this suite are not finished: {', '.join(suite.missing)}."
        yield Section(f"Not finished: {suite.name}", [], [], [text])


def _summaries(suites: dict[str, SuiteResults]) -> list[dict[str, Any]]:
    """The figures of every evaluation, for other programs."""
    rows = {}
    for suite in suites.values():
        for cell in suite.cells:
            if cell.kind == "evaluate":
                for protocol, summary in cell.summaries.items():
                    numbers = asdict(summary)
                    del numbers["outcomes"]
                    labels, training = asdict(cell.labels), cell.training
                    rows[cell.key, protocol] = {**labels, "training": training, **numbers}
    return list(rows.values())


def _versions(suites: dict[str, SuiteResults]) -> str:
    cells = {cell.key: cell for suite in suites.values() for cell in suite.cells}
    versions = dict.fromkeys(
        f"{name} {number}" for c in cells.values() for name, number in c.provenance["versions"].items()
    )
    seconds = {True: 0.0, False: 0.0}
    for cell in cells.values():
        seconds[cell.kind == "train"] += cell.provenance["seconds"]
    return (
        f"{', '.join(versions)}. Time of all cells, one thread each, of interrupted ones "
        f"their last attempt: training {seconds[True] / 3600:.2f} h, "
        f"everything else {seconds[False] / 3600:.2f} h."
    )
