"""Turns the D3IL benchmark's own recordings into datasets like those of the scripted demonstrators.

A recording is a pickled dictionary of arrays over T states: ``robot`` with the desired and the actual tool
position ``des_c_pos`` and ``c_pos`` (T, 3), and for aligning ``push-box`` and ``target-box`` with ``pos`` (T,
3) and ``quat`` (T, 4, w first). As in the benchmark (Jia et al., ICLR 2024), actions are the differences of
the desired position.

The benchmark records desired and measured quantities together *before* the robot moves: frame t holds where
the tool is to go and where everything was before it went there. Our environments observe *after* the step, so
the state that belongs to frame t is its desired position with what was measured one frame later. A state that
keeps the recorded pairs is one step staler than any that a policy meets in the environment.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_swr.demos.d3il_aligning import ALIGNING_RECIPES
from lerobot_swr.demos.d3il_avoiding import AVOIDING_RECIPES, SCATTERED_BEHAVIORS
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.demos.restricted_pickle import load_recording
from lerobot_swr.envs.d3il.behavior import avoiding_behavior
from lerobot_swr.envs.d3il.layouts import ACTION_LIMIT_M, AVOIDING_SCENE

TASKS = {"avoiding": AVOIDING_RECIPES[0], "aligning": ALIGNING_RECIPES[0]}
"""Tasks with recordings, and the recipe of the scripted dataset with the same features."""
UNBALANCED = "unbalanced_avoiding"
"""A selection of the recordings of avoiding, by `unbalanced`."""

UNBALANCED_COUNTS = (4,) * 6 + (3,) * 6 + (2,) * 6 + (1,) * 6
"""Recordings kept of each of the 24 behaviours, of which the benchmark has four each; the k-th count belongs
to the k-th of `SCATTERED_BEHAVIORS`."""


def recorded_recipe(folder: Path, task: str, file_list: Path | None = None) -> DatasetRecipe:
    """A recipe whose demonstrations are recordings.

    Args:
        folder: Holds the recordings, ``*.pkl``, directly or in subfolders.
        task: ``avoiding``, ``aligning`` or ``unbalanced_avoiding``, a selection (`unbalanced`) of the
            recordings of avoiding.
        file_list: A pickled list of file names in `folder` (the benchmark's train or evaluation split); by
            default all recordings, sorted by name.

    Raises:
        ValueError: If the task is unknown, there is no recording, or the file list cannot be read.
        FileNotFoundError: If the folder, the list or a listed file does not exist.
    """
    if task not in (*TASKS, UNBALANCED):
        known = ", ".join((*TASKS, UNBALANCED))
        raise ValueError(f"task={task!r}: recordings can be converted for {known}")
    if not folder.is_dir():
        raise FileNotFoundError(f"from_d3il={str(folder)!r}: no such folder")
    files = _all_recordings(folder) if file_list is None else _listed_recordings(folder, file_list)
    if not files:
        raise ValueError(f"from_d3il={str(folder)!r}: no recordings (*.pkl) in it")

    if task == UNBALANCED:
        labels = [avoiding_behavior(convert_recording(path, "avoiding").observations) for path in files]
        if not unbalanced(labels, seed=0):
            raise ValueError(
                f"from_d3il={str(folder)!r}: none of these {len(files)} recordings passes the obstacles; "
                f"they show {', '.join(sorted(set(labels)))}"
            )
        return _recipe_of(task, "avoiding", lambda seed: [files[i] for i in unbalanced(labels, seed)])
    return _recipe_of(task, task, lambda seed: files)


def _recipe_of(name: str, task: str, chosen: Callable[[int], list[Path]]) -> DatasetRecipe:
    """A recipe of the recordings of a task that a seed chooses."""

    def demonstrations(seed: int) -> Iterator[Demonstration]:
        return (convert_recording(path, task) for path in chosen(seed))

    return replace(
        TASKS[task],
        name=human_name(name),
        n_episodes=len(chosen(0)),
        demonstrations=demonstrations,
        resumable_demonstrations=None,
    )


def human_name(task: str) -> str:
    """What the dataset of a task's recordings is called."""
    return f"d3il_human_{task}"


def unbalanced(labels: Sequence[str], seed: int) -> list[int]:
    """Which recordings of avoiding make up the unbalanced selection, in their order.

    Args:
        labels: Behaviour of each recording.
        seed: Decides which recordings of a behaviour are kept; how many is `UNBALANCED_COUNTS`, or as many as
            there are.
    """
    rng = np.random.default_rng(seed)
    kept: list[int] = []
    for k, count in enumerate(UNBALANCED_COUNTS):
        of_it = [i for i, label in enumerate(labels) if label == SCATTERED_BEHAVIORS[k]]
        kept += rng.permutation(of_it)[:count].tolist()
    return sorted(map(int, kept))


def _all_recordings(folder: Path) -> list[Path]:
    """Every pickle but the benchmark's lists of files and contexts."""
    paths = (path for path in folder.rglob("*.pkl") if not path.stem.endswith(("_files", "_contexts")))
    return sorted(paths)


def _listed_recordings(folder: Path, file_list: Path) -> list[Path]:
    names = load_recording(file_list)
    names = names.tolist() if isinstance(names, np.ndarray) else names
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"file_list={str(file_list)!r}: expected a pickled list of file names")
    paths = []
    for name in names:
        path = folder / name
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise ValueError(f"file_list={str(file_list)!r}: {name!r} is not a name inside the folder")
        if not path.is_file():
            raise FileNotFoundError(f"file_list={str(file_list)!r} names {name!r}, which is not in {folder}")
        paths.append(path)
    return paths


def convert_recording(path: Path, task: str) -> Demonstration:
    """Read one recording of T frames as the T - 1 states and actions that our environment would record.

    Measured quantities (tool, boxes) are taken one frame later than the desired position beside them, so the
    last frame has no state of its own.

    Raises:
        ValueError: Naming the file and the key, if a key is missing or its array has a wrong shape or is not
            finite.
    """
    recording = load_recording(path)
    desired = _array(path, recording, "robot", "des_c_pos", 3)
    n_states = len(desired)
    if n_states < 2:
        raise ValueError(f"{path}: robot/des_c_pos has {n_states} states; an action needs at least 2")
    actual = _array(path, recording, "robot", "c_pos", 3, n_states)
    if task == "avoiding":
        desired, actual = desired[:, :2], actual[:, :2]
        scene = np.tile(AVOIDING_SCENE, (n_states, 1))
    else:
        scene = np.concatenate(
            [
                _array(path, recording, body, key, width, n_states)
                for body in ("push-box", "target-box")
                for key, width in (("pos", 3), ("quat", 4))
            ],
            axis=1,
        )
    actions = np.diff(desired, axis=0)
    largest = float(np.abs(actions).max())
    if largest > ACTION_LIMIT_M:
        logging.warning(
            "%s: an action of %.3f m; the environment clips at %.3f m", path, largest, ACTION_LIMIT_M
        )
    return Demonstration(
        {
            "observation.state": np.concatenate([desired[:-1], actual[1:]], axis=1).astype(np.float32),
            "observation.environment_state": scene[1:].astype(np.float32),
        },
        actions.astype(np.float32),
    )


def _array(
    path: Path, recording: Any, group: str, key: str, width: int, n_states: int | None = None
) -> np.ndarray:
    """(T, width) float64 array of a recording."""
    if not isinstance(recording, dict) or not isinstance(recording.get(group), dict):
        raise ValueError(f"{path}: no dictionary {group!r} in it; is it a recording of this task?")
    if key not in recording[group]:
        raise ValueError(f"{path}: no {group}/{key} in it; it has {', '.join(map(str, recording[group]))}")
    try:
        array = np.asarray(recording[group][key], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {group}/{key} is not an array of numbers ({error})") from error
    rows = "T" if n_states is None else n_states
    if array.ndim != 2 or array.shape[1] != width or len(array) != (n_states or len(array)):
        raise ValueError(f"{path}: {group}/{key} has shape {array.shape}, expected ({rows}, {width})")
    if not np.isfinite(array).all():
        raise ValueError(f"{path}: {group}/{key} holds NaN or infinite values")
    return array
