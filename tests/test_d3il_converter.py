"""The converter of the D3IL benchmark's recordings, on files written here in its format."""

import os
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset

from lerobot_swr.cli.dataset import main
from lerobot_swr.demos.d3il_avoiding import SCATTERED_BEHAVIORS
from lerobot_swr.demos.d3il_converter import UNBALANCED_COUNTS, convert_recording, recorded_recipe, unbalanced
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.restricted_pickle import UnsafePickleError, load_recording
from lerobot_swr.envs.d3il.behavior import AVOIDING_BEHAVIORS
from lerobot_swr.envs.d3il.configuration_d3il import GYM_IDS

TURNED = [np.cos(0.2), 0.0, 0.0, np.sin(0.2)]


def avoiding_recording(n_states=40, x=0.4):
    """A tool that moves straight beyond the finish line, with the actual position lagging behind."""
    y = np.linspace(-0.28, 0.4, n_states)
    desired = np.stack([np.full(n_states, x), y, np.full(n_states, 0.12)], axis=1)
    return {
        "robot": {
            "des_c_pos": desired,
            "c_pos": desired - [0.0, 0.005, 0.0],
            "j_pos": np.zeros((n_states, 7)),
        }
    }


def aligning_recording(n_states=30):
    """A box that slides onto its target, pushed from outside."""
    y = np.linspace(0.0, 0.3, n_states)
    box = np.stack([np.full(n_states, 0.5), y, np.zeros(n_states)], axis=1)
    tool = box + np.array([0.0, -0.06, 0.15])
    quat = np.tile(TURNED, (n_states, 1))
    return {
        "robot": {"des_c_pos": tool, "c_pos": tool},
        "push-box": {"pos": box, "quat": quat},
        "target-box": {"pos": np.tile([0.5, 0.3, 0.0], (n_states, 1)), "quat": quat},
    }


def dump(path, value, protocol=4):
    """Write a pickle, as the benchmark does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("module", [b"numpy.core", b"numpy._core"])
def test_every_protocol_and_numpy_version_is_read(tmp_path, protocol, module):
    """Recordings pickled by numpy 1 or 2, by any protocol, give the arrays that were written."""
    recording = avoiding_recording(5)
    recording["robot"]["fortran"] = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    recording["robot"]["big_endian"] = np.arange(3, dtype=">i4")
    recording["robot"]["scalar"] = np.float64(1.5)
    data = pickle.dumps(recording, protocol=protocol)
    data = data.replace(b"numpy._core", b"numpy.core") if protocol < 4 else data
    if protocol < 4:  # names are stored without their length there
        data = data.replace(b"numpy.core", module)
    elif module == b"numpy.core":
        data = _renamed(data, b"numpy._core", b"numpy.core")
    path = tmp_path / "recording.pkl"
    path.write_bytes(data)

    loaded = load_recording(path)

    assert loaded["robot"]["scalar"] == 1.5
    for key, value in recording["robot"].items():
        np.testing.assert_array_equal(loaded["robot"][key], value)


def _renamed(data, old, new):
    """Rename modules in a protocol 4+ pickle: length-prefixed strings; the frame's header is dropped."""
    for suffix in (b".multiarray", b".numeric"):
        before, after = old + suffix, new + suffix
        data = data.replace(bytes([len(before)]) + before, bytes([len(after)]) + after)
    assert data[2:3] == b"\x95"
    return data[:2] + data[11:]  # without the frame's length, which is optional


class Hostile:
    """Asks the unpickler to call something."""

    def __init__(self, function, *arguments):
        self.call = (function, arguments)

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    ("hostile", "named"),
    [
        (Hostile(os.system, "touch pwned"), "system"),
        (Hostile(eval, "__import__('pathlib').Path('pwned').touch()"), "eval"),
        (Hostile(getattr, {}, "update"), "getattr"),
        (Hostile(np.load, "pwned"), "load"),
        (Hostile(bytearray, 10**12), "bytearray"),
        (np.array([{"an": "object"}], dtype=object), "dtype"),
        (np.zeros(2, dtype=[("a", "f8"), ("b", "i4")]), "dtype"),
        (np.ma.masked_array([1.0], mask=[True]), "numpy.ma"),
        (subprocess.Popen, "Popen"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_hostile_recordings_are_refused(tmp_path, monkeypatch, hostile, named, protocol):
    """Whatever is not a plain array or container is refused with the file's name, and nothing is run."""
    monkeypatch.chdir(tmp_path)
    recording = avoiding_recording()
    recording["robot"]["extra"] = hostile
    path = dump(tmp_path / "in" / "evil.pkl", recording, protocol)
    with pytest.raises(UnsafePickleError, match=rf"evil\.pkl: refused.*{named}"):
        load_recording(path)
    assert not (tmp_path / "pwned").exists()


def test_lying_array_headers_are_refused(tmp_path):
    """An array whose shape does not fit its bytes is an error, not a read beyond them."""
    data = pickle.dumps({"a": np.zeros(3)}, protocol=2)
    assert data.count(b"K\x03\x85") == 1  # the shape (3,)
    path = tmp_path / "lying.pkl"
    path.write_bytes(data.replace(b"K\x03\x85", b"K\x7f\x85"))
    with pytest.raises(ValueError, match=r"lying\.pkl: not a readable recording.*shape \(127,\)"):
        load_recording(path)


@pytest.mark.parametrize("content", [b"", b"not a pickle", pickle.dumps(avoiding_recording())[:300]])
def test_damaged_files_are_named(tmp_path, content):
    """Empty, foreign and truncated files are reported by name."""
    path = tmp_path / "damaged.pkl"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"damaged\.pkl: not a readable recording"):
        load_recording(path)


def test_observations_and_actions(tmp_path):
    """What was measured is taken a frame later than what was desired, whose differences are the actions."""
    recording = aligning_recording()
    demonstration = convert_recording(dump(tmp_path / "a.pkl", recording), "aligning")
    robot, box = recording["robot"], recording["push-box"]
    state = demonstration.observations["observation.state"]
    scene = demonstration.observations["observation.environment_state"]
    assert state.shape == (29, 6)
    assert scene.shape == (29, 14)
    np.testing.assert_allclose(state[7], [*robot["des_c_pos"][7], *robot["c_pos"][8]], rtol=1e-6)
    np.testing.assert_allclose(scene[7, :7], [*box["pos"][8], *box["quat"][8]], rtol=1e-6)
    np.testing.assert_allclose(
        demonstration.actions[7], robot["des_c_pos"][8] - robot["des_c_pos"][7], rtol=1e-4, atol=1e-9
    )


def recorded_as_the_benchmark_does(env, actions):
    """Observations of an episode of our environment, and its recording in the benchmark's timing.

    The benchmark notes, before each step's physics, the position that is desired from then on and everything
    as it was measured before; one more frame, of a step without a move, ends the recording.
    """
    n = env.action_space.shape[0]
    observations = [env.reset(seed=3)[0], *(env.step(action)[0] for action in actions)]
    start = np.array(env._start_tool)
    desired = start + np.pad(np.cumsum([[0.0] * n, *actions, [0.0] * n], axis=0), ((0, 0), (0, 3 - n)))
    measured = [observations[0], *observations]  # before the first step everything is at rest
    tool = np.stack([m["agent_pos"][n:] for m in measured]).astype(np.float64)
    scene = np.stack([m["environment_state"] for m in measured]).astype(np.float64)
    recording = {"robot": {"des_c_pos": desired, "c_pos": np.pad(tool, ((0, 0), (0, 3 - n)))}}
    if n == 3:
        recording["push-box"] = {"pos": scene[:, :3], "quat": scene[:, 3:7]}
        recording["target-box"] = {"pos": scene[:, 7:10], "quat": scene[:, 10:14]}
    return observations, recording


@pytest.mark.parametrize("task", ["avoiding", "aligning"])
def test_a_recording_becomes_what_the_environment_observes(tmp_path, task):
    """Our environment, recorded in the benchmark's timing and converted, gives back its own observations."""
    pytest.importorskip("mujoco")
    env = gym.make(f"lerobot_swr.envs.d3il.configuration_d3il:{GYM_IDS[task]}").unwrapped
    rng = np.random.default_rng(0)
    actions = rng.uniform(0, 0.008, (30, env.action_space.shape[0])) * (1, 1, -1)[: env.action_space.shape[0]]
    actions[10:13] = 0  # a pause
    observations, recording = recorded_as_the_benchmark_does(env, actions)

    converted = convert_recording(dump(tmp_path / "a.pkl", recording), task)

    assert len(converted.actions) == len(observations)
    np.testing.assert_allclose(converted.actions[:-1], actions, atol=1e-7)
    for ours, key in (("agent_pos", "state"), ("environment_state", "environment_state")):
        expected = np.stack([observation[ours] for observation in observations])
        np.testing.assert_allclose(converted.observations[f"observation.{key}"], expected, atol=1e-6)


def without(recording, group, key=None):
    """The recording with something missing."""
    if key is None:
        del recording[group]
    else:
        del recording[group][key]
    return recording


def replaced(recording, group, key, value):
    """The recording with another array."""
    recording[group][key] = value
    return recording


@pytest.mark.parametrize(
    ("recording", "message"),
    [
        (without(aligning_recording(), "push-box"), "no dictionary 'push-box'"),
        (without(aligning_recording(), "robot", "c_pos"), "no robot/c_pos in it; it has des_c_pos"),
        (replaced(aligning_recording(), "push-box", "quat", np.zeros((30, 3))), r"quat has shape \(30, 3\)"),
        (replaced(aligning_recording(), "robot", "c_pos", np.zeros((29, 3))), r"c_pos has shape \(29, 3\)"),
        (replaced(aligning_recording(), "robot", "c_pos", np.full((30, 3), np.nan)), "robot/c_pos holds NaN"),
        (replaced(aligning_recording(), "robot", "c_pos", "abc"), "robot/c_pos is not an array of numbers"),
        ([1, 2, 3], "no dictionary 'robot'"),
        (aligning_recording(1), "has 1 states"),
    ],
)  # fmt: skip
def test_wrong_recordings_name_file_and_key(tmp_path, recording, message):
    """Missing keys, wrong shapes and NaN are errors that name the file and the key."""
    path = dump(tmp_path / "wrong.pkl", recording)
    with pytest.raises(ValueError, match=rf"wrong\.pkl: .*{message}"):
        convert_recording(path, "aligning")


def test_dataset_of_recordings(tmp_path):
    """All recordings of a folder become a LeRobot dataset with the scripted datasets' features and labels."""
    for i, x in enumerate((0.4, 0.3)):
        dump(tmp_path / "in" / f"env_{i}.pkl", avoiding_recording(40 + i, x))
    dump(tmp_path / "in" / "train_files.pkl", ["env_1.pkl"])
    recipe = recorded_recipe(tmp_path / "in", "avoiding")
    histogram = write_dataset(recipe, tmp_path / "out")
    assert histogram == {"top-top-midtop": 1, "top-top-top": 1}
    dataset = LeRobotDataset("local/recorded", root=tmp_path / "out")
    assert dataset.num_episodes == 2
    assert dataset.num_frames == 39 + 40
    assert dataset.features["observation.environment_state"]["shape"] == (19,)
    listed = recorded_recipe(tmp_path / "in", "avoiding", tmp_path / "in" / "train_files.pkl")
    assert listed.n_episodes == 1


def test_the_unbalanced_selection_keeps_its_counts():
    """Every behaviour stays, as often as its count says or there are recordings; the seed chooses which."""
    labels = [behavior for behavior in AVOIDING_BEHAVIORS for _ in range(4)]
    del labels[0]  # three are left of the first behaviour
    chosen = unbalanced(labels, seed=0)
    assert chosen == sorted(set(chosen))
    assert chosen == unbalanced(labels, seed=0)
    assert chosen != unbalanced(labels, seed=1)
    kept = [sum(labels[i] == behavior for i in chosen) for behavior in AVOIDING_BEHAVIORS]
    assert kept[0] == 3
    assert sorted(kept, reverse=True) == sorted([*UNBALANCED_COUNTS[1:], 3], reverse=True)


def test_a_selection_is_written_as_a_dataset(tmp_path):
    """`--task=unbalanced_avoiding` keeps of a way's recordings as many as its count says."""
    for i in range(5):
        dump(tmp_path / "in" / f"env_{i}.pkl", avoiding_recording(40 + i, x=0.4))
    recipe = recorded_recipe(tmp_path / "in", "unbalanced_avoiding")
    expected = UNBALANCED_COUNTS[SCATTERED_BEHAVIORS.index("top-top-midtop")]
    assert recipe.name == "d3il_human_unbalanced_avoiding"
    assert recipe.n_episodes == expected < 5
    assert write_dataset(recipe, tmp_path / "out") == {"top-top-midtop": expected}


def test_recordings_that_all_failed_make_no_selection(tmp_path):
    """The message names the folder and what they show, instead of an empty dataset."""
    dump(
        tmp_path / "in" / "env_0.pkl",
        {"robot": {k: v[:20] for k, v in avoiding_recording()["robot"].items()}},
    )
    with pytest.raises(ValueError, match=r"none of these 1 recordings passes the obstacles; they show unfin"):
        recorded_recipe(tmp_path / "in", "unbalanced_avoiding")


def test_one_bad_recording_leaves_no_dataset(tmp_path):
    """A recording that cannot be converted stops the command, and nothing half-written stays."""
    dump(tmp_path / "in" / "a.pkl", avoiding_recording())
    dump(tmp_path / "in" / "b.pkl", without(avoiding_recording(), "robot", "c_pos"))
    with pytest.raises(ValueError, match=r"b\.pkl: no robot/c_pos"):
        write_dataset(recorded_recipe(tmp_path / "in", "avoiding"), tmp_path / "out" / "dataset")
    assert list((tmp_path / "out").iterdir()) == []


def test_wrong_folders_and_lists(tmp_path):
    """Wrong tasks, folders and lists are explained."""
    with pytest.raises(ValueError, match=r"task='stacking'.*avoiding, aligning, unbalanced_avoiding"):
        recorded_recipe(tmp_path, "stacking")
    with pytest.raises(FileNotFoundError, match="no such folder"):
        recorded_recipe(tmp_path / "nowhere", "avoiding")
    with pytest.raises(ValueError, match="no recordings"):
        recorded_recipe(tmp_path, "avoiding")
    with pytest.raises(FileNotFoundError, match=r"'gone\.pkl', which is not in"):
        recorded_recipe(tmp_path, "avoiding", dump(tmp_path / "list.pkl", ["gone.pkl"]))
    with pytest.raises(ValueError, match="is not a name inside the folder"):
        recorded_recipe(tmp_path, "avoiding", dump(tmp_path / "list.pkl", ["../gone.pkl"]))
    with pytest.raises(ValueError, match="expected a pickled list of file names"):
        recorded_recipe(tmp_path, "avoiding", dump(tmp_path / "list.pkl", {"a": 1}))


def test_command_line(tmp_path, run_command, capsys):
    """`lerobot-swr-dataset --from_d3il` writes the dataset, prints its histogram and replays it."""
    pytest.importorskip("mujoco")
    dump(tmp_path / "in" / "a.pkl", aligning_recording())
    run_command(main, f"--from_d3il={tmp_path / 'in'}", "--task=aligning", f"--root={tmp_path / 'out'}")
    output = capsys.readouterr().out
    assert "1 episodes of d3il_human_aligning" in output
    assert "outside" in output
    assert "replayed: 0 of 1 succeed" in output


def test_without_the_simulator_the_command_says_what_to_install(tmp_path, run_command, capsys, monkeypatch):
    """The dataset is written all the same."""
    for name in [name for name in sys.modules if name.startswith("lerobot_swr.envs.d3il.")]:
        if not name.endswith("configuration_d3il"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    dump(tmp_path / "in" / "a.pkl", avoiding_recording())
    run_command(main, f"--from_d3il={tmp_path / 'in'}", "--task=avoiding", f"--root={tmp_path / 'out'}")
    assert "not replayed in the simulator" in (output := capsys.readouterr().out)
    assert "pip install 'lerobot_policy_swr[d3il]'" in output
    assert (tmp_path / "out" / "meta" / "info.json").is_file()
