"""What a training run is, known before its policy is made: on which episodes, and whether it is resumed.

LeRobot creates a policy with the metadata of the whole dataset and nothing else. What ``--dataset.episodes``,
``--dataset.eval_split`` and ``--resume`` say is therefore read from the command line and its configuration
file, here and nowhere else, unless a program says it with `running`.
"""

import logging
import math
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import yaml
from lerobot.configs import parser
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME, TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata

DROP = "drop_n_last_frames"  # what LeRobot's policies call it

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunContext:
    """What a policy has to know of the run that it is made for.

    Attributes:
        episodes: The dataset's episodes that are trained on, sorted.
        resuming: Whether the run goes on from its own checkpoint, rather than beginning (from another's).
    """

    episodes: tuple[int, ...]
    resuming: bool

    @classmethod
    def current(cls, meta: LeRobotDatasetMetadata) -> Self:
        """The run for which policies are made now: what `running` says, else what the command line does.

        Args:
            meta: Metadata of the training dataset.

        Raises:
            ValueError: If there are no such episodes, or the command's configuration file is not found.
        """
        told = _told.get()
        if told is not None:
            dataset, resuming = told
            return cls(_episodes(meta, dataset.episodes, dataset.eval_split), resuming)
        options = _options("dataset.episodes", "dataset.eval_split", "resume")
        episodes, eval_split, resume = options.values()
        return cls(_episodes(meta, episodes, eval_split), bool(resume))

    def without_short(self, lengths: np.ndarray, unseen: int, name: str) -> Self:
        """The run without episodes of which LeRobot's sampler shows no frame.

        Args:
            lengths: (N,) frames of all episodes.
            unseen: How many the policy leaves out at each episode's end (its `DROP`).
            name: Of the dataset.

        Raises:
            ValueError: If none is left.
        """
        short = [episode for episode in self.episodes if lengths[episode] <= unseen]
        if not short:
            return self
        if len(short) == len(self.episodes):
            raise ValueError(
                f"{name}: no episode has more than {unseen} frames, which the policy leaves out at the end "
                f"of each: give {DROP}=0 (--policy.backbone.{DROP}=0)"
            )
        logger.warning(
            "episodes %s have no more than %d frames, which the policy leaves out at the end of each (%s): "
            "they are not trained on and get no style",
            short,
            unseen,
            DROP,
        )
        return replace(self, episodes=tuple(sorted(set(self.episodes) - set(short))))


_told: ContextVar[tuple[DatasetConfig, bool] | None] = ContextVar("running", default=None)


@contextmanager
def running(dataset: DatasetConfig, resuming: bool = False) -> Iterator[None]:
    """Say for which run policies are made in this block, whatever the program's command line is.

    Args:
        dataset: Its dataset; the fields `episodes` and `eval_split` count.
        resuming: Whether it goes on from its own checkpoint.
    """
    token = _told.set((dataset, resuming))
    try:
        yield
    finally:
        _told.reset(token)


def dataset_of_command() -> tuple[str | None, str | None, str | None]:
    """Folder and repository of the dataset that the command is about, and the file that names the folder.

    The file is None where a flag names it; the folder, where neither does.
    """
    root, repo_id = parser.parse_arg("dataset.root"), parser.parse_arg("dataset.repo_id")
    file = parser.parse_arg("config_path")
    if root is not None or file is None or not Path(file).exists():
        return root, repo_id, None
    return (_content(file).get("dataset") or {}).get("root"), repo_id, file


def given_below(name: str, files: bool = True) -> set[str]:
    """Fields below a dotted name that the command line gives or, if `files`, its configuration file."""
    prefix = f"--{name}."
    flags = {word[len(prefix) :].partition("=")[0] for word in sys.argv[1:] if word.startswith(prefix)}
    file = parser.parse_arg("config_path")
    filed = _entry(_content(file), name) if files and file is not None else None
    return {flag.partition(".")[0] for flag in flags} | set(filed or {})


def _episodes(
    meta: LeRobotDatasetMetadata, episodes: Sequence[int] | None, eval_split: float | None
) -> tuple[int, ...]:
    """The episodes that LeRobot trains on."""
    chosen = list(range(meta.total_episodes) if episodes is None else episodes)
    unknown = [episode for episode in chosen if not 0 <= episode < meta.total_episodes]
    if unknown:
        raise ValueError(
            f"dataset.episodes={chosen}: episodes {unknown} do not exist; the dataset "
            f"{str(meta.root)!r} has episodes 0 to {meta.total_episodes - 1}"
        )
    if eval_split:
        tasks = list(meta.episodes["tasks"])
        by_task: dict[str, list[int]] = {}
        for episode in chosen:
            by_task.setdefault((tasks[episode] or [""])[0], []).append(episode)
        # Source: lerobot.datasets.factory.make_train_eval_datasets
        kept = {key: len(group) - math.ceil(len(group) * eval_split) for key, group in by_task.items()}
        chosen = [episode for key, group in by_task.items() for episode in group[: kept[key]]]
    if not chosen:
        raise ValueError(
            f"dataset.episodes={episodes}, dataset.eval_split={eval_split}: they leave no episode to train on"
        )
    return tuple(sorted(set(chosen)))


def _options(*names: str) -> dict[str, Any]:
    """Values of flags, from the command line or else the file at ``--config_path``, or else None."""
    given = {name: _last_given(name) for name in names}
    file = parser.parse_arg("config_path")
    filed = {} if file is None or None not in given.values() else _content(file)
    return {
        name: _entry(filed, name) if value is None else yaml.safe_load(value) for name, value in given.items()
    }


def _entry(content: Any, name: str) -> Any:
    """The value of a dotted name in a nested mapping."""
    for key in name.split("."):
        content = (content or {}).get(key)
    return content


def _last_given(option: str) -> str | None:
    """Value of a flag; of several the last, as for a configuration's fields (`parse_arg` takes the first)."""
    for place in range(len(sys.argv) - 1, 0, -1):
        value = parser.parse_arg(option, sys.argv[place : place + 2])
        if value is not None:
            return value
    return None


def _content(name: str) -> dict[str, Any]:
    """What a ``--config_path`` holds: a file, a folder, or a repository of the Hub."""
    path = Path(name)
    file = path / TRAIN_CONFIG_NAME if path.is_dir() else path
    if file.is_file():
        return yaml.safe_load(file.read_text()) or {}  # JSON is YAML, too
    if path.is_dir():
        return {}  # LeRobot goes on with its defaults
    try:
        return TrainPipelineConfig.from_pretrained(name).to_dict()
    except (OSError, ValueError) as error:
        raise ValueError(
            f"config_path={name!r}: found neither here nor on the Hub, so the episodes to train on are not "
            "known; give the path of the configuration file"
        ) from error
