"""``lerobot-swr-report``: draw the report of ``lerobot-swr-reproduce`` again from its stored results.

Examples:
    lerobot-swr-report outputs/reproduction
    lerobot-swr-report outputs/reproduction --publish=docs/results/maze
    lerobot-swr-report docs/results/human docs/results/maze --publish=outputs/all --suites='[table1]'
    lerobot-swr-report docs/results/maze --readme=README.md
"""

import itertools
import json
import sys
from dataclasses import dataclass
from pathlib import Path

from lerobot.configs import parser

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.reproduction.publication import publish, update_readme
from lerobot_swr.reproduction.report import write_results_report


@dataclass
class ReportCommand:
    """Options of ``lerobot-swr-report``."""

    # Folders with stored results; also the first arguments. Of several, the report is that of all together,
    # written where `publish` says.
    results: list[Path]
    # Copy the stored results (no checkpoints) to this folder, and write the report there.
    publish: Path | None = None
    # With publish: only these suites; null takes all.
    suites: list[str] | None = None
    # Write the table of results into this file, between its markers.
    readme: Path | None = None


@parser.wrap()
def report(cfg: ReportCommand) -> None:
    """Write the report."""
    if not cfg.results:
        raise ValueError("results=[]: name the folder that lerobot-swr-reproduce wrote to")
    root = cfg.results[0]
    if cfg.publish is not None:
        publish(cfg.results, cfg.publish, cfg.suites)
        root = cfg.publish
    elif len(cfg.results) > 1 or cfg.suites is not None:
        raise ValueError(
            "publish is missing: several folders, or some suites of one, are copied together before their "
            "report is written; say where with --publish=FOLDER"
        )
    print(f"report: {write_results_report(root)}")
    if cfg.readme is not None:
        update_readme(cfg.readme, root)
        print(f"updated: {cfg.readme}")


@explain_errors
def main() -> None:
    """Entry point."""
    folders = list(itertools.takewhile(lambda word: not word.startswith("-"), sys.argv[1:]))
    named = [word.removeprefix("--results=") for word in sys.argv[1:] if word.startswith("--results=")]
    if folders:
        sys.argv[1 : 1 + len(folders)] = [f"--results={json.dumps(folders)}"]
    elif named and not named[0].startswith("["):  # a single folder
        sys.argv[sys.argv.index(f"--results={named[0]}")] = f"--results={json.dumps(named)}"
    report()


if __name__ == "__main__":
    main()
