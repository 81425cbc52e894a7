"""What is asked of a dataset before any work: its format, features, dimensions and numbers of frames."""

import json
import shlex
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import packaging.version
import pyarrow as pa
import pyarrow.parquet as pq
from lerobot.datasets import CODEBASE_VERSION, LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_STATE

from lerobot_swr.dataset_files import all_files, episode_column, is_numeric, listed_files

Shapes = Mapping[str, Sequence[int]]


def edit_command(meta: LeRobotDatasetMetadata, operation: str) -> str:
    """LeRobot's command that edits this dataset in its place."""
    root = shlex.quote(str(meta.root))
    return (
        f"lerobot-edit-dataset --repo_id={meta.repo_id} --root={root} --new_root={root} "
        f"--operation.type={operation}"
    )


def check_format(root: Path, repo_id: str | None = None) -> None:
    """Refuse a folder whose dataset this LeRobot cannot read.

    Raises:
        ValueError: If the metadata are of another format or incomplete, with the command that converts them.
    """
    info_file = root / "meta" / "info.json"
    if not info_file.is_file():
        return
    where = f"dataset.root={str(root)!r}"
    try:
        info = json.loads(info_file.read_text())
        version = packaging.version.parse(str(info["codebase_version"]))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{where}: meta/info.json is damaged ({error!r}); copy it again") from error
    current = packaging.version.parse(CODEBASE_VERSION)
    if version.major < current.major:
        first = "" if version >= packaging.version.parse("2.1") else "to v2.1 with an earlier LeRobot, then "
        raise ValueError(
            f"{where} has LeRobot's format v{version}, this LeRobot reads {CODEBASE_VERSION}: convert it "
            f"{first}in its place with: python -m lerobot.scripts.convert_dataset_v21_to_v30 "
            f"--repo-id={repo_id or f'local/{root.name}'} --root={shlex.quote(str(root))} --push-to-hub=false"
        )
    if version.major > current.major:
        raise ValueError(
            f"{where} has LeRobot's format v{version}, this LeRobot reads {CODEBASE_VERSION}: update lerobot"
        )
    needed = {"meta/tasks.parquet": info.get("total_tasks"), "meta/episodes": info.get("total_episodes")}
    missing = [name for name, count in needed.items() if count and not (root / name).exists()]
    if missing and any(root.glob("data/*/*.parquet")):  # else LeRobot downloads the rest
        raise ValueError(f"{where}: {', '.join(missing)} is missing; copy or download the dataset again")


def describe_features(features: Mapping[str, dict]) -> str:
    """Names, types and shapes of a dataset's own features, as messages list them."""
    own = {key: ft for key, ft in features.items() if key not in _BOOKKEEPING}
    return ", ".join(f"{key} ({ft['dtype']} {list(ft['shape'])})" for key, ft in own.items()) or "none"


_BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def missing_feature(policy_type: str, key: str, meta: LeRobotDatasetMetadata) -> str:
    """What to say where a dataset lacks the state or the action."""
    vectors = [name for name, ft in meta.features.items() if is_numeric(ft) and name not in _BOOKKEEPING]
    others = [name for name in vectors if name != "action" and not name.startswith("next.")]
    has = f"the dataset {meta.root} has: {describe_features(meta.features)}"
    if key != OBS_STATE:
        return (
            f"policy {policy_type!r} needs the feature {key!r}; {has}; rename the one that holds the actions"
        )
    if not others:
        return (
            f"policy {policy_type!r} learns from numbers and needs the feature {key!r}; {has}: pictures "
            "alone do not do; demonstrations are compared by numbers, whatever the backbone sees; record the "
            "robot's state, too, or use another policy (--policy.type=act)"
        )
    return (
        f"policy {policy_type!r} needs the feature {key!r}; {has}; if the robot's state is "
        f"{' or '.join(others)}, rename it (docs/datasets.md)"
    )


def check_dimensions(
    where: str, found: Shapes, expected: Shapes, advice: str, owner: str = "the checkpoint"
) -> None:
    """Refuse features that have another number of dimensions than is expected.

    Args:
        where: The flag and value that brings the features.
        found: Feature to shape, there; features that are absent are not looked at.
        expected: Feature to shape.
        advice: What to do.
        owner: Where the expected shapes come from.

    Raises:
        ValueError: Naming the first such feature and both shapes.
    """
    for key, shape in expected.items():
        if key in found and np.prod(found[key]) != np.prod(shape):
            raise ValueError(
                f"{where}: feature {key!r} has shape {list(found[key])}, in {owner} it has {list(shape)}; "
                f"{advice}"
            )


def check_frame_numbers(
    meta: LeRobotDatasetMetadata, keys: Collection[str], episodes: Sequence[int] | None
) -> None:
    """Refuse to train where LeRobot's numbers of frames lead to other frames than the metadata say.

    LeRobot counts frames through all files in the data folder, and finds those of chosen episodes by the
    column ``index``. Stray files that do not disturb it are ignored.

    Args:
        meta: Metadata of the training dataset.
        keys: Features that are trained on.
        episodes: Those to train on; None for all.

    Raises:
        ValueError: Naming the file or episode at fault.
    """
    name = f"dataset {meta.root}"
    begin, end = (episode_column(meta, f"dataset_{side}_index") for side in ("from", "to"))
    order = np.argsort(begin, kind="stable")
    if not np.array_equal(begin[order], np.r_[0, end[order][:-1]]):
        in_turn = np.cumsum(end - begin) - (end - begin)
        place = np.flatnonzero(begin != in_turn)[0]
        raise ValueError(
            f"{name}: in meta/episodes, episode {place} begins at frame {begin[place]} "
            f"(dataset_from_index) instead of {in_turn[place]}: LeRobot would train on some frames twice "
            "and on others never; write the column anew, or merge the parts with lerobot-edit-dataset "
            "--operation.type=merge"
        )
    listed = listed_files(meta)
    strays = [path for path in all_files(meta) if path not in listed]
    if strays:
        _check_strays(meta, keys, episodes, list(listed), strays)
    if episodes is not None:
        _check_index(meta, episodes, list(listed))


def _check_strays(
    meta: LeRobotDatasetMetadata,
    keys: Collection[str],
    episodes: Sequence[int] | None,
    listed: list[Path],
    strays: list[Path],
) -> None:
    """Refuse files beside those of the metadata that LeRobot would read instead of them."""
    columns = ["episode_index", *keys]
    try:
        if episodes is None:
            read, own = (_table(files, columns) for files in (sorted([*listed, *strays]), listed))
            harmless = read.slice(0, meta.total_frames).equals(own.slice(0, meta.total_frames))
        else:
            held = _table(strays, ["episode_index"]).column("episode_index").to_numpy()
            harmless = not np.isin(held, episodes).any()
    except pa.ArrowException:  # of other columns or types
        harmless = False
    if not harmless:
        raise ValueError(
            f"dataset {meta.root}: {', '.join(str(path.relative_to(meta.root)) for path in strays)} is not "
            "among the data files of meta/episodes, but LeRobot reads it with them and would train on its "
            "frames; move it out of the data folder"
        )


def _table(files: Sequence[Path], columns: Sequence[str]) -> pa.Table:
    tables = [pq.read_table(file, columns=columns, partitioning=None) for file in files]
    return pa.concat_tables([table.replace_schema_metadata(None) for table in tables]).combine_chunks()


def _check_index(meta: LeRobotDatasetMetadata, episodes: Sequence[int], listed: list[Path]) -> None:
    """Refuse a choice of episodes whose frames LeRobot would not find."""
    table = _table(listed, ["episode_index", "index"])
    owner, index = (table[key].to_numpy() for key in ("episode_index", "index"))
    begin, end = (episode_column(meta, f"dataset_{side}_index") for side in ("from", "to"))
    chosen = np.isin(owner, episodes)
    order = np.lexsort((index[chosen], owner[chosen]))
    owner, index = owner[chosen][order], index[chosen][order]
    rank = np.arange(len(owner)) - np.searchsorted(owner, owner)  # in its episode
    wrong = np.flatnonzero(index != begin[owner] + rank)
    if len(wrong):
        episode = owner[wrong[0]]
        raise ValueError(
            f"dataset {meta.root}: the column index of episode {episode} does not run from {begin[episode]} "
            f"to {end[episode] - 1}, as meta/episodes has it, so LeRobot finds other frames for a choice of "
            "episodes; train on all (no dataset.episodes, no dataset.eval_split), or write the column anew"
        )
