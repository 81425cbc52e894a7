"""Runs cells: what is missing, in parallel, each to its end or to a logged failure."""

import contextlib
import json
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from joblib import Parallel, delayed

from lerobot_swr.reproduction.backends import worker_deaths
from lerobot_swr.reproduction.baselines import known_policies, missing_extras
from lerobot_swr.reproduction.cells import Cell, Store, this_command
from lerobot_swr.reproduction.demonstrations import Demonstrations, prepare
from lerobot_swr.reproduction.measurement import measure
from lerobot_swr.reproduction.planning import (
    format_states,
    format_work,
    is_finished,
    progress,
    unfinished_chains,
)
from lerobot_swr.reproduction.settings import ReproductionSettings
from lerobot_swr.reproduction.style_geometry import compute_similarity, compute_style_map
from lerobot_swr.reproduction.suites import suite_cells, suite_datasets
from lerobot_swr.reproduction.training import train
from lerobot_swr.whole_files import write_whole


@dataclass(frozen=True)
class Failure:
    """A cell that ended with an error.

    Attributes:
        cell: The cell.
        message: The error.
        log: Where the rest is.
    """

    cell: Cell
    message: str
    log: Path


def reproduce(settings: ReproductionSettings, command: str = "") -> list[Failure]:
    """Run the chosen suites: every cell that is not finished, and no other.

    With ``jobs=None`` joblib's active backend is used: ``with joblib.parallel_config(...)`` sends the
    cells to a cluster, Dask's or Ray's, whose machines see the same output folder.

    Args:
        settings: What to run.
        command: What the user typed, for the report.

    Returns:
        The cells that failed.

    Raises:
        ValueError: If a dataset or policy is unknown, or nothing is left to run.
    """
    for name, extra in missing_extras().items():
        print(f"left out: {name} (pip install '{extra}')")
    _check_policies(settings)
    store = Store(settings.output_dir)
    suites = {name: settings.choose_datasets(suite_datasets(name, settings)) for name in settings.suites}
    names = dict.fromkeys(name for datasets in suites.values() for name in datasets)
    prepared = {name: prepare(name, settings.dataset_folder, store, settings.from_d3il) for name in names}
    cells: dict[Cell, Cell] = {}  # the first name of what several suites ask for
    for suite, datasets in suites.items():
        of_suite = suite_cells(suite, settings, [prepared[name] for name in datasets])
        of_suite = [cells.setdefault(cell, cell) for cell in of_suite]
        if of_suite and not settings.dry_run:
            _write_manifest(store, suite, command, of_suite, [prepared[name] for name in datasets])
    if not cells:
        raise ValueError(f"datasets={settings.datasets}, policies={settings.policies}: nothing to run")
    if settings.dry_run:
        print(format_states(list(cells), store))
        print(format_work(list(cells), store))
        return []
    failures = run_cells(list(cells), store, prepared, settings.jobs)
    print(format_states(list(cells), store))
    return failures


def run_cells(
    cells: Sequence[Cell], store: Store, datasets: Mapping[str, Demonstrations], jobs: int | None
) -> list[Failure]:
    """Compute the cells that are not finished.

    A training and everything measured on it form a chain, which one worker goes through; chains run in
    parallel. If a worker process is killed (out of memory, say), those chains that were under way are run
    again, one at a time after all others; whichever kills its worker again has failed. Another command may
    work on the same store at the same time.

    Args:
        cells: The cells, in any order.
        store: Where results go.
        datasets: The datasets by name.
        jobs: Workers; None takes joblib's active configuration.
    """
    command = this_command()
    chains = unfinished_chains(cells, store)
    workers = {} if jobs is None else {"n_jobs": jobs}
    roots = {name: demos.root.resolve() for name, demos in datasets.items()}
    for cell in (cell for chain in chains for cell in chain):
        store.failure_path(cell).unlink(missing_ok=True)
        store.end(cell, command)  # of a killed process that had the same number
    failures: dict[Cell, Failure] = {}

    def is_running(cell: Cell) -> bool:
        return store.is_running(cell, command)

    def attempt(chosen: list[list[Cell]]) -> list[list[Cell]]:
        """Run chains; those that were under way when a worker was killed."""
        try:
            outcomes = Parallel(**workers)(
                delayed(run_chain)(chain, store, roots, command) for chain in chosen
            )
            failures.update({failure.cell: failure for of_chain in outcomes for failure in of_chain})
            return []
        except worker_deaths():
            known = [cell for chain in chosen for cell in chain if store.failure_path(cell).is_file()]
            failures.update({cell: _stored_failure(cell, store) for cell in known})
            under_way = [chain for chain in chosen if any(map(is_running, chain))]
            return under_way or chosen[:1]

    with progress([cell for chain in chains for cell in chain], store):
        alone: list[list[Cell]] = []
        while chains:
            interrupted = attempt(chains)
            alone += interrupted
            left = [_left_of(chain, store, failures) for chain in chains if chain not in interrupted]
            chains = [chain for chain in left if chain] if interrupted else []
        for chain in alone:
            while chain := _left_of(chain, store, failures):
                if attempt([chain]):
                    culprit = next(filter(is_running, chain), chain[0])
                    failures[culprit] = _failed(
                        culprit, store, command, "its worker process was killed twice"
                    )
    return list(failures.values())


def _left_of(chain: Sequence[Cell], store: Store, failures: Mapping[Cell, Failure]) -> list[Cell]:
    """What is still to be computed of a chain, except for what has failed."""
    if any(cell.kind == "train" and cell in failures for cell in chain):
        return []
    return [cell for cell in chain if cell not in failures and not is_finished(cell, store)]


def run_chain(
    chain: Sequence[Cell], store: Store, datasets: Mapping[str, Path], command: str
) -> list[Failure]:
    """Compute the cells of a chain one after the other, up to the first training that fails.

    Args:
        chain: The cells.
        store: Where results go.
        datasets: Folders of the datasets by name.
        command: What `this_command` is in the process that started the workers.
    """
    failures = []
    for cell in chain:
        failure = _run_cell(cell, store, datasets[cell.labels.dataset], command)
        if failure is not None:
            failures.append(failure)
            if cell.kind == "train":
                break
    return failures


def _run_cell(cell: Cell, store: Store, dataset: Path, command: str) -> Failure | None:
    try:
        with store.lock(cell) as lock:
            if is_finished(cell, store):  # by another command meanwhile
                return None
            store.failure_path(cell).unlink(missing_ok=True)
            store.begin(cell, command)
            start = time.monotonic()
            with (
                store.log_path(cell).open("a") as log,
                contextlib.redirect_stdout(log),
                contextlib.redirect_stderr(log),
            ):
                result = _compute(cell, store, dataset, lock)
            store.write(cell, result, time.monotonic() - start)
            store.end(cell, command)
            return None
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        return _failed(cell, store, command, message, traceback.format_exc())


def _failed(cell: Cell, store: Store, command: str, message: str, details: str = "") -> Failure:
    """Note a failure; where even that cannot be written (disk full), the command still names it."""
    with contextlib.suppress(OSError):
        store.end(cell, command)
        write_whole(store.failure_path(cell), message + "\n")
        with store.log_path(cell).open("a") as log:
            log.write(details or message + "\n")
    return Failure(cell, message, store.log_path(cell))


def _stored_failure(cell: Cell, store: Store) -> Failure:
    return Failure(cell, store.failure_path(cell).read_text().strip(), store.log_path(cell))


def _compute(cell: Cell, store: Store, dataset: Path, lock: int) -> dict[str, Any]:
    # Cells share the cores among them; and another number of threads would change the rounding.
    torch.set_num_threads(1)
    if cell.kind == "train":
        return train(cell, store, dataset, lock)
    if cell.kind == "evaluate":
        return measure(cell, store, dataset)
    if cell.kind == "styles":
        return compute_style_map(cell, store, dataset)
    return compute_similarity(cell, dataset)


def _check_policies(settings: ReproductionSettings) -> None:
    unknown = [name for name in settings.policies or [] if name not in known_policies()]
    if unknown:
        raise ValueError(
            f"policies={unknown}: unknown; this installation knows {', '.join(known_policies())}"
        )


def _write_manifest(
    store: Store,
    suite: str,
    command: str,
    cells: Sequence[Cell],
    datasets: Sequence[Demonstrations],
) -> None:
    """What the report of a suite consists of: the last run decides."""
    content = {
        "suite": suite,
        "command": command,
        "datasets": {demos.name: store.result_path(demos.cell).name for demos in datasets},
        "cells": [store.result_path(cell).name for cell in cells],
    }
    write_whole(store.root / "suites" / f"{suite}.json", json.dumps(content, indent=1) + "\n")
