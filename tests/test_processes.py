"""Processes that train seeds beside each other."""

import multiprocessing
import os
import time

import pytest

from lerobot_swr.training.processes import explained_exit, run_processes


def test_a_failed_process_ends_the_others_at_once():
    """The message names seeds, status and the way on; no process is left, and none is started after it."""
    context = multiprocessing.get_context("spawn")
    sleeper, failing, never = (
        context.Process(target=target, args=(argument,))
        for target, argument in ((time.sleep, 3600), (os._exit, 3), (time.sleep, 0))
    )
    with pytest.raises(ChildProcessError, match=r"seeds \[1\] ended with status 3.*--resume=true"):
        run_processes([([0], sleeper), ([1], failing), ([2], never)], jobs=2)
    assert sleeper.exitcode is not None
    assert never.pid is None


def test_every_process_runs():
    """More processes than may run at once."""
    context = multiprocessing.get_context("spawn")
    processes = [([seed], context.Process(target=time.sleep, args=(0,))) for seed in range(3)]
    run_processes(processes, jobs=2)
    assert [process.exitcode for _, process in processes] == [0, 0, 0]


def test_an_input_error_is_told_without_a_stack_trace(capfd):
    """And the process ends with status 2."""
    with pytest.raises(SystemExit) as end, explained_exit():
        raise ValueError("steps=0")
    assert end.value.code == 2
    assert capfd.readouterr().err == "error: steps=0\n"
