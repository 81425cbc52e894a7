"""How configurations of this package meet LeRobot's parser: refusing bad values, telling a resumed run."""

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from huggingface_hub import constants
from lerobot.configs import parser


def tells_bad_values(post_init: Callable[[Any], None]) -> Callable[[Any], None]:
    """Print what a configuration's own check says before its error goes on.

    Of that error LeRobot's parser shows the user no more than "Couldn't instantiate class ...".
    """

    @functools.wraps(post_init)
    def wrapper(self: Any) -> None:
        try:
            post_init(self)
        except ValueError as error:
            if not hasattr(error, "was_told"):  # by the check of a base class
                print(f"error: {error}", file=sys.stderr)
                error.was_told = True  # type: ignore[attr-defined]
            raise

    return wrapper


def check_dataset_folder() -> None:
    """Refuse a ``--dataset.root`` that neither exists nor can be downloaded.

    Raises:
        ValueError: If the command line names a folder that does not exist while the Hub is switched off.
    """
    root = parser.parse_arg("dataset.root")
    if root is not None and constants.HF_HUB_OFFLINE and not Path(root).is_dir():
        raise ValueError(
            f"dataset.root={root!r}: no such folder, and HF_HUB_OFFLINE is set, so it cannot be downloaded; "
            "check the path, or make the dataset (lerobot-swr-dataset)"
        )


_resuming: ContextVar[bool | None] = ContextVar("resuming", default=None)


def is_resuming() -> bool:
    """Whether the policy that is being made continues a run, rather than starting one from a checkpoint."""
    told = _resuming.get()
    return parser.parse_arg("resume") in ("true", "True", "yes", "1") if told is None else told


@contextmanager
def resuming(value: bool) -> Iterator[None]:
    """Say within the block what `is_resuming` would otherwise read from the command line."""
    token = _resuming.set(value)
    try:
        yield
    finally:
        _resuming.reset(token)
