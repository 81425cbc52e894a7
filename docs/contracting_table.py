"""Prints tables of docs/contracting.md from the robustness.json files of evaluations.

Several files of one policy (its training seeds) are pooled: python docs/contracting_table.py \
"zbc=outputs/contracting/none/seed_*/robustness.json" "playback=outputs/contracting/playback/robustness.json"
"""

import glob
import json
import sys
from pathlib import Path

import numpy as np
from scipy import stats


def pooled(values: list[float], counts: list[int]) -> str:
    """Share over all seeds' rollouts and its Wilson 95 % interval."""
    hits, total = round(sum(v * n for v, n in zip(values, counts, strict=True))), sum(counts)
    interval = stats.binomtest(hits, total).proportion_ci(method="wilson")
    return f"{hits / total:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def main() -> None:
    """One table each for success, style match, length error and L1: rows perturbations, columns policies."""
    policies = {}
    for argument in sys.argv[1:]:
        name, _, pattern = argument.partition("=")
        files = [Path(name) for name in sorted(glob.glob(pattern))]
        policies[name] = [json.loads(file.read_text())["cells"] for file in files]
        if not files:
            sys.exit(f"{argument!r}: no such file")
    for key in ("success_rate", "style_match", "length_error", "l1"):
        print(f"\n| {key} | {' | '.join(f'{name} ({len(seeds)})' for name, seeds in policies.items())} |")
        print("|---" * (len(policies) + 1) + "|")
        for place, cell in enumerate(next(iter(policies.values()))[0]):
            row = [cell["perturbation"]]
            for seeds in policies.values():
                values = [cells[place][key] for cells in seeds]
                counts = [cells[place]["n_episodes"] for cells in seeds]
                if None in values:
                    row.append("-")
                elif key == "length_error":
                    row.append(f"{np.mean(values):.1f}")
                elif key == "l1":
                    floor = np.mean([cells[place]["l1_floor"] for cells in seeds])
                    row.append(f"{np.mean(values):.2f} (floor {floor:.2f})")
                else:
                    row.append(pooled(values, counts))
            print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
