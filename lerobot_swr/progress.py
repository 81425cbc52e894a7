"""Progress bars: one that moves on a terminal, a line now and then in a log."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr
from typing import Any

from tqdm import tqdm

LOG_INTERVAL = 30.0
"""Seconds between two lines in a log."""


class Progress(tqdm):
    """A `tqdm` bar that writes whole lines, and few of them, where its output is no terminal."""

    disable: bool

    def __init__(self, *args: Any, **kwargs: Any):
        if not _is_terminal(kwargs.get("file") or sys.stderr):
            # maxinterval: tqdm's monitor would otherwise shorten the interval.
            kwargs.update(mininterval=LOG_INTERVAL, maxinterval=2 * LOG_INTERVAL, miniters=1, ncols=100)
        super().__init__(*args, **kwargs)

    @staticmethod
    def status_printer(file: Any) -> Callable[[str], None]:
        """How a state is written: over the last one, or in a line of its own."""
        if _is_terminal(file):
            return tqdm.status_printer(file)
        last = ""

        def write_line(text: str) -> None:
            nonlocal last
            if text.strip() and text != last:
                file.write(text.rstrip() + "\n")
                file.flush()
            last = text

        return write_line

    def refresh(self, *args: Any, **kwargs: Any) -> Any:
        """Show the state now; in a log when its time has come."""
        last = getattr(self, "last_print_t", None)  # None while it is made
        if _is_terminal(self.fp) or last is None or self._time() - last >= self.mininterval:
            self.last_print_t = self._time()
            return super().refresh(*args, **kwargs)
        return None

    def close(self) -> None:
        """Show the last state; in a log without tqdm's empty line."""
        if not self.disable and not _is_terminal(self.fp):
            self.display()
            self.disable = True
            self._decr_instances(self)
        super().close()


def quieten_others() -> None:
    """Let the bars of libraries, in processes that this one starts, keep a log as short as ours do.

    Values that the user has set stay.
    """
    if not _is_terminal(sys.stderr):
        os.environ.setdefault("TQDM_MININTERVAL", f"{LOG_INTERVAL:g}")
        os.environ.setdefault("TQDM_MAXINTERVAL", f"{2 * LOG_INTERVAL:g}")


@contextmanager
def without_bars_in_logs() -> Iterator[None]:
    """Within the block the bars of libraries in this process do not fill a log.

    A bar begins with a carriage return, or moves the line; whatever else goes to the standard error stays.
    """
    if _is_terminal(sys.stderr):
        yield
        return
    with redirect_stderr(_Lasting(sys.stderr)):
        yield


class _Lasting:
    """A file without what is meant to be written over."""

    def __init__(self, file: Any):
        self._file, self._after_bar = file, True

    def write(self, text: str) -> int:
        moves = not text.replace("\x1b[A", "").strip()  # to another line, or ends one
        if text.startswith("\r") or (moves and (self._after_bar or "\x1b" in text)):
            self._after_bar = True
            return len(text)
        self._after_bar = False
        return self._file.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _is_terminal(file: Any) -> bool:
    return bool(getattr(file, "isatty", lambda: False)())
