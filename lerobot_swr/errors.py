"""What to tell a user, in one line, of errors that are no fault of the program."""

import errno

from datasets.exceptions import DatasetGenerationError
from draccus.utils import ParsingError
from lerobot.datasets.utils import CompatibilityError
from safetensors import SafetensorError
from yaml import YAMLError

from lerobot_swr.installation import MissingExtraError

USER_ERRORS = (
    *(ValueError, OSError, ParsingError, YAMLError),
    *(SafetensorError, CompatibilityError, DatasetGenerationError, NotImplementedError),
    MissingExtraError,
)
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LONGEST = 1500  # characters
INTERRUPTED = (
    "interrupted; what was saved before is whole, and a training goes on from there with --resume=true"
)


def one_line(error: BaseException) -> str:
    """The message of one of `USER_ERRORS`, with what to do where the error itself does not say."""
    chain = [error]
    while chain[-1].__cause__ is not None:
        chain.append(chain[-1].__cause__)
    if any(_is_full_disk(one) for one in chain):
        return (
            f"the disk is full ({_flat(chain[-1])}); what was saved before is whole: make room and run the "
            "command again, a training with --resume=true"
        )
    if isinstance(error, DatasetGenerationError):
        return f"LeRobot cannot read the dataset's files: {_flat(chain[-1])}"
    if isinstance(error, ParsingError):  # raised in a __post_init__
        return _flat(error.__cause__ or error)
    return _flat(error)


def _is_full_disk(error: BaseException) -> bool:
    number = error.errno if isinstance(error, OSError) else None
    told = isinstance(error, SafetensorError) and any(f"os error {n})" in str(error) for n in FULL_DISK)
    return number in FULL_DISK or told


def _flat(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"
