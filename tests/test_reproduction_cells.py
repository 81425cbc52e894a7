"""Cells of the paper's experiments: what makes two of them the same, and how their results are stored."""

import dataclasses
import fcntl
import os
import subprocess
import sys

import pytest
from reproduction_cells import cell

from lerobot_swr.reproduction.cells import Cell, Labels
from lerobot_swr.reproduction.experiments import evaluation, training
from lerobot_swr.reproduction.suites import suite_cells
from lerobot_swr.reproduction.training import _keep_the_last_checkpoint


def test_what_defines_a_cell_is_its_identity():
    """The same definition is the same cell, whatever its name and order; another one is another cell."""
    one = cell(a=1, b=[2])
    assert Cell("similarity", Labels("other", "x", "y"), {"b": [2], "a": 1}).key == one.key
    others = [cell(a=1), cell(a=1, b=[3]), Cell("styles", one.labels, one.definition)]
    others.append(Cell("similarity", one.labels, one.definition, needs=one))
    assert len({other.key for other in [one, *others]}) == 5


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("steps", 21),
        ("seeds", 3),
        ("batch_size", 8),
        ("policy_options", {"backbone.hidden_dim": 17}),
        ("n_rollouts", 9),
    ],
)
def test_a_changed_setting_is_a_new_cell(settings, demos, key, value):
    """Each setting reaches the key of what is measured."""
    changed = dataclasses.replace(settings, **{key: value})
    keys = {evaluation(s, demos, training(s, demos, "zbc"), "x").key for s in (settings, changed)}
    assert len(keys) == 2


def test_other_demonstrations_are_a_new_cell(settings, demos):
    """The dataset's content counts, not its name."""
    other = dataclasses.replace(demos, fingerprint="another")
    renamed = dataclasses.replace(demos, name="renamed")
    key = training(settings, demos, "zbc").key
    assert training(settings, other, "zbc").key != key
    assert training(settings, renamed, "zbc").key == key


def test_the_same_training_is_one_cell_whoever_asks_for_it(settings, demos):
    """Defaults given or not, numbers whole or not, through the settings or a suite: one key, one name."""
    plain = training(dataclasses.replace(settings, policy_options={}), demos, "wzbc")
    for given in ({"beta": 10.0, "p": 0.8}, {"beta": 10}, {"p": 0.8}):
        asked = training(dataclasses.replace(settings, policy_options={}), demos, "wzbc", given)
        assert (asked.key, asked.slug) == (plain.key, plain.slug)
        asked = training(dataclasses.replace(settings, policy_options=given), demos, "wzbc")
        assert (asked.key, asked.slug) == (plain.key, plain.slug)
    settings = dataclasses.replace(settings, sweep_steps=settings.steps, sweep_seeds=settings.seeds)
    suites = {name: suite_cells(name, settings, [demos]) for name in ("table1", "robustness", "figures")}
    wzbc = [
        {cell for cell in cells if cell.kind == "train" and cell.labels.policy.startswith("wzbc")}
        for cells in suites.values()
    ]
    assert len(set.intersection(*wzbc)) == 1
    assert len(set.union(*wzbc)) == len(wzbc[2])


def test_the_same_measurement_is_one_cell_whoever_asks_for_it(settings, demos):
    """Of unperturbed policies, which keep paths for pictures; those of other options keep none."""
    lengths = (75,) * len(demos.lengths)
    settings = dataclasses.replace(settings, sweep_steps=settings.steps, sweep_seeds=settings.seeds)
    suites = {
        name: [
            cell
            for cell in suite_cells(name, settings, [dataclasses.replace(demos, lengths=lengths)])
            if cell.kind == "evaluate" and cell.labels.condition == "deterministic" and cell.needs
        ]
        for name in ("table1", "robustness", "contracting", "control", "figures")
    }
    of_wzbc = [
        {cell.key for cell in cells if cell.labels.policy == "wzbc hidden_dim=16"}
        for cells in suites.values()
    ]
    assert len(set.union(*of_wzbc)) == 1
    assert all(cell.definition["paths"] for cell in suites["table1"])
    others = [
        cell for cell in suites["figures"] if "=" in cell.labels.policy.removeprefix("wzbc hidden_dim=16")
    ]
    assert len(others) == 7
    assert not any(cell.definition["paths"] for cell in others)


def test_an_environment_option_at_its_default_changes_nothing(settings, demos):
    """Whole configurations are compared; every option that differs makes another cell."""
    trained = training(settings, demos, "zbc")
    plain = evaluation(settings, demos, trained, "x")
    same = evaluation(settings, demos, trained, "x", {"transition_noise": 0, "start_radius": 0.10})
    assert same.key == plain.key
    for option in ({"transition_noise": 1.0}, {"episode_length": 150}, {"sticky_walls": True}):
        assert evaluation(settings, demos, trained, "x", option).key != plain.key
    assert plain.definition["env"]["episode_length"] == 200


def test_every_cell_about_an_environment_holds_all_of_its_options(settings, demos):
    """So that no result of an older default is taken for one of the new default."""
    figures = suite_cells("figures", settings, [demos])
    named = {cell.kind: cell for cell in (demos.cell, *figures)}
    for kind in ("dataset", "similarity", "styles", "evaluate"):
        assert named[kind].definition["env"]["episode_length"] == 200


def test_a_result_appears_complete_or_not_at_all(store, monkeypatch):
    """Killed while it is written, a cell is not done; nothing but its own file is left afterwards."""
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        store.write(cell(), {"x": 1}, 1.0)
    assert store.state(cell()) == "waiting"
    monkeypatch.undo()
    store.write(cell(), {"x": 1}, 1.0)
    assert store.read(cell()) == {"x": 1}
    assert store.state(cell()) == "done"


def test_only_the_last_checkpoint_of_a_training_is_kept(tmp_path):
    """Also where a killed run has left a half-made link."""
    checkpoints = tmp_path / "checkpoints"
    for step in ("000010", "000020"):
        (checkpoints / step).mkdir(parents=True)
    (checkpoints / "last").symlink_to("000020")
    (checkpoints / ".last.7").symlink_to("000010")
    _keep_the_last_checkpoint(tmp_path)
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000020", "last"]


def test_a_training_that_outlives_its_command_keeps_others_out(store, monkeypatch):
    """The lock is held as long as a process has its descriptor, and freed when the last one is killed."""
    with store.lock(cell()) as descriptor:
        orphan = subprocess.Popen([sys.executable, "-c", "input()"], pass_fds=(descriptor,), stdin=-1)
    flock = fcntl.flock
    monkeypatch.setattr(fcntl, "flock", lambda file, how: flock(file, how | fcntl.LOCK_NB))  # never waits
    with pytest.raises(BlockingIOError), store.lock(cell()):
        pass
    orphan.kill()
    orphan.wait()
    with store.lock(cell()):
        pass
