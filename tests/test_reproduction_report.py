"""The report and the published results, from stored results alone."""

import json
import re
import shutil
import statistics
from collections.abc import Iterator
from pathlib import Path

import pytest

from lerobot_swr.cli.report import main as report_command
from lerobot_swr.envs.task import task_of
from lerobot_swr.reproduction import contracting_tables
from lerobot_swr.reproduction.cells import Cell, Store
from lerobot_swr.reproduction.demonstrations import (
    environment,
    load_low_dimensional,
    prepare,
    short_path,
)
from lerobot_swr.reproduction.execution import run_cells
from lerobot_swr.reproduction.perturbation_curves import SIZES, short_names
from lerobot_swr.reproduction.publication import END, START, publish, readme_block, update_readme, with_block
from lerobot_swr.reproduction.report import write_results_report
from lerobot_swr.reproduction.settings import SUITES, ReproductionSettings
from lerobot_swr.reproduction.stored_results import load_suites
from lerobot_swr.reproduction.suites import suite_cells
from lerobot_swr.trajectories import Trajectories
from lerobot_swr.whole_files import write_whole

REPOSITORY = Path(__file__).parent.parent


def invented_result(one: Cell, lengths: list[int], behaviors: list[str], paths: list) -> dict:
    """What a perfect reproducer would store: each rollout is the demonstration of its style."""
    rollouts = {}
    acting = (one.needs or one).definition
    for seed in acting["seeds"]:
        rollouts[str(seed)] = {}
        for protocol, count in one.definition["protocols"].items():
            styles = [i % len(behaviors) for i in range(count)]
            styled = "baseline" in acting or "style_sampling" in acting["config"]
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
    task = task_of(environment(demos.env))
    behaviors = [task.behavior_rule()(episode) for episode in trajectories.episodes()]
    lengths = trajectories.lengths.tolist()
    for module in ("suites", "tables", "figures"):
        monkeypatch.setattr(f"lerobot_swr.reproduction.{module}.LENGTH_BAND", (min(lengths), max(lengths)))
    paths = [short_path(task.plot_path(episode)) for episode in trajectories.episodes()]
    for suite in (name for name in SUITES if name != "scenes"):  # the small maze has none
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
        write_whole(store.root / "suites" / f"{suite}.json", json.dumps(manifest))


def test_the_report_shows_every_suite_and_needs_no_other_file(drawn):
    """Tables, captioned pictures inside the page, commands and versions."""
    page = (drawn / "report.html").read_text()
    headings = ("Diversity", "Robustness", "Contracting styles", "Control", "Similarity and styles")
    for heading in (*headings, "How this was made"):
        assert f"<h2>{heading}" in page
    assert "Not finished" not in page
    assert page.count("<figcaption>") == page.count('<img src="data:image/png;base64,') >= 8
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    for suite in load_suites(drawn):
        assert f"lerobot-swr-reproduce --suite={suite}" in page
    assert "lerobot 0.6" in page


def test_contracting_tables_have_a_row_per_condition_and_a_column_per_method(drawn):
    """Success, style match and length error; invented rollouts are 3 steps shorter than their frames."""
    suite = load_suites(drawn)["contracting"]
    *rates, length_errors = contracting_tables.by_condition(suite, "small_maze")
    corrective = ["zbc corrective=noise", "zbc corrective=demos", "wzbc corrective=noise"]
    methods = ["zbc", "wzbc", *corrective, "playback"]
    for table in (*rates, length_errors):
        heads = [" ".join(head.split()) for head in table.header]
        assert heads == ["condition seeds × n", *(f"{method} 2 × 12" for method in methods)]
        conditions = [row[0] for row in table.rows]
        assert conditions[:4] == ["deterministic", "pseudo-random start", "random start", "transition noise"]
        assert conditions[-2:] == ["sticky walls", "sticky walls, noise 1"]
        assert len(conditions) == 4 + 3 + 3 + 2
    for table in rates:  # 24 of 24: Wilson's lower end is 1 / (1 + 1.96² / 24)
        assert all(cell.startswith("1.000\n[0.862, 1.000]") for row in table.rows for cell in row[1:])
    described = suite.datasets["small_maze"].result
    errors = [
        abs(frames - 3 - steps)
        for frames, steps in zip(described["length"], described["steps_to_end"], strict=True)
    ]
    expected = f"{statistics.median(errors):.1f}\n["
    assert all(cell.startswith(expected) for row in length_errors.rows for cell in row[1:])


def test_curves_take_only_what_one_perturbation_changes():
    """Each size belongs to its own curve; sticky walls and random starts to none."""
    radius, noise = SIZES["maze2d"].values()
    maze = {"start": "fixed", "start_radius": 0.1, "transition_noise": 0.0, "sticky_walls": False}
    assert (radius(maze), noise(maze)) == (0.0, 0.0)
    shifted = {**maze, "start": "pseudo_random", "start_radius": 0.2}
    assert (radius(shifted), noise(shifted)) == (0.2, None)
    noisy = {**maze, "transition_noise": 2.0}
    assert (radius(noisy), noise(noisy)) == (None, 2.0)
    for other in ({"start": "random"}, {"sticky_walls": True}):
        assert (radius({**maze, **other}), noise({**maze, **other})) == (None, None)
    arm = {"start_radius": 0.0, "action_noise": 0.004, "box_push": 0.0}
    assert [size(arm) for size in SIZES["d3il"].values()] == [None, 0.004, None]


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
    publish([finished], target)
    write_whole(target / "results" / "stale.json", "{}")
    publish([finished], target)
    assert not (target / "work").exists()
    assert not (target / "results" / "stale.json").exists()
    pages = [
        write_results_report(root).read_text().split("How this was made")[0] for root in (finished, target)
    ]
    assert pages[0] == pages[1]


def test_several_folders_are_published_as_one(finished, tmp_path, run_command):
    """The first folder's finished results win; what it lacks comes from the next one, by what it is."""
    keep_only("table1", finished)
    more, target = tmp_path / "more", tmp_path / "published"
    shutil.copytree(finished, more)
    files = {
        (one.policy, one.kind): f"{one.kind}-small_maze-{one.policy}-{one.labels.condition}-{one.key}.json"
        for one in load_suites(finished)["table1"].cells
    }
    lost, kept = (finished / "results" / files[policy, "evaluate"] for policy in ("zbc", "wzbc"))
    lost.unlink()
    other = {"key": "x" * 12, "needs": "y" * 12}  # in the other folder, its training has another key, too
    (more / "results" / kept.name).write_text(kept.read_text().replace('"success":[1', '"success":[0'))
    evaluated, trained = (more / "results" / files["zbc", kind] for kind in ("evaluate", "train"))
    manifest = more / "suites" / "table1.json"
    for file, key in ((evaluated, other["key"]), (trained, other["needs"])):
        content = {**json.loads(file.read_text()), "key": key}
        content["needs"] = None if file == trained else other["needs"]
        renamed = file.with_name(f"{file.stem[:-12]}{key}.json")
        renamed.write_text(json.dumps(content))
        file.unlink()
        manifest.write_text(manifest.read_text().replace(file.name, renamed.name))
    run_command(report_command, finished, more, f"--publish={target}", "--suites=[table1]")
    suite = load_suites(target)["table1"]
    assert not suite.missing
    assert (target / "results" / kept.name).read_text() == kept.read_text()
    assert {c.policy for c in suite.evaluations("small_maze")} >= {"bc", "zbc", "wzbc"}
    assert all(c.training is not None for c in suite.evaluations("small_maze"))
    description = next((more / "results").glob("dataset-*.json"))
    content = description.read_text().replace('"length":[', '"length":[1,')
    renamed = description.with_name(f"{description.stem[:-12]}{'z' * 12}.json")
    renamed.write_text(content)
    manifest.write_text(manifest.read_text().replace(description.name, renamed.name))
    with pytest.raises(ValueError, match="results on different datasets called 'small_maze'"):
        publish([finished, more], target)


def test_results_are_not_published_over_themselves(finished):
    """Publishing replaces the target's results, so the source is refused as the target."""
    with pytest.raises(ValueError, match=r"is the folder of the results itself"):
        publish([finished], finished / ".." / finished.name)
    assert list((finished / "results").iterdir())


def test_the_readme_block_is_filled(finished, tmp_path):
    """Between the markers stands the table, everything else is kept; a second time changes nothing."""
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{START}\nold\n{END}\nafter\n")
    update_readme(readme, finished)
    text = readme.read_text()
    assert text == f"before\n{START}\n\n{readme_block(finished)}\n\n{END}\nafter\n"
    assert "| small_maze | wzbc | 100,000 | 2 × 12 | 0.000 [0.000, " in text
    update_readme(readme, finished)
    assert readme.read_text() == text


def test_a_readme_without_markers_is_refused(finished, tmp_path):
    """The message says what is expected."""
    with pytest.raises(ValueError, match=r"expected the lines '<!-- results"):
        with_block("no markers", "table", tmp_path / "README.md")


def test_publishing_deletes_nothing_that_is_no_result(finished, tmp_path):
    """Somebody's own files in a folder called results."""
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "thesis.txt").write_text("years of work")
    with pytest.raises(ValueError, match=r"thesis\.txt' is no published result and would be deleted"):
        publish([finished], tmp_path)
    assert (tmp_path / "results" / "thesis.txt").read_text() == "years of work"


def test_an_empty_folder_is_named(tmp_path, run_command, capsys):
    """One line, and a status other than 0."""
    with pytest.raises(SystemExit):
        run_command(report_command, tmp_path)
    assert "no suites/*.json there; run lerobot-swr-reproduce first" in capsys.readouterr().err


def test_curves_are_named_by_what_differs():
    """Options that all methods have tell nothing."""
    assert short_names(["zbc", "wzbc p=0.95"]) == {"zbc": "zbc", "wzbc p=0.95": "wzbc p=0.95"}
    found = short_names(["zbc hidden_dim=16", "wzbc hidden_dim=16 p=0.95"])
    assert list(found.values()) == ["zbc", "wzbc p=0.95"]
    assert short_names(["zbc hidden_dim=16"]) == {"zbc hidden_dim=16": "zbc hidden_dim=16"}


def test_the_markdown_report_has_the_tables_of_the_page_and_links_its_pictures(drawn):
    """Every row of a table is a line, and every picture that is linked exists."""
    text = (drawn / "report.md").read_text()
    page = (drawn / "report.html").read_text()
    assert text.count("\n## ") == page.count("<h2>")
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(lines) == page.count("<tr>")
    assert all(before == "" for before in re.findall(r"(.*)\n\| [^\n]*\|\n\|---", text))
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert len(pictures) == page.count("<img")
    assert all((drawn / picture).is_file() for picture in pictures)
