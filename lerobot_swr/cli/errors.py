"""How the commands tell a user what is wrong with the input."""

import functools
import os
import sys
from collections.abc import Callable

from lerobot_swr.errors import INTERRUPTED, USER_ERRORS, one_line
from lerobot_swr.progress import quieten_others


def explain_errors(command: Callable[[], None]) -> Callable[[], None]:
    """Print the message of an input error and exit with status 2 instead of showing a stack trace.

    Ctrl-C ends with status 130. `LEROBOT_SWR_DEBUG=1` shows the stack trace.
    """

    @functools.wraps(command)
    def wrapper() -> None:
        quieten_others()
        try:
            command()
        except (*USER_ERRORS, KeyboardInterrupt) as error:
            if os.environ.get("LEROBOT_SWR_DEBUG"):
                raise
            stopped = isinstance(error, KeyboardInterrupt)
            print(f"\n{INTERRUPTED}" if stopped else f"error: {one_line(error)}", file=sys.stderr)
            sys.exit(130 if stopped else 2)

    return wrapper
