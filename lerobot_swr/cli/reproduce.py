"""``lerobot-swr-reproduce``: the paper's experiments, from the datasets to the report.

Every experiment is a cell of its own: finished cells are never computed again, an interrupted command goes on
where it stopped, a failed cell does not stop the others.

Examples:
    lerobot-swr-reproduce --suite=table1 --datasets='[medium_maze-one_side, medium_maze-only_forward]'
    lerobot-swr-reproduce --suite=all --steps=100000 --seeds=5 --output_dir=outputs/reproduction --jobs=2
"""

import shlex
import sys
import time

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.reproduction.execution import reproduce
from lerobot_swr.reproduction.report import write_results_report
from lerobot_swr.reproduction.settings import ReproductionSettings


@parser.wrap()
def run(cfg: ReproductionSettings) -> None:
    """Run the suites, write the report, name what failed."""
    start = time.monotonic()
    failures = reproduce(cfg, shlex.join(["lerobot-swr-reproduce", *sys.argv[1:]]))
    if cfg.dry_run:
        return
    report = write_results_report(cfg.output_dir)
    print(f"{(time.monotonic() - start) / 60:.1f} minutes; report: {report.resolve()}")
    for failure in failures:
        print(f"failed: {failure.cell.labels}: {failure.message}; see {failure.log}", file=sys.stderr)
    if failures:
        sys.exit(1)


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging(console_level="WARNING")
    register_third_party_plugins()
    run()


if __name__ == "__main__":
    main()
