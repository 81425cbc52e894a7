"""Cells of the paper's experiments: identity, storage, resuming, failures."""

import contextlib
import dataclasses
import itertools
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import draccus
import pytest
from conftest import save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_swr.reproduction import execution, measurement
from lerobot_swr.reproduction.baselines import BASELINES, known_policies
from lerobot_swr.reproduction.cells import Cell, Labels, Store, this_command
from lerobot_swr.reproduction.demonstrations import Demonstrations, prepare
from lerobot_swr.reproduction.execution import run_cells, run_chain
from lerobot_swr.reproduction.experiments import evaluation, playback, training, variant_name
from lerobot_swr.reproduction.measurement import environment_seed
from lerobot_swr.reproduction.planning import format_states, format_work, unfinished_chains
from lerobot_swr.reproduction.settings import MAX_ROLLOUTS, ReproductionSettings
from lerobot_swr.reproduction.suites import suite_cells
from lerobot_swr.reproduction.training import _keep_the_last_checkpoint, checkpoint_folder

CONFIGS = Path(__file__).parent.parent / "configs"


def cell(**definition) -> Cell:
    """A cell without a training."""
    return Cell("similarity", Labels("data", "", "similarity"), definition)


@pytest.fixture
def store(tmp_path) -> Store:
    """An empty folder of results."""
    return Store(tmp_path / "store")


@pytest.fixture
def demos(small_maze, store) -> Demonstrations:
    """The small maze, described."""
    return prepare(small_maze.name, small_maze.parent, store)


@pytest.fixture
def settings(tmp_path) -> ReproductionSettings:
    """Two seeds, twelve rollouts."""
    return ReproductionSettings(
        steps=20, seeds=2, n_rollouts=12, policy_options={"hidden_dim": 16}, output_dir=tmp_path / "store"
    )


@pytest.fixture
def trained(settings, demos, store, make_tiny_policy, small_maze_meta) -> Cell:
    """A finished training cell of zbc; its policies are fresh, all of their styles marked as trained."""
    one = training(settings, demos, "zbc")
    for seed in one.definition["seeds"]:
        policy = make_tiny_policy("zbc", seed=seed)
        policy.styles.trained[:] = 1
        save_checkpoint(policy, small_maze_meta, checkpoint_folder(one, store, seed))
    store.write(one, {}, 0.0)
    return one


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
        ("policy_options", {"hidden_dim": 17}),
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


def test_only_the_last_checkpoint_of_a_training_is_kept(tmp_path):
    """Also where a killed run has left a half-made link."""
    checkpoints = tmp_path / "checkpoints"
    for step in ("000010", "000020"):
        (checkpoints / step).mkdir(parents=True)
    (checkpoints / "last").symlink_to("000020")
    (checkpoints / ".last.7").symlink_to("000010")
    _keep_the_last_checkpoint(tmp_path)
    assert sorted(path.name for path in checkpoints.iterdir()) == ["000020", "last"]


def test_names_tell_what_differs(settings, demos):
    """Numbers short, words as they are; options of the settings, too."""
    differing = {"beta": 3.0, "corrective": "demos", "residual": False, "style_dim": 4}
    assert variant_name("wzbc", differing) == "wzbc beta=3 corrective=demos residual=False style_dim=4"
    assert training(settings, demos, "zbc").labels.policy == "zbc hidden_dim=16"
    both = training(settings, demos, "zbc", {"corrective": "demos"})
    assert both.labels.policy == "zbc hidden_dim=16 corrective=demos"


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


def test_training_seeds_never_share_an_environment_seed():
    """However many rollouts are allowed."""
    first = [environment_seed(1000, seed) for seed in range(5)]
    assert all(b - a >= MAX_ROLLOUTS for a, b in itertools.pairwise(first))
    with pytest.raises(ValueError, match=r"n_rollouts=100001: expected at most 100,000"):
        ReproductionSettings(n_rollouts=MAX_ROLLOUTS + 1)


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


def test_a_training_that_outlives_its_command_keeps_others_out(store):
    """The lock is held as long as a process has its descriptor, and freed when the last one is killed."""
    with store.lock(cell()) as descriptor:
        orphan = subprocess.Popen([sys.executable, "-c", "input()"], pass_fds=(descriptor,), stdin=-1)
    waiting = """if True:
        import sys
        from pathlib import Path
        from lerobot_swr.reproduction.cells import Cell, Labels, Store
        with Store(Path(sys.argv[1])).lock(Cell("similarity", Labels("data", "", "similarity"), {})):
            print("in")
    """
    other = subprocess.Popen([sys.executable, "-c", waiting, store.root], stdout=-1, text=True)
    with pytest.raises(subprocess.TimeoutExpired):
        other.wait(timeout=2)
    os.kill(orphan.pid, signal.SIGKILL)
    orphan.wait()
    assert other.communicate(timeout=60)[0] == "in\n"


def test_every_style_is_used_equally_often(settings, demos):
    """Stratified rollouts are a multiple of the demonstrations, unless there are more of these."""
    for n_rollouts, expected in ((12, 12), (17, 12), (5, 5)):
        changed = dataclasses.replace(settings, n_rollouts=n_rollouts)
        one = evaluation(changed, demos, training(changed, demos, "zbc"), "x")
        assert one.definition["protocols"] == {"uniform": n_rollouts, "stratified": expected}


def test_contracting_shares_its_plain_trainings_and_their_measurements(settings, demos):
    """All that robustness measures on zbc and wzbc is the same cell; corrective ones train as long."""
    suites = {name: set(suite_cells(name, settings, [demos])) for name in ("robustness", "contracting")}
    plain = {cell for cell in suites["robustness"] if cell.labels.policy.split(" ")[0] in ("zbc", "wzbc")}
    assert plain <= suites["contracting"]
    trained = [cell for cell in suites["contracting"] if cell.kind == "train"]
    chosen = sorted((c.definition["policy"], c.definition["config"]["corrective"]) for c in trained)
    corrective = [("wzbc", "noise"), ("zbc", "demos"), ("zbc", "noise")]
    assert chosen == sorted([("wzbc", "none"), ("zbc", "none"), *corrective])
    assert {(c.definition["steps"], c.definition["batch_size"]) for c in trained} == {(20, 16)}


def test_the_other_wzbc_are_trained_on_spread_out_alone(settings, demos):
    """p = 0.95 and beta = 3 in the suite robustness."""
    named = {
        name: {cell.labels.policy for cell in suite_cells("robustness", settings, [d])}
        for name, d in (("a", demos), ("b", dataclasses.replace(demos, name="medium_maze-spread_out")))
    }
    assert {policy.replace(" hidden_dim=16", "") for policy in named["b"] - named["a"]} == {
        "wzbc p=0.95",
        "wzbc beta=3",
    }


def test_the_arms_tasks_are_perturbed_as_their_environment_offers(settings, demos):
    """Shifted starts, noisy actions and, for aligning, a pushed box; the plain task first."""
    for task, pushes in (("avoiding", set()), ("aligning", {0.02, 0.05})):
        arm = dataclasses.replace(demos, env={"type": "d3il", "task": task})
        cells = [c for c in suite_cells("contracting", settings, [arm]) if c.labels.policy == "playback"]
        envs = [cell.definition["env"] for cell in cells]
        assert cells[0].labels.condition == "deterministic"
        assert {env["start_radius"] for env in envs} == {0.0, 0.02, 0.04}
        assert {env["action_noise"] for env in envs} == {0.0, 0.002, 0.004}
        assert {env["box_push"] for env in envs} == {0.0} | pushes


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


def test_policies_without_styles_are_rolled_out_once(settings, demos):
    """There is nothing to stratify."""
    one = evaluation(settings, demos, training(settings, demos, "bc"), "x")
    assert one.definition["protocols"] == {"uniform": 12}


@pytest.mark.parametrize("name", [name for name in BASELINES if name in known_policies()])
def test_the_recipes_of_other_policies_are_those_of_the_configs(name):
    """configs/ and the suites train the same networks on batches of the same size."""
    recipe = TrainPipelineConfig.from_pretrained(CONFIGS / f"{name}.yaml")
    config = PreTrainedConfig.get_choice_class(name)(
        device="cpu", push_to_hub=False, **BASELINES[name].options
    )
    encoded = [draccus.encode(c, PreTrainedConfig) for c in (config, recipe.policy)]
    assert encoded[0] == encoded[1]
    assert recipe.batch_size == BASELINES[name].batch_size


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suite": "table9"}, r"suite='table9': expected one of table1, "),
        ({"seeds": 0}, r"seeds=0: expected at least 1"),
        ({"policies": []}, r"policies=\[\]: nothing would be left"),
        ({"jobs": 0}, r"jobs=0"),
    ],
)
def test_bad_settings_are_named(options, message):
    """Before anything is made."""
    with pytest.raises(ValueError, match=message):
        ReproductionSettings(**options)


def test_unknown_datasets_and_policies_are_named(tmp_path):
    """With what there is instead."""
    with pytest.raises(ValueError, match=r"'maze9' is neither in .* nor one of the package's: medium_maze"):
        execution.reproduce(ReproductionSettings(suite="table1", datasets=["maze9"], output_dir=tmp_path))
    with pytest.raises(ValueError, match=r"policies=\['zcb'\]: unknown; this installation knows bc, zbc"):
        execution.reproduce(ReproductionSettings(policies=["zcb"], output_dir=tmp_path))


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
        "--policy_options={hidden_dim: 16, num_hidden: 2}",
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
        command = [
            *(sys.executable, "-c", "from lerobot_swr.cli.reproduce import main; main()", "--suite=table1"),
            *(f"--datasets=[{small_maze.name}]", f"--dataset_dir={small_maze.parent}", "--policies=[wzbc]"),
            *("--steps=3000", "--seeds=2", "--n_rollouts=6", "--jobs=2", f"--output_dir={root}"),
        ]
        if name == "killed":
            running = subprocess.Popen(command, start_new_session=True)
            while not list(root.glob("work/train-*/run/seed_1/checkpoints/000300")):
                assert running.poll() is None, "ended before it could be killed"
                time.sleep(0.1)
            kill = os.killpg if everything else os.kill
            kill(running.pid, signal.SIGKILL)
            running.wait()
            assert not list(root.glob("results/train-*"))
        subprocess.run(command, check=True, timeout=600)
        stored = [json.loads(path.read_text()) for path in sorted((root / "results").iterdir())]
        results[name] = [(one["key"], one["result"]) for one in stored]
        weights = [p.read_bytes() for p in sorted(root.rglob("model.safetensors"))]
        results[f"{name} weights"] = weights
    assert results["whole"] == results["killed"]
    assert results["whole weights"] == results["killed weights"]
    assert len(results["whole weights"]) == 2


def test_an_option_that_a_policy_lacks_is_named(settings, demos):
    """bc has no styles: the key, the policy and the way out, not a stack trace."""
    settings = dataclasses.replace(settings, policy_options={"style_dim": 4})
    assert training(settings, demos, "zbc").definition["config"]["style_dim"] == 4
    with pytest.raises(ValueError, match=r"'bc' has no option 'style_dim'; .*--policies"):
        training(settings, demos, "bc")
