"""``lerobot-swr-behaviors``: which ways of doing the task are in a dataset? Without a rule or a training.

Examples:
    lerobot-swr-behaviors --dataset.root=data/so101_stack --output_dir=outputs/behaviors

    lerobot-swr-behaviors --dataset.root=data/aligning --features=my_project.features:tool_in_box \
        --output_dir=outputs/behaviors
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot.configs import parser
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.datasets.dataset_tools import add_features
from lerobot.utils.constants import ACTION, DEFAULT_FEATURES, OBS_ENV_STATE, OBS_STATE
from lerobot.utils.utils import init_logging

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.dataset_checks import edit_command
from lerobot_swr.dataset_files import is_numeric
from lerobot_swr.discovery.discover import OUTLIER, Discovery, discover, named
from lerobot_swr.discovery.frames import strips
from lerobot_swr.discovery.report import REPORT_FILE, compared_by, no_groups, write_report
from lerobot_swr.discovery.rule import RULE_FILE, rule_data, write_rule
from lerobot_swr.discovery.sources import Source
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.trajectories import Trajectories, dimension_names, load_trajectories
from lerobot_swr.whole_files import write_whole

COLUMN = "behavior"
DELETE_FILE = "delete_outliers.txt"


@dataclass
class BehaviorsCommand:
    """Options of ``lerobot-swr-behaviors``."""

    # The dataset; all of its episodes are looked at.
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Where behaviors.json (the rule) and report.html are written.
    output_dir: Path | None = None
    # Features by which episodes are compared; null takes observation.state and observation.environment_state.
    # What rollouts show too can label rollouts: leave "action" out for that.
    keys: list[str] | None = None
    # Your own instead: module:function; maps an episode's arrays to states (T, d) or one vector (d,).
    features: str | None = None
    # Number of behaviours; null lets the data choose.
    num_behaviors: int | None = None
    # Fewer episodes than these are no behaviour but outliers.
    min_episodes: int = 2
    # Look for episodes that fit nowhere; false gives every episode a behaviour.
    outliers: bool = True
    # Names of the behaviours, the most frequent first (or give them in the report).
    names: list[str] | None = None
    # Pictures of each camera and typical episode in the report; 0 leaves them out.
    frames: int = 6
    # Write delete_outliers.txt: the lerobot-edit-dataset command that deletes the outliers.
    delete_command: bool = False
    # Write a copy of the dataset into this new folder, with the column "behavior": the behaviour's number, -1
    # for outliers.
    label_column: Path | None = None
    # Draws what the number of behaviours is judged by.
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
            FileExistsError: If the folder for the copy exists.
        """
        if self.output_dir is None:
            raise ValueError("output_dir is missing: give the folder for behaviors.json and report.html")
        if self.dataset.episodes is not None:
            raise ValueError(
                f"dataset.episodes={self.dataset.episodes}: behaviours are found among all episodes; "
                "leave it out"
            )
        for key, least in (("num_behaviors", 1), ("min_episodes", 1), ("frames", 0)):
            value = getattr(self, key)
            if value is not None and value < least:
                raise ValueError(f"{key}={value}: expected at least {least}")
        if self.keys is not None and (not self.keys or self.features is not None):
            raise ValueError(
                f"keys={self.keys}: give one or more features of the dataset, or --features instead"
            )
        if self.label_column is not None and self.label_column.exists():
            raise FileExistsError(
                f"label_column={str(self.label_column)!r} already exists; choose another folder"
            )


@parser.wrap()
def find_behaviors(cfg: BehaviorsCommand) -> None:
    """Find the behaviours of a dataset and write them down."""
    assert cfg.output_dir is not None
    meta = cfg.dataset.metadata()
    source = Source(tuple(cfg.keys or _default_keys(meta)), cfg.features)
    trajectories = _read(meta, source)
    if cfg.keys is None and cfg.features is None:
        source = Source(_varying(trajectories))  # new episodes need not have what tells nothing
    found = discover(
        trajectories, source, cfg.num_behaviors, cfg.min_episodes, find_outliers=cfg.outliers, seed=cfg.seed
    )
    if cfg.names is not None:
        found = named(found, cfg.names)
    data = rule_data(found, str(meta.root))
    write_rule(cfg.output_dir / RULE_FILE, data)
    pictures = strips(meta, found.medoids, cfg.frames)
    write_report(
        cfg.output_dir / REPORT_FILE, found, data, trajectories, _dimension_names(meta, source), pictures
    )
    print(format_discovery(found, trajectories))
    if cfg.delete_command:
        write_whole(cfg.output_dir / DELETE_FILE, delete_command(meta, found) + "\n")
        print(delete_command(meta, found))
    if cfg.label_column is not None:
        _write_copy(meta, found, trajectories, cfg.label_column)
        print(f"dataset with column {COLUMN!r} written to {cfg.label_column}")
    print(
        f"written to {cfg.output_dir}: look at {REPORT_FILE}, name the behaviours there, and use them: "
        f"--behavior_rule={cfg.output_dir / RULE_FILE}"
    )


def _default_keys(meta: LeRobotDatasetMetadata) -> list[str]:
    """What an episode's way shows in; rollouts observe it, too."""
    keys = [
        key for key in (OBS_STATE, OBS_ENV_STATE) if key in meta.features and is_numeric(meta.features[key])
    ]
    return keys or [ACTION]


def _varying(trajectories: Trajectories) -> tuple[str, ...]:
    """The features that are not the same in all frames; all if none is."""
    keys = tuple(key for key, column in trajectories.columns.items() if np.ptp(column, axis=0).any())
    return keys or tuple(trajectories.columns)


def _read(meta: LeRobotDatasetMetadata, source: Source) -> Trajectories:
    """The features that are compared by; for a function, all that are numbers."""
    if source.function is None:
        return load_trajectories(meta, source.keys)
    numeric = [key for key, feature in meta.features.items() if is_numeric(feature)]
    return load_trajectories(meta, source.keys, [key for key in numeric if key not in DEFAULT_FEATURES])


def _dimension_names(meta: LeRobotDatasetMetadata, source: Source) -> list[str]:
    """Names of the dimensions that are compared, or none where a function makes them."""
    if source.function is not None:
        return []
    return [name for names in dimension_names(meta, source.keys).values() for name in names]


def format_discovery(found: Discovery, trajectories: Trajectories) -> str:
    """A table for the terminal; behaviours of the same name are one row."""
    names, labels = list(dict.fromkeys(found.names)), np.array(found.labels)
    head = f"{len(names)} behaviour{'s' if len(names) != 1 else ''} in {len(trajectories)} episodes"
    lines = [f"{head} (separation {found.separation:.2f}, stability {found.stability:.2f})"]
    lines += [line for line in (no_groups(found), f"Compared by {compared_by(found)}.") if line]
    lines.append(f"  {'behaviour':<24} {'episodes':>8} {'share':>6}  typical  frames")
    for name in names:
        members = np.flatnonzero(labels == name)
        low, middle, high = np.quantile(trajectories.lengths[members], [0, 0.5, 1]).astype(int)
        share, typical = len(members) / len(trajectories), found.medoids[found.names.index(name)]
        lines.append(f"  {name:<24} {len(members):8d} {share:6.1%}  {typical:7d}  {middle} ({low} to {high})")
    if found.reasons:
        lines.append(f"  {OUTLIER}s: {len(found.reasons)}")
        lines += [f"    episode {episode}: {why}" for episode, why in found.reasons.items()]
    return "\n".join(lines)


def delete_command(meta: LeRobotDatasetMetadata, found: Discovery) -> str:
    """LeRobot's command that deletes the outliers."""
    if not found.reasons:
        return "# no outliers: nothing to delete"
    numbers = ", ".join(map(str, sorted(found.reasons)))
    return f'{edit_command(meta, "delete_episodes")} --operation.episode_indices="[{numbers}]"'


def _write_copy(
    meta: LeRobotDatasetMetadata, found: Discovery, trajectories: Trajectories, folder: Path
) -> None:
    """A copy of the dataset with a number for each frame's behaviour, by LeRobot's own tools."""
    values = np.repeat(found.groups.astype(np.int64), trajectories.lengths)[:, None]
    dataset = LeRobotDataset(meta.repo_id, root=meta.root)
    feature = {"dtype": "int64", "shape": (1,), "names": None}
    add_features(dataset, {COLUMN: (values, feature)}, output_dir=folder, repo_id=f"{meta.repo_id}_labelled")


TEXT_FLAGS: Sequence[str] = ("features",)


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging()
    sys.argv = list(with_literal_text(sys.argv, TEXT_FLAGS))
    find_behaviors()


if __name__ == "__main__":
    main()
