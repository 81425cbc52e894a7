"""Computing the cells of a suite: in which order, what is left, failures, resuming, killed processes."""

import contextlib
import json
import os
import signal
import subprocess
import sys

import pytest
from held_command import held_command

from lerobot_swr.reproduction import execution, measurement
from lerobot_swr.reproduction.cells import Cell, Labels, Store, this_command
from lerobot_swr.reproduction.execution import run_cells, run_chain
from lerobot_swr.reproduction.experiments import evaluation, playback, training
from lerobot_swr.reproduction.planning import format_states, format_work, unfinished_chains
from lerobot_swr.reproduction.settings import ReproductionSettings
from lerobot_swr.reproduction.suites import suite_cells


def test_an_interrupted_measurement_goes_on_with_its_next_part(
    settings, demos, store, trained, monkeypatch, tmp_path
):
    """Interrupted after two of four parts: the other two are made, and the result is that of a whole run."""
    one = evaluation(settings, demos, trained, "deterministic")
    run, calls = measurement.run_rollouts, []

    def counted(*args, **kwargs):
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(args)
        return run(*args, **kwargs)

    monkeypatch.setattr(measurement, "run_rollouts", counted)
    roots = {demos.name: demos.root}
    with pytest.raises(KeyboardInterrupt):
        run_chain([one], store, roots, "me")
    assert not store.is_done(one)
    monkeypatch.setattr(measurement, "run_rollouts", lambda *a, **k: calls.append(a) or run(*a, **k))
    assert run_chain([one], store, roots, "me") == []
    assert len(calls) == 4

    whole = Store(tmp_path / "whole")
    (whole.root / "work").mkdir(parents=True)
    os.symlink(store.work_folder(trained), whole.work_folder(trained))
    assert run_chain([one], whole, roots, "me") == []
    assert whole.read(one) == store.read(one)


def test_finished_cells_are_never_computed_again(settings, demos, store, trained, monkeypatch):
    """A second run of everything computes nothing, even when the checkpoints are gone."""
    one = evaluation(settings, demos, trained, "deterministic")
    assert run_cells([trained, one], store, {demos.name: demos}, jobs=1) == []
    monkeypatch.setattr(execution, "_compute", lambda *_: pytest.fail("computed again"))
    assert run_cells([trained, one], store, {demos.name: demos}, jobs=1) == []
    os.rename(store.work_folder(trained), store.root / "gone")
    assert unfinished_chains([trained, one], store) == []


def test_a_training_without_checkpoints_is_repeated_only_for_what_still_needs_it(
    settings, demos, store, trained
):
    """Results alone (published ones) are enough, until a new measurement asks for the policy."""
    os.rename(store.work_folder(trained), store.root / "gone")
    one = evaluation(settings, demos, trained, "deterministic")
    assert unfinished_chains([trained, one], store) == [[trained, one]]


def test_a_failed_cell_does_not_stop_the_others(settings, demos, store, trained, monkeypatch):
    """Two chains, one fails: the other ends; the failure names the cell and its log, and can be repeated."""
    good = evaluation(settings, demos, trained, "deterministic")
    bad = suite_cells("figures", settings, [demos])[0]
    compute = execution._compute

    def failing(one, *args):
        if one == bad:
            raise RuntimeError("no luck")
        return compute(one, *args)

    monkeypatch.setattr(execution, "_compute", failing)
    [failure] = run_cells([bad, good], store, {demos.name: demos}, jobs=1)
    assert failure.cell == bad
    assert "no luck" in failure.message
    assert "Traceback" in failure.log.read_text()
    states = format_states([bad, good], store)
    assert f"failed   {bad.labels}" in states
    assert states.endswith("1 done, 1 failed, 0 waiting")
    monkeypatch.undo()
    assert run_cells([bad, good], store, {demos.name: demos}, jobs=1) == []
    assert store.state(bad) == "done"


def test_a_result_that_cannot_be_written_fails_its_cell_alone(settings, demos, store, trained, monkeypatch):
    """A full disk at the end of a cell: it is named, the next one is computed."""
    first = evaluation(settings, demos, trained, "deterministic")
    second = evaluation(settings, demos, trained, "noise", {"transition_noise": 1.0})
    write = Store.write

    def full(self, one, *args):
        if one == first:
            raise OSError("no space left")
        write(self, one, *args)

    monkeypatch.setattr(Store, "write", full)
    [failure] = run_cells([trained, first, second], store, {demos.name: demos}, jobs=1)
    assert (failure.cell, "no space left" in failure.message) == (first, True)
    assert (store.state(first), store.state(second)) == ("failed", "done")


@pytest.mark.slow
def test_a_killed_worker_fails_the_cell_that_killed_it_alone(demos, store, monkeypatch):
    """Four chains on two workers: the one that kills its process is named, the others end."""

    def run_in_worker(chain, *args):
        def compute(one, *_):
            if one.labels.condition == "deadly":
                os.kill(os.getpid(), signal.SIGKILL)
            return {}

        execution._compute = compute  # of the worker process
        return run_chain(chain, *args)

    names = ("harmless", "deadly", "unharmed", "unaffected")
    cells = [Cell("similarity", Labels(demos.name, "", name), {"name": name}) for name in names]
    monkeypatch.setattr(execution, "run_chain", run_in_worker)
    [failure] = run_cells(cells, store, {demos.name: demos}, jobs=2)
    assert failure.cell == cells[1]
    assert "killed" in failure.message
    assert [store.state(one) for one in cells] == ["done", "failed", "done", "done"]
    assert "killed" in failure.log.read_text()


def test_another_commands_note_of_what_it_computes_is_left_alone(demos, store, monkeypatch):
    """Two commands on one store: neither ends, nor takes for its own, what the other has begun."""
    theirs = Cell("similarity", Labels(demos.name, "", "theirs"), {})
    monkeypatch.setattr(execution, "_compute", lambda *_: pytest.fail("computed twice"))

    @contextlib.contextmanager
    def wait_for_the_other_command(self, one):
        self.write(one, {}, 0.0)
        yield 0

    store.begin(theirs, "elsewhere 7")
    monkeypatch.setattr(Store, "lock", wait_for_the_other_command)
    assert run_cells([theirs], store, {demos.name: demos}, jobs=1) == []
    assert store.is_running(theirs, "elsewhere 7")
    assert not store.is_running(theirs, this_command())
    store.end(theirs, "elsewhere 7")
    assert not store.is_running(theirs, "elsewhere 7")


def test_a_failed_training_leaves_its_measurements_waiting(settings, demos, store, monkeypatch):
    """The training command's log says why; what needed the policy is not attempted."""
    broken = [sys.executable, "-c", "import sys; sys.exit('cannot: ' + sys.argv[1])"]
    monkeypatch.setattr("lerobot_swr.reproduction.training._lerobot_swr_train", lambda: broken)
    trained = training(settings, demos, "zbc")
    one = evaluation(settings, demos, trained, "deterministic")
    [failure] = run_cells([trained, one], store, {demos.name: demos}, jobs=1)
    assert failure.cell == trained
    assert "ended with status 1" in failure.message
    assert "cannot: --policy.type=zbc" in failure.log.read_text()
    assert (store.state(trained), store.state(one)) == ("failed", "waiting")


def test_playback_is_measured_without_a_training(settings, demos, store):
    """As many rollouts per seed as a policy's; on its own demonstrations it succeeds and keeps the style."""
    one = playback(settings, demos, "deterministic")
    assert run_cells([one], store, {demos.name: demos}, jobs=1) == []
    rollouts = store.read(one)["rollouts"]
    assert list(rollouts) == ["0", "1"]
    for part in rollouts.values():
        assert sorted(part["stratified"]["style"]) == [style for style in range(6) for _ in range(2)]
        assert sum(part["stratified"]["success"]) == sum(part["stratified"]["match"]) == 12


def test_the_work_that_is_left_is_counted(settings, demos, store, trained):
    """Seed-steps of trainings and rollouts, neither of finished cells nor of trainings not needed again."""
    wzbc = training(settings, demos, "wzbc")
    cells = [trained, wzbc, *(evaluation(settings, demos, one, "x") for one in (trained, wzbc))]
    assert format_work(cells, store) == (
        "left: 40 seed-steps in 1 trainings of stacked seeds, "
        "0 seed-steps in 0 trainings by LeRobot's loop, 96 rollouts in 2 evaluations"
    )
    half = store.work_folder(wzbc) / "run" / "seed_0" / "checkpoints" / "000010"
    half.mkdir(parents=True)
    assert "left: 30 seed-steps" in format_work(cells, store)
    assert format_work([trained], store).startswith("left: 0 seed-steps in 0 trainings")


def test_long_trainings_come_first(demos, store):
    """100,000 steps of five stacked seeds take longer than ACT's two seeds, and less than Diffusion's."""
    pytest.importorskip("diffusers")
    settings = ReproductionSettings()
    trainings = [training(settings, demos, policy) for policy in ("act", "zbc", "diffusion")]
    measured = [evaluation(settings, demos, trained, "x") for trained in trainings]
    ordered = [chain[0].definition["policy"] for chain in unfinished_chains(measured, store)]
    assert ordered == ["diffusion", "zbc", "act"]


def test_the_whole_suite_from_the_command(small_maze, tmp_path, run_command, capsys):
    """Train, measure, report; a second call finds everything done and draws the same report."""
    from lerobot_swr.cli.report import main as report
    from lerobot_swr.cli.reproduce import main as reproduce

    flags = [
        "--suite=table1",
        f"--datasets=[{small_maze.name}]",
        f"--dataset_dir={small_maze.parent}",
        "--policies=[zbc]",
        "--steps=20",
        "--seeds=2",
        "--n_rollouts=6",
        "--policy_options={backbone.hidden_dim: 16, backbone.num_hidden: 2}",
        f"--output_dir={tmp_path}",
        "--jobs=1",
    ]
    run_command(reproduce, *flags)
    assert "2 done, 0 failed, 0 waiting" in capsys.readouterr().out
    results = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").iterdir()}
    [evaluated] = [json.loads(p.read_text()) for p in results if p.name.startswith("evaluate")]
    assert [len(seed["stratified"]["behavior"]) for seed in evaluated["result"]["rollouts"].values()] == [
        6,
        6,
    ]
    page = (tmp_path / "report.html").read_bytes()
    run_command(reproduce, *flags)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "results").iterdir()} == results
    assert (tmp_path / "report.html").read_bytes().count(b"<img") == page.count(b"<img") == 2
    again = (tmp_path / "report.html").read_bytes()
    run_command(report, tmp_path)
    assert (tmp_path / "report.html").read_bytes() == again


@pytest.mark.slow
@pytest.mark.parametrize("everything", [True, False], ids=["everything", "the command alone"])
def test_killed_in_the_middle_of_a_training_a_suite_ends_with_the_same_results(
    small_maze, tmp_path, everything
):
    """kill -9 of the command, or of all its processes; the same command then ends as an unharmed one."""
    results = {}
    for name in ("whole", "killed"):
        root = tmp_path / name
        main, flags = (
            "lerobot_swr.cli.reproduce",
            [
                *("--suite=table1", f"--datasets=[{small_maze.name}]", f"--dataset_dir={small_maze.parent}"),
                *("--policies=[wzbc]", "--steps=300", "--seeds=2", "--n_rollouts=6", "--jobs=2"),
                f"--output_dir={root}",
            ],
        )
        if name == "killed":
            second_seed = r"seed_1/checkpoints/\.000060\.unfinished/training_state$"
            with held_command(main, flags, second_seed) as (running, _):
                kill = os.killpg if everything else os.kill
                kill(running.pid, signal.SIGKILL)
                running.wait()
                assert not list(root.glob("results/train-*"))
        subprocess.run([sys.executable, "-c", f"from {main} import main; main()", *flags], check=True)
        stored = [json.loads(path.read_text()) for path in sorted((root / "results").iterdir())]
        results[name] = [(one["key"], one["result"]) for one in stored]
        weights = [p.read_bytes() for p in sorted(root.rglob("model.safetensors"))]
        results[f"{name} weights"] = weights
    assert results["whole"] == results["killed"]
    assert results["whole weights"] == results["killed weights"]
    assert len(results["whole weights"]) == 2
