"""A session: one environment, a person's or a policy's actions, and what is recorded of it."""

import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import save_checkpoint
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

from lerobot_swr.demos.writer import DatasetKind, DemonstrationWriter
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.env import Maze2DEnv
from lerobot_swr.envs.pointer import Command
from lerobot_swr.evaluation.checkpoint import load_checkpoint
from lerobot_swr.interactive.driver import Driver
from lerobot_swr.interactive.messages import unpack_frame
from lerobot_swr.interactive.pace import Pace
from lerobot_swr.interactive.recorder import Recorder, dataset_kind
from lerobot_swr.interactive.session import Session
from lerobot_swr.interactive.steering import Steering

SMALL = Maze2DEnvConfig(task="small")
WAYS = {"10": [(0.27, 0.45), (0.27, 0.6), (0.5, 0.92)], "20": [(0.73, 0.45), (0.73, 0.6), (0.5, 0.92)]}


def walk(session: Session, behavior: str) -> None:
    """Lead the agent through a door to the goal, as a pointer would."""
    session.reset()
    for x, y in WAYS[behavior]:
        while (
            not session.scene.over
            and np.abs(session.scene.observations["observation.state"] - (x, y)).max() > 0.01
        ):
            session.step(session.follow(Command((x, 1 - y))))


def test_what_is_recorded_is_what_the_environment_did():
    """Replaying the recorded actions in a fresh environment gives the recorded states, to the last bit."""
    session = Session(SMALL)
    walk(session, "10")
    assert session.scene.success
    assert session.behavior() == "10"
    recording = session.recording()
    states, actions = recording.observations["observation.state"], recording.actions
    env = Maze2DEnv("small")
    observed = [env.reset(seed=0)[0]["agent_pos"]]
    observed += [env.step(action)[0]["agent_pos"] for action in actions[:-1]]
    np.testing.assert_array_equal(states, np.stack(observed))
    assert len(actions) == session.scene.steps + 1
    assert (actions[-1] == 0).all()


def test_an_episode_that_is_over_takes_no_more_steps():
    """Nothing is recorded beyond its end."""
    session = Session(SMALL)
    walk(session, "20")
    with pytest.raises(RuntimeError, match="reset"):
        session.step(np.zeros(2))


@pytest.fixture
def checkpoint(make_tiny_policy, small_maze_meta, tmp_path):
    """An untrained policy on the small maze, loaded as the page loads it."""
    folder = save_checkpoint(make_tiny_policy("zbc"), small_maze_meta, tmp_path / "checkpoint")
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return load_checkpoint(config)


def test_the_policy_acts_as_in_lerobots_loop_and_is_steered_from_the_next_step(checkpoint):
    """Each action is the postprocessed one of the style that was requested before it."""
    session = Session(SMALL, checkpoint)
    for style in (3, 3, 1, 5):
        session.steer(style)
        state = {key: torch.from_numpy(v)[None] for key, v in session.scene.observations.items()}
        policy = checkpoint.policy
        outputs = policy.backbone(checkpoint.preprocessor(state), policy.styles.embedding.weight[[style]])
        expected = checkpoint.postprocessor(outputs)[0].detach().numpy()
        scene = session.step()
        assert scene.style == style
        np.testing.assert_allclose(session.recording().actions[-2], expected, atol=1e-6)


def test_without_a_policy_nobody_can_be_steered():
    """A person acts, or nobody."""
    session = Session(SMALL)
    with pytest.raises(ValueError, match=r"--policy\.path"):
        session.steer(1)
    with pytest.raises(RuntimeError, match="no policy"):
        session.step()


# --- Saving ---


def recorded(root) -> list[np.ndarray]:
    """The states of each episode of a dataset, read as users read it."""
    dataset = LeRobotDataset("local/x", root=root)
    episodes = [frame["episode_index"].item() for frame in dataset]
    states = np.stack([frame["observation.state"].numpy() for frame in dataset])
    return [states[np.array(episodes) == i] for i in range(max(episodes) + 1)]


def test_kept_episodes_are_saved_and_appended(tmp_path):
    """Two are saved, one is added later: three ordinary episodes, named as this package's."""
    session, root = Session(SMALL), tmp_path / "mine"
    recorder, expected = Recorder(session, root), []
    for behavior in ("10", "20"):
        walk(session, behavior)
        recorder.keep()
        expected.append(session.recording().observations["observation.state"])
    assert recorder.kept == {"10": 1, "20": 1}
    assert recorder.save() == 2
    recorder.writer.close()

    recorder = Recorder(session, root)
    assert recorder.saved == {"10": 1, "20": 1}
    walk(session, "10")
    recorder.keep()
    expected.append(session.recording().observations["observation.state"])
    assert recorder.save() == 3
    recorder.writer.close()
    for states, other in zip(recorded(root), expected, strict=True):
        np.testing.assert_array_equal(states, other)
    meta = LeRobotDataset("local/x", root=root).meta
    assert meta.robot_type == "maze2d_small"
    assert meta.features["action"]["names"] == ["dx", "dy"]
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_only_successes_can_be_kept_and_the_last_one_taken_back(tmp_path):
    """Until it is saved."""
    session = Session(SMALL)
    recorder = Recorder(session, tmp_path / "mine")
    with pytest.raises(ValueError, match="only a success"):
        recorder.keep()
    walk(session, "10")
    recorder.keep()
    recorder.undo()
    assert not recorder.kept
    with pytest.raises(ValueError, match="nothing to take back"):
        recorder.undo()


KIND = DatasetKind(20, "maze2d_small", "walk", {"observation.state": "xy", "action": ("dx", "dy")})


def make_demonstration(start: float):
    session = Session(SMALL)
    walk(session, "10")
    recording = session.recording()
    states = recording.observations["observation.state"] + np.float32(start)
    return type(recording)({"observation.state": states}, recording.actions)


@pytest.mark.parametrize("place", ["_build", "_put_in_place", "rename", "rmtree"])
def test_a_kill_at_any_moment_of_saving_loses_nothing_and_doubles_nothing(tmp_path, monkeypatch, place):
    """The next writer finds each kept demonstration once, in the dataset or still kept."""
    root = tmp_path / "mine"
    first = DemonstrationWriter(root, KIND)
    first.keep(make_demonstration(0))
    first.save()
    first.keep(make_demonstration(1))

    class Killed(BaseException):
        pass

    def die(*args, **kwargs):
        raise Killed

    with monkeypatch.context() as patch:
        if place in ("_build", "_put_in_place"):
            patch.setattr(first, place, die)
        elif place == "rename":  # the old dataset is aside, the new one not yet there
            patch.setattr("lerobot_swr.demos.writer._rename", _dying_at_second_call(Killed))
        else:  # the new one is there, what is left to do is cleaning up
            patch.setattr("lerobot_swr.demos.writer.shutil.rmtree", die)
        with pytest.raises(Killed):
            first.save()
    first.close()  # the system does so with a killed program's locks

    second = DemonstrationWriter(root, KIND)
    assert second.n_saved + len(second.kept()) == 2
    assert second.save() == 2
    assert [episode[0, 0] for episode in recorded(root)] == [0.5, 1.5]
    assert [path.name for path in tmp_path.iterdir() if "lock" not in path.name] == ["mine"]


def test_what_was_kept_of_another_kind_is_not_mixed_in(tmp_path):
    """Demonstrations that were kept elsewhere and not saved; they stay where they are."""
    root = tmp_path / "mine"
    writer = DemonstrationWriter(root, KIND)
    writer.keep(make_demonstration(0))
    writer.close()
    other = replace(KIND, robot_type="maze2d_large")
    with pytest.raises(ValueError, match=r"1 demonstrations kept for it and not saved have robot_type='"):
        DemonstrationWriter(root, other)
    assert DemonstrationWriter(root, KIND).save() == 1


def _dying_at_second_call(error):
    calls = []

    def rename(old, new):
        calls.append(old)
        if len(calls) == 2:
            raise error
        old.rename(new)

    return rename


def test_folders_that_are_something_else_are_refused(tmp_path):
    """Another kind of dataset, no dataset, or one that somebody records into."""
    root = tmp_path / "mine"
    writer = DemonstrationWriter(root, KIND)
    with pytest.raises(ValueError, match="another program is recording"):
        DemonstrationWriter(root, KIND)
    writer.keep(make_demonstration(0))
    writer.save()
    writer.close()
    other = DatasetKind(10, "maze2d_small", "walk", KIND.features)
    with pytest.raises(ValueError, match=r"has fps=20, what is recorded here fps=10"):
        DemonstrationWriter(root, other)
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("a")
    with pytest.raises(FileExistsError, match="is not a LeRobot dataset"):
        DemonstrationWriter(tmp_path / "notes", KIND)


def test_an_environment_without_own_datasets_gets_names_for_its_dimensions():
    """From its observations and actions."""
    config = Maze2DEnvConfig(task="small")
    kind = dataset_kind(Session(config))
    assert kind.features["observation.state"] == ("x", "y")
    assert (kind.fps, kind.robot_type) == (20, "maze2d_small")


# --- The beat ---


class Clock:
    """Time that passes only when somebody sleeps or works."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        """Now."""
        return self.now

    def sleep(self, seconds):
        """Let time pass."""
        self.now += seconds


def test_the_beat_keeps_its_rate_and_counts_what_is_late():
    """Work shorter than a beat is waited out, a longer one counted and caught up with: no drift."""
    clock = Clock()
    pace = Pace(10, clock, clock.sleep)
    for work in (0.02, 0.05, 0.13, 0.02, 0.09):
        clock.now += work
        pace.wait()
    assert clock.now == pytest.approx(0.52)  # the first beat begins when its work is done
    assert (pace.beats, pace.late) == (5, 1)


def test_after_a_long_halt_nothing_is_caught_up_with():
    """The beat starts anew instead of running at double speed."""
    clock = Clock()
    pace = Pace(10, clock, clock.sleep)
    pace.wait()
    clock.now += 3
    pace.wait()
    start = clock.now
    pace.wait()
    assert clock.now - start == pytest.approx(0.1)


class Heard(list):
    """What a driver tells."""

    def events(self, kind):
        """Those of a type."""
        return [news for news in self if isinstance(news, dict) and news["type"] == kind]

    def frames(self):
        """What is said of each picture."""
        return [unpack_frame(news)[0] for news in self if isinstance(news, bytes)]


def test_the_driver_records_by_what_the_page_says(tmp_path):
    """Waits for the first move, runs to the goal, keeps, saves; the histogram follows."""
    session, heard = Session(SMALL), Heard()
    driver = Driver(session, heard.append, recorder=Recorder(session, tmp_path / "mine"))
    driver.beat()
    driver.beat()
    assert [frame["phase"] for frame in heard.frames()] == ["waiting"]
    for x, y in WAYS["20"]:
        driver.handle({"type": "hand", "place": [x, 1 - y], "push": [0, 0, 0], "n": 1})
        for _ in range(40):
            driver.beat()
    assert heard.frames()[-1]["phase"] == "over"
    assert heard.frames()[-1]["behavior"] == "20"
    assert heard.frames()[-1]["seen"] == 1
    driver.handle({"type": "keep"})
    driver.handle({"type": "keep"})
    assert "only a success" in heard.events("error")[-1]["message"]
    assert heard.events("state")[-1]["recording"]["kept"] == {"20": 1}
    driver.handle({"type": "save"})
    assert heard.events("state")[-1]["recording"]["saved"] == {"20": 1}
    driver.handle({"type": "style", "episodes": [1]})
    assert "no policy to steer" in heard.events("error")[-1]["message"]
    driver.close()


def test_the_driver_steers_and_lets_a_hand_drag(checkpoint):
    """Requests show in the next frame; a held pointer overrides the policy; refusals change nothing."""
    session, heard = Session(SMALL, checkpoint), Heard()
    driver = Driver(session, heard.append, steering=Steering(session))
    driver.beat()
    driver.handle({"type": "style", "episodes": [4]})
    driver.beat()
    assert heard.frames()[-1]["style"] == 4
    assert heard.events("state")[-1]["steering"]["flag"] == "--policy.style_episodes='[4]'"
    driver.handle({"type": "filter", "text": "behavior == '10'"})
    driver.beat()
    flag = heard.events("state")[-1]["steering"]["flag"]
    assert shlex.split(flag) == ["--policy.style_filter=behavior == '10'"]
    labels = checkpoint.policy.styles.table.columns["behavior"]
    assert labels[heard.frames()[-1]["style"]] == "10" == heard.frames()[-1]["requested"]
    driver.handle({"type": "filter", "text": "lenght > 3"})
    assert "unknown name 'lenght'" in heard.events("error")[-1]["message"]
    before = session.scene.observations["observation.state"]
    driver.handle({"type": "hand", "place": [0.9, 1 - before[1]], "push": [0, 0, 0], "n": 2})
    driver.beat()
    moved = session.scene.observations["observation.state"] - before
    np.testing.assert_allclose(moved, [0.02, 0], atol=1e-6)
    driver.handle({"type": "pause", "on": True})
    driver.beat()
    steps = session.scene.steps
    driver.beat()
    assert session.scene.steps == steps
    driver.handle({"type": "keep"})
    assert "nothing is recorded" in heard.events("error")[-1]["message"]


def test_the_map_shows_what_the_table_knows(checkpoint):
    """Every trained style once, with its columns."""
    seen = Steering(Session(SMALL, checkpoint)).map()
    assert seen["episodes"] == list(range(6))
    assert seen["color"] == "behavior"
    assert np.shape(seen["projections"]["PCA"]) == (6, 2)
