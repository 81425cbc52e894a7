"""How configurations of this package meet LeRobot's parser: refusing bad values, telling a resumed run."""

import functools
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import constants
from lerobot.configs import parser
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.datasets import LeRobotDatasetMetadata


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


def training_episodes(meta: LeRobotDatasetMetadata) -> list[int] | None:
    """The episodes of a dataset that the running command trains on; None for all.

    LeRobot creates a policy with the metadata of the whole dataset. What ``--dataset.episodes`` and
    ``--dataset.eval_split`` leave is therefore read from the command line and its configuration file.

    Args:
        meta: Metadata of the training dataset.
    """
    episodes, share = _dataset_option("episodes"), _dataset_option("eval_split") or 0.0
    if not share:
        return episodes
    by_task: dict[str, list[int]] = {}
    for episode in range(meta.total_episodes) if episodes is None else episodes:
        by_task.setdefault((meta.episodes[episode]["tasks"] or [""])[0], []).append(episode)
    # Source: lerobot.datasets.factory.make_train_eval_datasets
    return [i for group in by_task.values() for i in group[: len(group) - math.ceil(len(group) * share)]]


def _dataset_option(key: str) -> Any:
    """Value of ``--dataset.<key>``, from the command line or else the file at ``--config_path``."""
    given = parser.parse_arg(f"dataset.{key}")
    if given is not None:
        return yaml.safe_load(given)
    file = Path(parser.parse_arg("config_path") or "")
    if file.is_dir():
        file = file / TRAIN_CONFIG_NAME
    if not file.is_file():
        return None
    return (yaml.safe_load(file.read_text()).get("dataset") or {}).get(key)  # JSON is YAML, too


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
