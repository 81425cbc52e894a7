"""Progress bars and LeRobot's message about FFmpeg: what a terminal and a log are shown."""

import io
import logging
import sys

import pytest
from tqdm import tqdm

from lerobot_swr import ffmpeg, progress
from lerobot_swr.progress import Progress, without_bars_in_logs

LEROBOT_SAYS = (
    "Could not load libtorchcodec. Likely causes:\n{}Traceback ...\n'torchcodec' is installed but cannot be "
    "loaded (see the error above). Falling back to 'pyav' as a default decoder."
).format("FFmpeg is not properly installed\n" * 100)


class Terminal(io.StringIO):
    """A file that says it is a terminal."""

    def isatty(self) -> bool:
        """It is."""
        return True


def test_a_log_gets_a_line_now_and_then_and_the_end(monkeypatch):
    """Of 10,000 quick steps the first and the last state, each a line of its own, and no carriage return."""
    log = io.StringIO()
    with Progress(total=10_000, desc="Training", file=log) as bar:
        for _ in range(10_000):
            bar.update()
            bar.refresh()
    lines = log.getvalue().splitlines()
    assert "\r" not in log.getvalue()
    assert [line.split("|")[0] for line in lines] == ["Training:   0%", "Training: 100%"]
    assert "10000/10000" in lines[-1]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_librarys_bar_is_for_terminals_and_warnings_are_for_all(monkeypatch, terminal):
    """A bar of tqdm's own in a block that is for terminals only."""
    file = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", file)
    with without_bars_in_logs():
        for _ in tqdm(range(2), mininterval=0):
            for _ in tqdm(range(3), leave=False, mininterval=0):
                pass
            print("a warning", file=sys.stderr)
    if terminal:
        assert "a warning\n" in file.getvalue()
        assert "3/3" in file.getvalue()
    else:
        assert file.getvalue() == "a warning\n" * 2
    assert sys.stderr is file


def test_a_slow_loop_shows_its_state_in_a_log(monkeypatch):
    """Once an interval, by the clock."""
    monkeypatch.setattr(progress, "LOG_INTERVAL", 0.0)
    log = io.StringIO()
    with Progress(total=3, file=log) as bar:
        for _ in range(3):
            bar.update()
    assert [line.split("|")[0].strip() for line in log.getvalue().splitlines()] == [
        "0%",
        "33%",
        "67%",
        "100%",
    ]


def test_a_terminal_gets_tqdms_bar():
    """Which moves within its line."""
    terminal = Terminal()
    with Progress(total=2, file=terminal) as bar:
        bar.update(2)
    assert terminal.getvalue().count("\r") >= 2
    assert terminal.getvalue().count("\n") == 1


@pytest.fixture
def lerobot_log(monkeypatch, caplog):
    """LeRobot's logger, in a process that was told nothing yet."""
    monkeypatch.delenv(ffmpeg.TOLD, raising=False)
    monkeypatch.delenv(ffmpeg.DEBUG, raising=False)
    ffmpeg.shorten_message()
    return logging.getLogger(ffmpeg.LOGGER)


def test_a_missing_ffmpeg_is_said_once_in_a_line(lerobot_log, caplog, monkeypatch):
    """With what to install; not again in this process, nor in those that it starts."""
    for _ in range(3):
        lerobot_log.warning(LEROBOT_SAYS)
    [record] = caplog.records
    assert "\n" not in record.getMessage()
    assert "apt install ffmpeg" in record.getMessage()
    assert record.levelno == logging.WARNING


def test_other_messages_of_the_logger_and_the_whole_one_can_be_seen(lerobot_log, caplog, monkeypatch):
    """The filter touches one message, and LEROBOT_SWR_DEBUG=1 switches it off."""
    lerobot_log.warning("another\nmatter")
    monkeypatch.setenv(ffmpeg.DEBUG, "1")
    lerobot_log.warning(LEROBOT_SAYS)
    assert [record.getMessage() for record in caplog.records] == ["another\nmatter", LEROBOT_SAYS]


def test_lerobots_own_message_is_the_one_that_is_shortened(lerobot_log, caplog, monkeypatch):
    """LeRobot's function, where torchcodec does not load, logs what the filter knows."""
    from lerobot.utils import import_utils

    def broken(name):
        raise RuntimeError("Could not load libtorchcodec.\n" + "Traceback\n" * 50)

    monkeypatch.setattr(import_utils.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(import_utils.importlib, "import_module", broken)
    assert import_utils.get_safe_default_video_backend() == "pyav"
    [record] = caplog.records
    assert record.getMessage().startswith("videos are read by PyAV")
