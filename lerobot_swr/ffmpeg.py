"""One line where FFmpeg is missing, instead of the stack traces of every version that was looked for.

LeRobot looks for torchcodec, and through it for FFmpeg's libraries, whenever it parses a dataset's options;
where they are missing it logs some hundred lines, several times a command, and goes on with PyAV, which
brings libraries of its own. A logging filter on that one logger says so once.
"""

import importlib.util
import logging
import os

LOGGER = "lerobot.utils.import_utils"
TOLD = "LEROBOT_SWR_TOLD_FFMPEG"
"""Set in the environment once it was said, so that processes that this one starts do not say it again."""
DEBUG = "LEROBOT_SWR_DEBUG"
ADVICE = (
    "videos are read by PyAV, because torchcodec finds no FFmpeg (versions 4 to 8) on this machine; "
    "faster with: apt install ffmpeg, brew install ffmpeg or conda install -c conda-forge ffmpeg"
)


class _OneLine(logging.Filter):
    """Shortens LeRobot's message about torchcodec to `ADVICE` and lets it pass once."""

    def filter(self, record: logging.LogRecord) -> bool:
        text = record.getMessage()
        if "torchcodec" not in text or "pyav" not in text or os.environ.get(DEBUG):
            return True
        if os.environ.get(TOLD) or os.environ.get("LOCAL_RANK", "0") != "0":  # of torchrun's one says it
            return False
        os.environ[TOLD] = "1"
        if "\n" in text:
            record.msg, record.args = f"{ADVICE} ({DEBUG}=1 shows why)", ()
        return True


def shorten_message() -> None:
    """Filter LeRobot's message from now on; `LEROBOT_SWR_DEBUG=1` shows it whole."""
    logger = logging.getLogger(LOGGER)
    if not any(isinstance(one, _OneLine) for one in logger.filters):
        logger.addFilter(_OneLine())


def missing_ffmpeg() -> str | None:
    """What reads videos where torchcodec does not, and why; None where it does."""
    if importlib.util.find_spec("torchcodec") is None:
        return "PyAV (torchcodec is not installed)"
    try:
        importlib.import_module("torchcodec")
    except (ImportError, OSError, RuntimeError):  # as LeRobot catches
        return ADVICE
    return None
