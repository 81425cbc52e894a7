"""The published results: what is said of them is what they give."""

import shutil
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from lerobot_swr.reproduction.publication import START, readme_block, with_block
from lerobot_swr.reproduction.report import write_results_report

REPOSITORY = Path(__file__).parent.parent
RESULTS = REPOSITORY / "docs" / "results"
LONG = ("d3il", "maze")  # half a minute


def test_the_readme_shows_the_published_results():
    """README's block is what the stored results give: neither stands without the other."""
    published = REPOSITORY / "docs" / "results" / "human"
    text = (REPOSITORY / "README.md").read_text()
    assert (START in text) == published.is_dir()
    if published.is_dir():
        assert with_block(text, readme_block(published), REPOSITORY / "README.md") == text


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(path.parent.name, marks=[pytest.mark.slow] if path.parent.name in LONG else [])
        for path in sorted(RESULTS.glob("*/report.md"))
    ],
)
def test_published_reports_are_what_the_published_results_give(name, tmp_path, monkeypatch):
    """Every word and figure of them, but for the pictures, which are not drawn again here."""
    there = tmp_path / "docs" / "results" / name
    shutil.copytree(RESULTS / name, there, ignore=shutil.ignore_patterns("figures"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Figure, "savefig", lambda self, path, **options: Path(path).touch())
    write_results_report(there)
    assert (there / "report.md").read_text() == (RESULTS / name / "report.md").read_text()


def test_published_texts_name_no_folders_of_the_machine_that_made_them():
    """Neither temporary ones nor homes."""
    texts = [*RESULTS.glob("*/*.md"), *RESULTS.glob("*/suites/*.json"), *RESULTS.glob("*/results/*.json")]
    assert texts
    for path in texts:
        text = path.read_text()
        assert not [place for place in ("/tmp/", "/root/", "/home/", "/Users/") if place in text], path
