"""Commands that stand still at a place in their work, to be killed there."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

HELD_PROCESS = Path(__file__).parent / "held_process"


@contextlib.contextmanager
def held_command(
    module: str, flags: list[str], at: str, processes: int = 1
) -> Iterator[tuple[subprocess.Popen, Callable[[], None]]]:
    """Run a command, in a session of its own, until processes of it stand still where the pattern says.

    Args:
        module: Of the command's ``main``.
        flags: Its flags.
        at: Pattern of the file or folder that a process is about to make when it is held.
        processes: How many come to make one.

    Yields:
        The command, which the block has to kill, and what waits for the end of all of its processes. Those
        that are still there after the block are let go.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = os.pathsep.join(filter(None, [str(HELD_PROCESS), os.environ.get("PYTHONPATH")]))
        command = subprocess.Popen(
            [sys.executable, "-c", f"from {module} import main; main()", *flags],
            env={**os.environ, "PYTHONPATH": path, "HELD_IN": folder, "HELD_AT": at},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        assert command.stdout is not None
        said: list[str] = []
        # The output ends with the last process that writes to it.
        listener = threading.Thread(target=said.extend, args=(command.stdout,), daemon=True)
        listener.start()
        try:
            while len(os.listdir(folder)) < processes:
                assert command.poll() is None, "".join(said)
                time.sleep(0.05)
            yield command, listener.join
        except BaseException:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(command.pid, signal.SIGKILL)
            raise
        finally:
            command.wait()
