"""The table of a checkpoint's demonstrations: one row per style, for filters, neighbours and named filters.

It is made from the training dataset when a policy is created and travels with the checkpoint as
``styles.parquet``, so that styles can be chosen where the dataset is not.
"""

import json
import logging
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from huggingface_hub import HfApi, hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE, REWARD

from lerobot_swr.behavior_rules import dataset_behavior_rule
from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.envs.observed import SIMULATED, as_simulated
from lerobot_swr.similarity import Similarity
from lerobot_swr.styles.filters import Value, column_kind, select
from lerobot_swr.styles.metric_files import read_metric_files
from lerobot_swr.trajectories import Trajectories
from lerobot_swr.user_functions import load_style_metrics
from lerobot_swr.whole_files import replacing

TABLE_FILE = "styles.parquet"
NEIGHBOURS = "nearest others"  # a column of the file; metrics have names without spaces
FILTERS = b"filters"  # metadata of the file
SUCCESS = "next.success"
OUTCOMES = (REWARD, SUCCESS)
"""Columns of the data about how episodes went."""
LABELLED_BY = (OBS_ENV_STATE, *SIMULATED)
"""Columns by which rules label an episode, also where the policy does not look at them."""
OUTCOME_COLUMNS = frozenset({"return", "success"})
MAX_NEIGHBOURS = 50

Metric = Callable[[Mapping[str, np.ndarray]], Value]
"""Maps an episode's features, ``{"observation.state": (T, d), "action": (T, A), ...}``, to a value."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class StyleTable:
    """What is known of the demonstration behind each style.

    Attributes:
        columns: Name to N numbers, strings or truth values, one per episode.
        neighbours: (N, K) int32, for each episode the others nearest to it by dissimilarity ν, nearest first;
            K is at most `MAX_NEIGHBOURS`, and -1 stands where there are fewer.
        filters: Named filters; a rollout whose task string is such a name draws from that filter's styles.
    """

    columns: dict[str, list[Value]]
    neighbours: np.ndarray
    filters: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of styles."""
        return len(self.neighbours)

    def matches(self, text: str) -> np.ndarray:
        """(N,) bool, the episodes that a filter keeps.

        Raises:
            FilterError: If the filter cannot be used on this table.
        """
        return select(text, self.columns)

    def with_filter(self, name: str, text: str) -> "StyleTable":
        """The table with a named filter more.

        Raises:
            ValueError: If the name is empty.
            FilterError: If the filter cannot be used on this table.
        """
        if not name.strip():
            raise ValueError(f"name={name!r}: a named filter needs a name, e.g. --name=slowly")
        self.matches(text)
        return replace(self, filters={**self.filters, name: text})

    def without_filter(self, name: str) -> "StyleTable":
        """The table without one of its named filters.

        Raises:
            ValueError: If there is no such filter.
        """
        if name not in self.filters:
            raise ValueError(f"{name!r} is no named filter; known: {', '.join(self.filters) or 'none'}")
        return replace(self, filters={key: text for key, text in self.filters.items() if key != name})

    def without_columns(self, names: Collection[str]) -> "StyleTable":
        """The table without some of its columns."""
        return replace(self, columns={key: v for key, v in self.columns.items() if key not in names})

    def extended(self, other: "StyleTable") -> "StyleTable":
        """The table with the rows of `other` below, which has the same columns; filters are this table's."""
        columns = {name: values + other.columns[name] for name, values in self.columns.items()}
        columns["episode"] = list(range(len(self) + len(other)))
        both = (self.neighbours, other.neighbours)
        width = max(part.shape[1] for part in both)
        padded = [np.pad(p, ((0, 0), (0, width - p.shape[1])), constant_values=-1) for p in both]
        return replace(self, columns=columns, neighbours=np.concatenate(padded))

    def save(self, folder: Path) -> None:
        """Write the table into a checkpoint's folder, all or nothing."""
        flat = pa.array(self.neighbours.astype(np.int32).reshape(-1))
        # A width of 0, of a single demonstration, is not kept by all readers of parquet.
        rows = pa.FixedSizeListArray.from_arrays(flat, self.neighbours.shape[1] or 1) if len(flat) else None
        columns: dict[str, Any] = {name: pa.array(values) for name, values in self.columns.items()}
        if rows is not None:
            columns[NEIGHBOURS] = rows
        table = pa.table(columns).replace_schema_metadata({FILTERS: json.dumps(self.filters)})
        with replacing(folder / TABLE_FILE) as unfinished:
            pq.write_table(table, unfinished)

    def upload(self, repo_id: str, private: bool | None) -> None:
        """Put the table beside a checkpoint on the Hub."""
        api = HfApi()
        api.create_repo(repo_id=repo_id, private=private, exist_ok=True)
        with TemporaryDirectory() as folder:
            self.save(Path(folder))
            file = Path(folder) / TABLE_FILE
            api.upload_file(path_or_fileobj=file, path_in_repo=file.name, repo_id=repo_id)


def make_style_table(
    trajectories: Trajectories,
    neighbours: np.ndarray,
    rule: BehaviorRule | None = None,
    metrics: Mapping[str, Metric] | None = None,
) -> StyleTable:
    """Compute the table of a dataset.

    Columns: ``episode``; ``length`` (frames) and ``duration`` (s); ``path_length`` of the states (in their
    units) and ``mean_speed`` (path length per second); ``return`` and ``success`` where the dataset has
    ``next.reward`` and ``next.success``; ``first_k`` and ``last_k``, component k of the first and last state;
    ``task``, where the dataset has task strings; ``behavior``, where there is a rule; and the metrics.

    Args:
        trajectories: The demonstrations.
        neighbours: (N, K) the others nearest to each, see `StyleTable`.
        rule: Labels a demonstration.
        metrics: Name to user metric.

    Raises:
        ValueError: If a metric's value is no finite number, string or truth value, or its kind varies.
    """
    states = trajectories.states([OBS_STATE])
    path_length = [float(np.linalg.norm(np.diff(s, axis=0), axis=1).sum()) for s in states]
    moving = [max(len(s) - 1, 1) / trajectories.fps for s in states]  # seconds from first to last frame
    columns: dict[str, list[Value]] = {
        "episode": list(range(len(trajectories))),
        "length": trajectories.lengths.tolist(),
        "duration": (trajectories.lengths / trajectories.fps).tolist(),
        "path_length": list(path_length),
        "mean_speed": [path / seconds for path, seconds in zip(path_length, moving, strict=True)],
    }
    if REWARD in trajectories.columns:
        columns["return"] = [float(episode[REWARD].sum()) for episode in trajectories.episodes()]
    if SUCCESS in trajectories.columns:
        columns["success"] = [bool(episode[SUCCESS].any()) for episode in trajectories.episodes()]
    for k in range(states[0].shape[1]):
        columns[f"first_{k}"] = [float(s[0, k]) for s in states]
        columns[f"last_{k}"] = [float(s[-1, k]) for s in states]
    if trajectories.tasks:
        columns["task"] = list(trajectories.tasks)
    named: dict[str, Metric] = {"behavior": rule} if rule is not None else {}
    for name, metric in {**named, **(metrics or {})}.items():
        columns[name] = _measured(name, metric, trajectories)
    return StyleTable(columns, neighbours)


def make_nearest_table(
    trajectories: Trajectories,
    similarity: Similarity,
    behavior_rule: str | None,
    style_metrics: str | None,
    robot_type: str | None,
) -> StyleTable:
    """The table of a dataset's demonstrations.

    Args:
        trajectories: The demonstrations.
        similarity: Their distances.
        behavior_rule: ``module:function`` or ``behaviors.json`` that labels them; None takes the rule of this
            package's datasets.
        style_metrics: Further columns: ``module:function``, and JSON and CSV files of values of the episodes,
            separated by commas.
        robot_type: Of the dataset's metadata; finds the rule of this package's datasets.
    """
    everyone = np.arange(len(trajectories))
    neighbours, _ = similarity.nearest(everyone, MAX_NEIGHBOURS, everyone)
    rule = dataset_behavior_rule(behavior_rule, robot_type)
    table = make_style_table(trajectories, neighbours, rule, load_style_metrics(style_metrics))
    read = read_metric_files(style_metrics, len(trajectories))
    taken = sorted(read.keys() & table.columns.keys())
    if taken:
        logger.warning("style_metrics: the table has columns %s of its own; the files' are left out", taken)
    return replace(table, columns={**table.columns, **{k: v for k, v in read.items() if k not in taken}})


def _measured(name: str, metric: Metric, trajectories: Trajectories) -> list[Value]:
    values: list[Value] = []
    for i, episode in enumerate(trajectories.episodes()):
        try:
            value: Any = metric(as_simulated(episode))
        except Exception as error:  # whatever a user's function raises
            raise ValueError(f"style_metrics: {name!r} fails on episode {i}: {error!r}") from error
        value = value.item() if isinstance(value, np.generic | np.ndarray) and np.size(value) == 1 else value
        if not isinstance(value, bool | int | float | str) or value != value or value in (np.inf, -np.inf):
            raise ValueError(
                f"style_metrics: {name!r} of episode {i} is {value!r}; expected a finite number, a string or "
                "a truth value"
            )
        values.append(value)
    kinds = {column_kind([value]) for value in values}
    if len(kinds) > 1:
        raise ValueError(
            f"style_metrics: {name!r} is a {' here and a '.join(sorted(kinds))} there; keep to one"
        )
    return values


def load_style_table(path: str | Path, **hub_options: Any) -> StyleTable | None:
    """The table of a checkpoint, or None if it has none.

    Args:
        path: The checkpoint's folder, or its repository on the Hub.
        **hub_options: Options of `hf_hub_download`.

    Raises:
        ValueError: If the file is damaged.
    """
    if Path(path).is_dir():
        file = Path(path) / TABLE_FILE
        if not file.is_file():
            return None
    else:
        try:
            file = Path(hf_hub_download(repo_id=str(path), filename=TABLE_FILE, **hub_options))
        except (EntryNotFoundError, LocalEntryNotFoundError):
            return None
    try:
        table = pq.read_table(file)
        filters = json.loads(table.schema.metadata[FILTERS])
        neighbours = np.empty((len(table), 0), dtype=np.int32)
        if NEIGHBOURS in table.column_names:
            flat = table.column(NEIGHBOURS).combine_chunks().flatten().to_numpy()
            neighbours = flat.reshape(len(table), -1)
            table = table.drop_columns(NEIGHBOURS)
        return StyleTable(table.to_pydict(), neighbours, filters)
    except (pa.ArrowException, KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(f"{file}: damaged table ({error}); copy the checkpoint again") from error
