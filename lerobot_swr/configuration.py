"""How configurations of this package refuse bad values in LeRobot's parser."""

import functools
import logging
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from huggingface_hub import constants

from lerobot_swr.checkpoint_files import check_files
from lerobot_swr.dataset_checks import check_format
from lerobot_swr.run_context import dataset_of_command

logger = logging.getLogger(__name__)


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
    """Refuse a ``dataset.root``, of the command line or its configuration file, that cannot be used.

    Raises:
        ValueError: If the folder does not exist while the Hub is switched off, or LeRobot cannot read the
            dataset in it.
    """
    root, repo_id, file = dataset_of_command()
    origin = "" if file is None else f", from {file}"
    advice = "check the path, or make the dataset (lerobot-swr-dataset)"
    if file is not None:
        advice = "was it moved? Give its folder: --dataset.root=FOLDER"
    if root is None:
        return
    if Path(root).is_dir():
        check_format(Path(root), repo_id)
    elif constants.HF_HUB_OFFLINE:
        raise ValueError(
            f"dataset.root={root!r}{origin}: no such folder, and HF_HUB_OFFLINE is set, so it cannot be "
            f"downloaded; {advice}"
        )
    elif origin:
        logger.warning("dataset.root=%r%s: no such folder; looking on the Hub; %s", root, origin, advice)


def check_checkpoint_path(path: str) -> None:
    """Refuse what is neither a folder on this machine nor the name of a repository of the Hub.

    Raises:
        FileNotFoundError: Naming the part of the path that exists, and what is in there.
        ValueError: If a file of the folder is damaged.
    """
    folder = Path(path)
    if folder.is_dir():
        check_files(folder)
        return
    if re.fullmatch(r"[\w.-]+/[\w.-]+", path) and not folder.parent.is_dir():
        return
    exists = next(parent for parent in folder.absolute().parents if parent.is_dir())
    inside = sorted(child.name for child in exists.iterdir() if child.is_dir())
    listed = ", ".join(inside[:8]) + (f" and {len(inside) - 8} more" if len(inside) > 8 else "")
    raise FileNotFoundError(
        f"policy.path={path!r}: no such folder; {exists} exists and has the folders: {listed or 'none'}; "
        "give a checkpoint's pretrained_model folder"
    )
