"""What is done and what is left of the cells: the order of the work, its amount and its progress."""

import contextlib
import sys
import threading
from collections.abc import Iterator, Sequence

from lerobot_swr.progress import Progress
from lerobot_swr.reproduction.baselines import BASELINES
from lerobot_swr.reproduction.cells import Cell, Store
from lerobot_swr.reproduction.training import STACKED, checkpoint_folder, steps_done


def unfinished_chains(cells: Sequence[Cell], store: Store) -> list[list[Cell]]:
    """What is left to compute: each chain is a training and what depends on it, or a cell on its own.

    A training whose dependants are all finished is not asked for again; one whose checkpoints are gone is,
    if something still depends on it. Long trainings come first.
    """
    chains: list[list[Cell]] = []
    for root in dict.fromkeys(cell.needs or cell for cell in cells):
        waiting = [cell for cell in cells if cell.needs == root and not store.is_done(cell)]
        wanted = bool(waiting) if root.kind == "train" else True
        if wanted and not is_finished(root, store):
            waiting.insert(0, root)
        if waiting:
            chains.append(waiting)

    def work(chain: list[Cell]) -> int:
        root = chain[0]
        if root.kind != "train":
            return 0
        seed_steps, policy = (
            root.definition["steps"] * len(root.definition["seeds"]),
            root.definition["policy"],
        )
        return seed_steps if policy in STACKED else BASELINES[policy].slowness * seed_steps

    return sorted(chains, key=work, reverse=True)


def format_states(cells: Sequence[Cell], store: Store) -> str:
    """A table for the terminal: what is done, failed or waiting."""
    rows = [(store.state(cell), str(cell.labels)) for cell in cells]
    counts = {state: sum(s == state for s, _ in rows) for state in ("done", "failed", "waiting")}
    lines = [f"{state:<8} {name}" for state, name in rows]
    return "\n".join([*lines, ", ".join(f"{count} {state}" for state, count in counts.items())])


def format_work(cells: Sequence[Cell], store: Store) -> str:
    """What is left to compute, in seed-steps of training (steps times seeds) and in rollouts."""
    left = [cell for chain in unfinished_chains(cells, store) for cell in chain]
    trainings = [cell for cell in left if cell.kind == "train"]
    lines = []
    for stacked, how in ((True, "of stacked seeds"), (False, "by LeRobot's loop")):
        chosen = [cell for cell in trainings if (cell.definition["policy"] in STACKED) == stacked]
        seed_steps = sum(
            round(cell.definition["steps"] * len(cell.definition["seeds"]) * (1 - steps_done(cell, store)))
            for cell in chosen
        )
        lines.append(f"{seed_steps:,} seed-steps in {len(chosen)} trainings {how}")
    evaluations = [cell for cell in left if cell.kind == "evaluate"]
    rollouts = sum(
        sum(cell.definition["protocols"].values()) * len((cell.needs or cell).definition["seeds"])
        for cell in evaluations
    )
    lines.append(f"{rollouts:,} rollouts in {len(evaluations)} evaluations")
    return "left: " + ", ".join(lines)


def is_finished(cell: Cell, store: Store) -> bool:
    """Whether the result and, of a training, its checkpoints are there."""
    if cell.kind != "train":
        return store.is_done(cell)
    folders = [checkpoint_folder(cell, store, seed) for seed in cell.definition["seeds"]]
    return store.is_done(cell) and all(folder.is_dir() for folder in folders)


@contextlib.contextmanager
def progress(cells: Sequence[Cell], store: Store) -> Iterator[None]:
    """A bar over the cells, fed from what they have written, whoever computes them."""
    finished = threading.Event()
    with Progress(total=len(cells), desc="Cells", unit="cell", file=sys.stdout) as bar:

        def watch() -> None:
            while True:
                last = finished.wait(2.0)
                bar.n = round(sum(_share_done(cell, store) for cell in cells), 1)
                bar.refresh()
                if last:
                    return

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            finished.set()
            watcher.join()


def _share_done(cell: Cell, store: Store) -> float:
    if store.is_done(cell):
        return 1.0
    return steps_done(cell, store) if cell.kind == "train" else 0.0
