"""``lerobot-swr-report``: draw the report of ``lerobot-swr-reproduce`` again from its stored results.

Examples:
    lerobot-swr-report outputs/reproduction
    lerobot-swr-report outputs/reproduction --publish=docs/results/maze
    lerobot-swr-report docs/results/maze --readme=README.md
"""

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

    # Folder with the stored results; also the first argument.
    results: Path
    # Copy the stored results (no checkpoints) to this folder, and write the report there.
    publish: Path | None = None
    # Write the table of results into this file, between its markers.
    readme: Path | None = None


@parser.wrap()
def report(cfg: ReportCommand) -> None:
    """Write the report."""
    root = cfg.results
    if cfg.publish is not None:
        publish(cfg.results, cfg.publish)
        root = cfg.publish
    print(f"report: {write_results_report(root)}")
    if cfg.readme is not None:
        update_readme(cfg.readme, root)
        print(f"updated: {cfg.readme}")


@explain_errors
def main() -> None:
    """Entry point."""
    if len(sys.argv) > 1 and not sys.argv[1].startswith("-"):
        sys.argv[1] = f"--results={sys.argv[1]}"
    report()
