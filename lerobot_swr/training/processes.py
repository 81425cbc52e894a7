"""Processes that train seeds beside each other."""

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess

from tqdm import tqdm

from lerobot_swr.errors import USER_ERRORS, one_line


def run_processes(
    processes: list[tuple[list[int], BaseProcess]], jobs: int, tick: Callable[[], None] | None = None
) -> None:
    """Run processes, ``jobs`` at once; when one fails, the others are ended.

    Args:
        processes: Seeds and the process that trains them, not started yet.
        jobs: How many run at once.
        tick: Called several times a second.

    Raises:
        ChildProcessError: If a process failed; it has said why.
    """
    waiting = list(processes)
    running: list[tuple[list[int], BaseProcess]] = []
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                running.append(waiting.pop(0))
                with _ignoring_interrupts():
                    running[-1][1].start()
            time.sleep(0.2)
            if tick is not None:
                tick()
            for seeds, process in running:
                if process.exitcode:
                    raise ChildProcessError(
                        f"the process that trains seeds {seeds} ended with status {process.exitcode}; "
                        "what it said is above. Checkpoints are kept: go on with --resume=true "
                        "(--jobs=1 if memory was short)"
                    )
            running = [(seeds, process) for seeds, process in running if process.exitcode is None]
    finally:
        for _, process in running:
            process.terminate()
        for _, process in running:
            process.join()


def end_with_parent() -> None:
    """In such a process: end at once when the one that started it does, however that ends.

    What a killed command leaves must not go on beside the command that resumes it.
    """
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _ignoring_interrupts() -> Iterator[None]:
    """Let processes that start within leave Ctrl-C, which the terminal sends to all, to this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def explained_exit() -> Iterator[None]:
    """In such a process: print the message of an input error and exit with status 2."""
    # The lock of tqdm's own would outlive a process that is ended, and Python would warn of it.
    tqdm.set_lock(threading.RLock())
    try:
        yield
    except USER_ERRORS as error:
        print(f"error: {one_line(error)}", file=sys.stderr)
        sys.exit(2)
