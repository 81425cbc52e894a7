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
            cause = error.__cause__ if isinstance(error, ParsingError) else None  # raised in a __post_init__
            print(f"error: {cause or error}", file=sys.stderr)
            sys.exit(2)

    return wrapper
