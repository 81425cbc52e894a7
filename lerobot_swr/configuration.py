"""How configurations of this package meet LeRobot's parser: refusing bad values, telling what a run is."""

import functools
import logging
import math
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import constants
from lerobot.configs import parser
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_swr.dataset_checks import check_format

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
    root, origin = parser.parse_arg("dataset.root"), ""
    advice = "check the path, or make the dataset (lerobot-swr-dataset)"
    file = parser.parse_arg("config_path")
    if root is None and file is not None and Path(file).exists():
        root, origin = _dataset_of_file(file).get("root"), f", from {file}"
        advice = "was it moved? Give its folder: --dataset.root=FOLDER"
    if root is None:
        return
    if Path(root).is_dir():
        check_format(Path(root), parser.parse_arg("dataset.repo_id"))
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
    """
    folder = Path(path)
    if folder.is_dir() or (re.fullmatch(r"[\w.-]+/[\w.-]+", path) and not folder.parent.is_dir()):
        return
    exists = next(parent for parent in folder.absolute().parents if parent.is_dir())
    inside = sorted(child.name for child in exists.iterdir() if child.is_dir())
    listed = ", ".join(inside[:8]) + (f" and {len(inside) - 8} more" if len(inside) > 8 else "")
    raise FileNotFoundError(
        f"policy.path={path!r}: no such folder; {exists} exists and has the folders: {listed or 'none'}; "
        "give a checkpoint's pretrained_model folder"
    )


_training_on: ContextVar[DatasetConfig | None] = ContextVar("training_on", default=None)
_resuming: ContextVar[bool | None] = ContextVar("resuming", default=None)


def training_episodes(meta: LeRobotDatasetMetadata) -> list[int] | None:
    """The episodes of a dataset that the policy that is being made trains on; None for all.

    LeRobot creates a policy with the metadata of the whole dataset. Unless `training_on` says it, what
    ``--dataset.episodes`` and ``--dataset.eval_split`` leave is therefore read from the command line and its
    configuration file.

    Args:
        meta: Metadata of the training dataset.

    Raises:
        ValueError: If the command's configuration file is not found.
    """
    told = _training_on.get()
    options = _dataset_options("episodes", "eval_split") if told is None else vars(told)
    episodes, share = options["episodes"], options["eval_split"] or 0.0
    if not share:
        return episodes
    by_task: dict[str, list[int]] = {}
    for episode in range(meta.total_episodes) if episodes is None else episodes:
        by_task.setdefault((meta.episodes[episode]["tasks"] or [""])[0], []).append(episode)
    # Source: lerobot.datasets.factory.make_train_eval_datasets
    return [i for group in by_task.values() for i in group[: len(group) - math.ceil(len(group) * share)]]


def _dataset_options(*keys: str) -> dict[str, Any]:
    """Values of ``--dataset.<key>``, from the command line or else the file at ``--config_path``."""
    given = {key: _last_given(f"dataset.{key}") for key in keys}
    name = parser.parse_arg("config_path")
    filed = {} if name is None or None not in given.values() else _dataset_of_file(name)
    return {k: filed.get(k) if value is None else yaml.safe_load(value) for k, value in given.items()}


def _last_given(option: str) -> str | None:
    """Value of a flag; of several the last, as for a configuration's fields (`parse_arg` takes the first)."""
    for place in range(len(sys.argv) - 1, 0, -1):
        value = parser.parse_arg(option, sys.argv[place : place + 2])
        if value is not None:
            return value
    return None


def _dataset_of_file(name: str) -> dict[str, Any]:
    """The section ``dataset`` of a ``--config_path``: a file, a folder, or a repository of the Hub."""
    path = Path(name)
    file = path / TRAIN_CONFIG_NAME if path.is_dir() else path
    if file.is_file():
        return yaml.safe_load(file.read_text()).get("dataset") or {}  # JSON is YAML, too
    if path.is_dir():
        return {}  # LeRobot goes on with its defaults
    try:
        return vars(TrainPipelineConfig.from_pretrained(name).dataset)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"config_path={name!r}: found neither here nor on the Hub, so the episodes to train on are not "
            "known; give the path of the configuration file"
        ) from error


def is_resuming() -> bool:
    """Whether the policy that is being made continues a run, rather than starting one from a checkpoint."""
    told = _resuming.get()
    return parser.parse_arg("resume") in ("true", "True", "yes", "1") if told is None else told


def resuming(value: bool) -> AbstractContextManager[None]:
    """Say within a block what `is_resuming` would otherwise read from the command line."""
    return _said(_resuming, value)


def training_on(dataset: DatasetConfig) -> AbstractContextManager[None]:
    """Say within a block what `training_episodes` would otherwise read from the command line."""
    return _said(_training_on, dataset)


@contextmanager
def _said(variable: ContextVar[Any], value: Any) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)
