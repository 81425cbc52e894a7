"""The page in a real browser, driven as a person would."""

import contextlib
import threading

import numpy as np
import pytest
import uvicorn
from browser import Person, open_browser
from conftest import train_flags
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDataset

from lerobot_swr.cli import train as train_command
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.env import Maze2DEnv
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.interactive import server as server_module
from lerobot_swr.interactive.hub import Hub
from lerobot_swr.interactive.server import bind, serve
from lerobot_swr.interactive.worker import PlayJob, work
from lerobot_swr.styles.table import load_style_table

SMALL = Maze2DEnvConfig(task="small")
GOAL = (0.5, 0.08)
LEFT, RIGHT = [(0.27, 0.55), (0.27, 0.42), GOAL], [(0.73, 0.55), (0.73, 0.42), GOAL]


@contextlib.contextmanager
def played(job, monkeypatch):
    """The address of a server that plays a job."""
    servers, listener = [], bind("127.0.0.1", 0)

    def make(config):
        servers.append(uvicorn.Server(config))
        return servers[-1]

    with monkeypatch.context() as patch:
        patch.setattr(server_module, "make_server", make)
        thread = threading.Thread(target=serve, args=(Hub(work, job), "127.0.0.1", listener), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            if servers:
                servers[-1].should_exit = True
            thread.join(20)


def person_at(url, width, height):
    """Somebody with a window of that size; closed at the block's end."""
    browser = open_browser(width, height)
    return contextlib.closing(_Closing(browser, url))


class _Closing(Person):
    def __init__(self, browser, url):
        try:
            super().__init__(browser, url)
        except BaseException:
            browser.quit()
            raise

    def close(self):
        """Close the window."""
        self.browser.quit()


def test_five_demonstrations_by_mouse_are_saved_as_the_environment_did_them(tmp_path, monkeypatch):
    """A sixth is thrown away, the page is loaded anew in mid-episode; the dataset's frames replay exactly."""
    open_browser(400, 300).quit()  # skips before any work
    root = tmp_path / "mine"
    job = PlayJob(SMALL, None, DatasetSource(root), None, seed=0)
    with played(job, monkeypatch) as url, person_at(url, 1200, 900) as person:
        person.choose("speed", "4")
        for number, way in enumerate((LEFT, RIGHT, LEFT, LEFT, RIGHT, LEFT)):
            if number == 2:
                person.lead(way[:1])
                person.browser.refresh()
                person.until(lambda: person.ask("frame !== null && isPilot"))
            person.lead(way)
            person.until(lambda: not person.ask("byId('ended').hidden"))
            person.press("discard" if number == 5 else "keep")
            person.until(lambda: person.ask("frame.phase") == "waiting")
        assert person.ask("state.recording.kept") == {"10": 3, "20": 2}
        assert person.browser.find_element("id", "histogram").text.split() == [
            "10",
            "3",
            "(+3)",
            "20",
            "2",
            "(+2)",
        ]
        person.press("save")
        person.until(lambda: person.said().startswith("saved: 5 demonstrations"))
        assert person.ask("state.recording.saved") == {"10": 3, "20": 2}

    dataset = LeRobotDataset("local/mine", root=root)
    assert (dataset.num_episodes, dataset.fps) == (5, 20)
    frames = [dataset[i] for i in range(len(dataset))]
    for episode in range(5):
        rows = [frame for frame in frames if frame["episode_index"] == episode]
        env = Maze2DEnv("small")
        observed = [env.reset(seed=0)[0]["agent_pos"]]
        for row in rows[:-1]:
            observation, _, over, _, info = env.step(row["action"].numpy())
            observed.append(observation["agent_pos"])
        assert over
        assert info["is_success"]
        np.testing.assert_array_equal(np.stack([row["observation.state"].numpy() for row in rows]), observed)


@pytest.fixture(scope="module")
def trained(small_maze, tmp_path_factory):
    """A policy that has learned the small maze's six demonstrations, and the way back to each."""
    folder = tmp_path_factory.mktemp("trained") / "zbc"
    flags = train_flags("zbc", small_maze, folder, 8000, "--seeds=0", "--policy.corrective=noise")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["lerobot-swr-train", *flags])
        train_command.main()
    return next(folder.rglob("pretrained_model"))


def paused_early(person) -> bool:
    """Whether a rollout stands still after a few steps, far from the wall; a slow browser may be too late."""
    person.press("restart")
    if person.ask("frame.paused"):
        person.press("pause")
    person.until(lambda: person.ask("!frame.paused && frame.phase === 'running' && frame.steps >= 2"))
    person.press("pause")
    person.until(lambda: person.ask("frame.paused"))
    return person.ask("frame.phase === 'running' && frame.steps >= 2 && frame.steps <= 5")


@pytest.mark.slow  # whether the policy follows depends on what it has learned
def test_clicked_styles_are_followed_in_mid_rollout(small_maze, trained, monkeypatch):
    """One behaviour after the other, clicked in mid-rollout; a bad filter is told; a phone's window fits."""
    policy = PreTrainedConfig.from_pretrained(trained)
    policy.pretrained_path = trained
    labels = load_style_table(trained).columns["behavior"]
    job = PlayJob(SMALL, policy, DatasetSource(small_maze), None, seed=0)
    with played(job, monkeypatch) as url, person_at(url, 1200, 900) as person:
        person.choose("speed", "0.25")
        for behavior in ("10", "20", "10"):
            episode = labels.index(behavior)
            other = next(i for i, label in enumerate(labels) if label != behavior)
            person.browser.execute_script("send('style', {episodes: [arguments[0]]})", other)
            person.until(lambda: paused_early(person))
            assert person.ask("frame.style") == other
            person.click_style(episode)
            person.until(lambda e=episode: person.ask("state.steering.asked") == [e])
            person.press("pause")
            person.until(lambda: person.ask("frame.phase") == "over")
            assert person.ask("frame.success")
            assert person.ask("frame.behavior") == behavior == person.ask("frame.requested")
            assert person.browser.find_element("id", "flag").get_attribute("value") == (
                f"--policy.style_episodes='[{episode}]'"
            )
        person.browser.find_element("id", "filter").send_keys("lenght > 3")
        person.press("apply")
        person.until(lambda: "unknown name 'lenght'" in person.said())
        assert "Traceback" not in person.browser.page_source

        person.browser.set_window_size(390, 844)
        person.until(lambda: person.ask("document.documentElement.scrollWidth <= innerWidth"), 10)
