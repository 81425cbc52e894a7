"""What users do every day and get wrong: one line says what is wrong, which key, and what to do."""

import errno
import os
import re
import resource
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import save_checkpoint, train_flags
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from odd_datasets import ACTION, STATE, arc, edit_json, feature, metadata, write
from safetensors import SafetensorError

from lerobot_swr.cli import eval as eval_command
from lerobot_swr.cli import styles as styles_command
from lerobot_swr.cli import train as train_command
from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig

SMALL = ("--policy.backbone.hidden_dim=8", "--policy.backbone.num_hidden=1")


def checkpoint(root, folder, policy_type="zbc"):
    """A checkpoint of a small policy with a style for every episode."""
    meta = metadata(root)
    policy = make_policy(
        make_policy_config(policy_type, backbone=MLPConfig(8, 1), device="cpu", push_to_hub=False),
        ds_meta=meta,
    )
    return save_checkpoint(policy, meta, folder)


def refusal(run_command, capsys, command, *flags) -> str:
    """The one line that a command ends with."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ending:
        run_command(command, *flags)
    assert ending.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("error: ")
    return lines[-1]


# --- datasets ---


@pytest.mark.parametrize(
    ("version", "expected"),
    [
        ("v2.1", r"format v2.1, .* python -m lerobot.scripts.convert_dataset_v21_to_v30 .* --root=\S*arcs "),
        ("v2.0", r"format v2.0, .* to v2.1 with an earlier LeRobot, then .*convert_dataset_v21_to_v30"),
        ("v4.0", r"format v4.0, this LeRobot reads v3.0: update lerobot"),
    ],
)
def test_a_dataset_of_another_format_is_told_with_its_conversion(
    plain_arcs, copied_arcs, tmp_path, run_command, capsys, version, expected
):
    """By every command that reads it, with the folder to convert."""
    folder = checkpoint(plain_arcs, tmp_path / "checkpoint")
    edit_json(copied_arcs / "meta/info.json", lambda info: info.update(codebase_version=version))
    add = [folder, f"--add={copied_arcs}", f"--output_dir={tmp_path / 'x'}"]
    look = [f"--policy.path={folder}", f"--dataset.root={copied_arcs}"]
    assert re.search(expected, refusal(run_command, capsys, styles_command.main, *add))
    assert re.search(expected, refusal(run_command, capsys, eval_command.main, *look))
    for policy_type in ("zbc", "act"):
        flags = train_flags(policy_type, copied_arcs, tmp_path / "run", 2)
        assert re.search(expected, refusal(run_command, capsys, train_command.main, *flags))


def test_missing_metadata_are_told(copied_arcs, plain_arcs, tmp_path, run_command, capsys):
    """Instead of a look on the Hub for a dataset that is on this machine."""
    folder = checkpoint(plain_arcs, tmp_path / "checkpoint")
    (copied_arcs / "meta/tasks.parquet").unlink()
    flags = [f"--policy.path={folder}", f"--dataset.root={copied_arcs}"]
    assert "meta/tasks.parquet is missing" in refusal(run_command, capsys, eval_command.main, *flags)


def images(i, t, n):
    """A frame with a picture."""
    return {ACTION: arc(i, t, n), "observation.images.top": np.zeros((8, 8, 3), np.uint8)}


PICTURE = {"dtype": "image", "shape": (8, 8, 3), "names": ["height", "width", "channels"]}


def test_a_dataset_of_pictures_alone_is_told_what_it_has(tmp_path):
    """Renaming would not help, so nobody is sent to rename."""
    root = write(
        tmp_path / "data", {ACTION: feature(2), "observation.images.top": PICTURE}, images, lengths=(2, 2)
    )
    with pytest.raises(
        ValueError, match=r"has: action .*observation.images.top \(image.*pictures alone"
    ) as told:
        make_policy(make_policy_config("zbc", device="cpu"), ds_meta=metadata(root))
    assert "rename" not in str(told.value)


@pytest.mark.parametrize("name", ["state", "observation.qpos", "observation"])
def test_a_state_under_another_name_is_found(tmp_path, name):
    """The features that could be meant are listed, with the advice to rename."""
    root = write(
        tmp_path / "data",
        {name: feature(2), ACTION: feature(2), "next.reward": feature(1)},
        lambda i, t, n: {
            name: arc(i, t, n),
            ACTION: arc(i, t + 1, n),
            "next.reward": np.zeros(1, np.float32),
        },
        lengths=(2, 2),
    )
    with pytest.raises(ValueError, match=rf"needs the feature '{STATE}'.*state is {name}, rename it"):
        make_policy(make_policy_config("zbc", device="cpu"), ds_meta=metadata(root))


def test_the_documented_renaming_makes_it_trainable(tmp_path):
    """The snippet of docs/datasets.md, on a state called observation.qpos."""
    root = write(
        tmp_path / "data",
        {"observation.qpos": feature(2), ACTION: feature(2)},
        lambda i, t, n: {"observation.qpos": arc(i, t, n), ACTION: arc(i, t + 1, n)},
    )
    page = (Path(__file__).parent.parent / "docs/datasets.md").read_text()
    snippet = page.split("```python\n")[2].split("```")[0].replace("DATASET", str(root))
    exec(snippet, {})
    policy = make_policy(make_policy_config("bc", device="cpu"), ds_meta=metadata(root))
    np.testing.assert_array_equal(policy.trajectories.episode(1)[STATE][3], arc(1, 3, 8))


def test_a_moved_dataset_is_told_on_resume(copied_arcs, tmp_path, lerobot_train_command, capsys):
    """With the file that names the old folder, and the flag that gives the new one; which then works."""
    run = tmp_path / "run"
    lerobot_train_command(*train_flags("zbc", copied_arcs, run, 4, "--save_freq=2", *SMALL))
    moved = copied_arcs.rename(tmp_path / "moved")
    resume = [f"--config_path={run}/checkpoints/000002/pretrained_model/train_config.json", "--resume=true"]
    capsys.readouterr()
    with pytest.raises((SystemExit, ValueError)):
        lerobot_train_command(*resume)
    told = capsys.readouterr().err
    assert re.search(
        r"error: dataset.root='\S*arcs', from \S*train_config.json: no such folder.*was it moved\?", told
    )
    lerobot_train_command(*resume, f"--dataset.root={moved}")


def test_a_moved_dataset_is_told_by_the_styles_command(copied_arcs, tmp_path, swr_train, run_command, capsys):
    """It looks for the dataset where the run had it."""
    swr_train(*train_flags("zbc", copied_arcs, tmp_path / "run", 2, "--seeds=0", "--jobs=1", *SMALL))
    folder = tmp_path / "run/seed_0/checkpoints/last/pretrained_model"
    moved = copied_arcs.rename(tmp_path / "moved")
    told = refusal(
        run_command, capsys, styles_command.main, folder, f"--add={moved}", f"--output_dir={tmp_path / 'new'}"
    )
    assert re.search(
        r"dataset.root='\S*arcs', the training dataset of .* was it moved\?.*--dataset.root=", told
    )


def test_a_policy_made_for_training_says_why_it_cannot_act(plain_arcs, tmp_path):
    """Given an evaluation dataset as dataset_meta, it has started new styles."""
    folder = checkpoint(plain_arcs, tmp_path / "checkpoint")
    other = write(tmp_path / "other", lengths=(5, 5, 5))
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy = make_policy(config, ds_meta=metadata(other))
    with pytest.raises(ValueError, match=r"created to be trained on \S*other.*without dataset_meta"):
        policy.select_action({STATE: torch.zeros(1, 2)})


# --- checkpoints and flags ---


def test_a_checkpoint_that_is_not_there_is_told_up_to_where_it_is(plain_arcs, tmp_path, run_command, capsys):
    """Instead of a lecture on names of repositories."""
    (tmp_path / "train/good_run").mkdir(parents=True)
    path = tmp_path / "train/god_run/checkpoints/last/pretrained_model"
    told = refusal(
        run_command, capsys, eval_command.main, f"--policy.path={path}", f"--dataset.root={plain_arcs}"
    )
    assert (
        f"policy.path='{path}': no such folder; {tmp_path}/train exists and has the folders: good_run" in told
    )


def test_a_name_that_the_hub_does_not_know_is_told(plain_arcs, run_command, capsys):
    """What may be a repository is looked for there first."""
    flags = ["--policy.path=somebody/some_policy", f"--dataset.root={plain_arcs}"]
    assert "neither a folder here nor found on the Hub" in refusal(
        run_command, capsys, eval_command.main, *flags
    )


def test_text_is_taken_as_it_is():
    """YAML would decode all of these."""
    given = [
        "x",
        "--filter=task == 'a: b'",
        "--name",
        "007",
        "--rows=3",
        "--forget=null",
        "--filter",
        "'a' in task",
    ]
    import yaml

    quoted = list(with_literal_text(given, ("filter", "name", "forget")))
    assert [quoted[0], quoted[2], quoted[4], quoted[6]] == ["x", "--name", "--rows=3", "--filter"]
    decoded = [yaml.safe_load(text.partition("=")[2] or text) for text in (quoted[5], quoted[3], quoted[7])]
    assert decoded == ["null", "007", "'a' in task"]
    assert yaml.safe_load(quoted[1].partition("=")[2]) == "task == 'a: b'"


@pytest.mark.parametrize("name", ["007", "null", "yes", "a: b", "[x]", "it's"])
def test_names_of_filters_are_kept_literally(plain_arcs, tmp_path, run_command, capsys, name):
    """Saved, listed and forgotten under the very name, for a filter that looks like YAML."""
    folder = checkpoint(plain_arcs, tmp_path / "checkpoint")
    run_command(styles_command.main, folder, "--filter=task != 'x: y' # short", "--name", name)
    run_command(styles_command.main, folder)
    assert f"  {name!r}: task != 'x: y' # short  (4 styles)" in capsys.readouterr().out
    run_command(styles_command.main, folder, f"--forget={name}")
    assert "named filters: none" in capsys.readouterr().out


# --- interruptions ---


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted; what was saved before is whole"),
        (OSError(errno.ENOSPC, "No space left on device", "x.json"), 2, "error: the disk is full (.*x.json"),
        (SafetensorError("I/O error: No space left on device (os error 28)"), 2, "error: the disk is full"),
    ],
)
def test_ctrl_c_and_a_full_disk_end_in_one_line(error, code, message, capsys):
    """With what has become of the work, and no stack trace."""

    @explain_errors
    def command():
        raise error

    with pytest.raises(SystemExit) as ending:
        command()
    assert ending.value.code == code
    told = capsys.readouterr().err.strip()
    assert re.match(message.replace("(", r"\(").replace(".*x", ".*x"), told)
    assert len(told.splitlines()) == 1


@pytest.fixture
def start_training(plain_arcs):
    """Starts ``lerobot-swr-train`` in a process group of its own, as in a terminal.

    Gives the process, and what it will have said when it has ended.
    """
    started: list[subprocess.Popen] = []

    def start(run: Path, *flags: str, largest_file: int = -1) -> tuple[subprocess.Popen, Future]:
        def prepare():
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # background jobs of a shell ignore it
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))

        command = [sys.executable, "-c", "from lerobot_swr.cli.train import main; main()"]
        process = subprocess.Popen(
            [*command, *train_flags("zbc", plain_arcs, run, 100_000, *SMALL, "--seeds=0,1", *flags)],
            env={**os.environ, "HF_HUB_OFFLINE": "1"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=prepare,
        )
        started.append(process)
        assert process.stderr is not None
        return process, ThreadPoolExecutor(1).submit(process.stderr.read)  # a full pipe would stop it

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)


def last_words(process: subprocess.Popen, told: Future) -> str:
    """What a process says last, when it has ended."""
    process.wait(timeout=600)
    said = told.result().replace("\r", "\n").strip()
    assert "Traceback" not in said.split("[end of libtorchcodec loading traceback]")[-1]
    return said.splitlines()[-1]


@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_in_training_leaves_a_whole_checkpoint_and_no_stack_trace(start_training, tmp_path, jobs):
    """The terminal sends it to every process of the command."""
    run = tmp_path / "run"
    process, told = start_training(run, "--save_freq=50", f"--jobs={jobs}")
    while not (run / "seed_1/checkpoints/last").exists():
        assert process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    assert last_words(process, told).startswith("interrupted;")
    assert process.returncode == 130
    assert (run / "seed_1/checkpoints/last/pretrained_model/model.safetensors").is_file()


def test_a_disk_that_is_full_in_training_is_told(start_training, tmp_path):
    """Here no file may be larger than a few kilobytes, which the weights are."""
    process, told = start_training(
        tmp_path / "run", "--save_freq=1", "--jobs=1", "--policy.backbone.hidden_dim=64", largest_file=9000
    )
    assert last_words(process, told).startswith("error: the disk is full")
    assert process.returncode == 2
    assert not list(tmp_path.glob("run/seed_*/checkpoints/0*"))
