"""The report and the published results, from stored results alone."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from lerobot_swr.cli.report import main as report_command
from lerobot_swr.evaluation.behavior_evaluation import path_of
from lerobot_swr.reproduction.cells import Cell, Store, write_text
from lerobot_swr.reproduction.demonstrations import (
    environment,
    load_low_dimensional,
    prepare,
    short_path,
)
from lerobot_swr.reproduction.execution import run_cells
from lerobot_swr.reproduction.publication import END, START, publish, readme_block, update_readme, with_block
from lerobot_swr.reproduction.report import write_results_report
from lerobot_swr.reproduction.settings import ReproductionSettings
from lerobot_swr.reproduction.stored_results import load_suites
from lerobot_swr.reproduction.suites import suite_cells
from lerobot_swr.trajectories import Trajectories

REPOSITORY = Path(__file__).parent.parent


def invented_result(one: Cell, lengths: list[int], behaviors: list[str], paths: list) -> dict:
    """What a perfect reproducer would store: each rollout is the demonstration of its style."""
    rollouts = {}
    assert one.needs is not None
    for seed in one.needs.definition["seeds"]:
        rollouts[str(seed)] = {}
        for protocol, count in one.definition["protocols"].items():
            styles = [i % len(behaviors) for i in range(count)]
            styled = "style_sampling" in one.needs.definition["config"]
            rollouts[str(seed)][protocol] = {
                "behavior": [behaviors[i] for i in styles],
                "success": [1] * count,
                "length": [lengths[i] - 3 for i in styles],
                "style": styles if styled else [None] * count,
                "match": [1 if styled else None] * count,
            }
    drawn = [paths[i % len(paths)] for i in range(count)] if one.definition["paths"] else []
    return {"rollouts": rollouts, "allowed": None, "paths": drawn}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, small_maze) -> Iterator[Path]:
    """All suites on the small maze, as if perfect reproducers had been trained, and their report."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        root = tmp_path_factory.mktemp("reproduction") / "finished"
        _finish(root, small_maze, monkeypatch)
        write_results_report(root)
        yield root


@pytest.fixture
def finished(drawn, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(drawn, tmp_path / "finished"))


def keep_only(suite: str, root: Path) -> None:
    """Forget the other suites, so that drawing takes less time."""
    for manifest in (root / "suites").iterdir():
        if manifest.stem != suite:
            manifest.unlink()


def _finish(root: Path, small_maze: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(root)
    demos = prepare(small_maze.name, small_maze.parent, store)
    settings = ReproductionSettings(seeds=2, n_rollouts=12, sweep_seeds=1, output_dir=store.root)
    trajectories: Trajectories = load_low_dimensional(small_maze)
    env_cfg = environment(demos.env)
    behaviors = [env_cfg.behavior_rule()(episode) for episode in trajectories.episodes()]
    lengths = trajectories.lengths.tolist()
    for module in ("suites", "tables", "figures"):
        monkeypatch.setattr(f"lerobot_swr.reproduction.{module}.LENGTH_BAND", (min(lengths), max(lengths)))
    paths = [short_path(path_of(env_cfg, episode)) for episode in trajectories.episodes()]
    for suite in ("table1", "robustness", "control", "figures"):
        cells = suite_cells(suite, settings, [demos])
        for one in cells:
            if one.kind == "similarity":
                assert run_cells([one], store, {demos.name: demos}, jobs=1) == []
            elif one.kind == "styles":
                store.write(one, {"points": [[i, i] for i in range(6)], "neighbour_agreement": [1.0]}, 1.0)
            else:
                invented = {} if one.kind == "train" else invented_result(one, lengths, behaviors, paths)
                store.write(one, invented, 1.0)
        manifest = {
            "suite": suite,
            "command": f"lerobot-swr-reproduce --suite={suite}",
            "datasets": {demos.name: store.result_path(demos.cell).name},
            "cells": [store.result_path(one).name for one in cells],
        }
        write_text(store.root / "suites" / f"{suite}.json", json.dumps(manifest))


def test_the_report_shows_every_suite_and_needs_no_other_file(drawn):
    """Tables, captioned pictures inside the page, commands and versions."""
    page = (drawn / "report.html").read_text()
    for heading in ("Diversity", "Robustness", "Control", "Similarity and styles", "How this was made"):
        assert f"<h2>{heading}" in page
    assert "Not finished" not in page
    assert page.count("<figcaption>") == page.count('<img src="data:image/png;base64,') >= 8
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    for suite in load_suites(drawn):
        assert f"lerobot-swr-reproduce --suite={suite}" in page
    assert "lerobot 0.6" in page


def test_drawing_again_changes_nothing(drawn):
    """The same stored results give the same files, byte for byte."""

    def files() -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in drawn.rglob("*") if path.is_file()}

    before = files()
    write_results_report(drawn)
    assert files() == before


def test_the_report_says_what_is_missing(finished):
    """Cells without a result are named, the rest is drawn."""
    [lost] = (finished / "results").glob("evaluate-small_maze-zbc-random_start-*")
    lost.unlink()
    keep_only("robustness", finished)
    page = write_results_report(finished).read_text()
    assert "Not finished: robustness" in page
    assert lost.name in page


def test_summaries_hold_the_numbers_of_the_tables(drawn):
    """A perfect reproducer's stratified L1 is 0 in the file for other programs, too."""
    rows = json.loads((drawn / "summaries.json").read_text())
    stratified = [row for row in rows if row["protocol"] == "stratified" and row["policy"] == "zbc"]
    assert stratified
    assert all(row["l1"] == 0 and row["success"]["mean"] == 1 for row in stratified)
    assert {row["condition"] for row in stratified} >= {"deterministic", "random start", "noise 2"}


def test_published_results_give_the_same_report_without_checkpoints(finished, tmp_path):
    """Copied, the small files are enough; what an earlier publication left there goes."""
    (finished / "work" / "big").write_text("checkpoint")
    target = tmp_path / "published"
    keep_only("table1", finished)
    write_results_report(finished)
    write_text(target / "results" / "stale.json", "{}")
    publish(finished, target)
    assert not (target / "work").exists()
    assert not (target / "results" / "stale.json").exists()
    pages = [
        write_results_report(root).read_text().split("How this was made")[0] for root in (finished, target)
    ]
    assert pages[0] == pages[1]


def test_results_are_not_published_over_themselves(finished):
    """Publishing replaces the target's results, so the source is refused as the target."""
    with pytest.raises(ValueError, match=r"is the folder of the results itself"):
        publish(finished, finished / ".." / finished.name)
    assert list((finished / "results").iterdir())


def test_the_readme_block_is_filled(finished, tmp_path):
    """Between the markers stands the table, everything else is kept; a second time changes nothing."""
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{START}\nold\n{END}\nafter\n")
    update_readme(readme, finished)
    text = readme.read_text()
    assert text == f"before\n{START}\n\n{readme_block(finished)}\n\n{END}\nafter\n"
    assert "| small_maze | wzbc | 100,000 | 2 × 12 | 0.000 |" in text
    update_readme(readme, finished)
    assert readme.read_text() == text


def test_a_readme_without_markers_is_refused(finished, tmp_path):
    """The message says what is expected."""
    with pytest.raises(ValueError, match=r"expected the lines '<!-- results"):
        with_block("no markers", "table", tmp_path / "README.md")


def test_the_readme_shows_the_published_results():
    """README's block is what the stored results give: neither stands without the other."""
    published = REPOSITORY / "docs" / "results" / "maze"
    text = (REPOSITORY / "README.md").read_text()
    assert (START in text) == published.is_dir()
    if published.is_dir():
        assert with_block(text, readme_block(published), REPOSITORY / "README.md") == text


def test_an_empty_folder_is_named(tmp_path, run_command, capsys):
    """One line, and a status other than 0."""
    with pytest.raises(SystemExit):
        run_command(report_command, tmp_path)
    assert "no suites/*.json there; run lerobot-swr-reproduce first" in capsys.readouterr().err
