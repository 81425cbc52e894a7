"""How the commands tell a user what is wrong with the input."""

import functools
import os
import sys
from collections.abc import Callable

from draccus.utils import ParsingError


def explain_errors(command: Callable[[], None]) -> Callable[[], None]:
    """Print the message of an input error and exit with status 2 instead of showing a stack trace.

    `LEROBOT_SWR_DEBUG=1` shows the stack trace.
    """

    @functools.wraps(command)
    def wrapper() -> None:
        try:
            command()
        except (ValueError, OSError, ParsingError) as error:
            if os.environ.get("LEROBOT_SWR_DEBUG"):
                raise
            # The parser wraps what a configuration's own checks say.
            told = error.__cause__ if isinstance(error, ParsingError) and error.__cause__ else error
            print(f"error: {told}", file=sys.stderr)
            sys.exit(2)

    return wrapper
