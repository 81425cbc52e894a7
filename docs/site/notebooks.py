"""Notebooks of the tutorials: written from their pages, and run.

``python -m docs.site.notebooks`` writes ``notebooks/*.ipynb``; with ``--run`` it runs them, each in an empty
folder, and fails where a cell does.
"""

import sys
import tempfile
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

REPOSITORY = Path(__file__).parents[2]
TUTORIALS = ("maze", "so101")
PYTHON = "---\njupyter:\n  kernelspec: {name: python3, language: python, display_name: Python 3}\n---\n\n"
"""Before a page: its unmarked cells are Python's, however many bash blocks it has."""
LINKS = {
    "](../": "](../docs/",
    "](real_arm": "](../docs/tutorials/real_arm",
    "](so101": "](../docs/tutorials/so101",
}


def notebook_of(tutorial: str) -> nbformat.NotebookNode:
    """The notebook of a page: Python and bash blocks are its cells."""
    page = (REPOSITORY / "docs" / "tutorials" / f"{tutorial}.md").read_text()
    notebook = jupytext.reads(PYTHON + page, fmt="md")
    for number, cell in enumerate(notebook.cells):
        cell.id = f"{tutorial}-{number}"  # instead of a random one
        if cell.cell_type == "markdown":
            for link, from_here in LINKS.items():
                cell.source = cell.source.replace(link, from_here)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


def main() -> None:
    """Write the notebooks, or run them."""
    for tutorial in TUTORIALS:
        notebook = notebook_of(tutorial)
        if "--run" in sys.argv:
            with tempfile.TemporaryDirectory() as folder:
                resources = {"metadata": {"path": folder}}
                NotebookClient(notebook, timeout=1800, kernel_name="python3", resources=resources).execute()
            print(f"{tutorial}: {sum(cell.cell_type == 'code' for cell in notebook.cells)} cells ran")
            continue
        target = REPOSITORY / "notebooks" / f"{tutorial}.ipynb"
        target.parent.mkdir(exist_ok=True)
        target.write_text(nbformat.writes(notebook) + "\n")


if __name__ == "__main__":
    main()
