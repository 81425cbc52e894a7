"""How the commands tell a user what is wrong with the input."""

import functools
import os
import sys
from collections.abc import Callable


def explain_errors(command: Callable[[], None]) -> Callable[[], None]:
    """Print the message of an input error and exit with status 2 instead of showing a stack trace.

    `LEROBOT_SWR_DEBUG=1` shows the stack trace.
    """

    @functools.wraps(command)
    def wrapper() -> None:
        try:
            command()
        except (ValueError, OSError) as error:
            if os.environ.get("LEROBOT_SWR_DEBUG"):
                raise
            print(f"error: {error}", file=sys.stderr)
            sys.exit(2)

    return wrapper
