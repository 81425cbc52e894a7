"""What a behaviour is: a label that a pure rule gives to the states of one episode.

One rule labels demonstrations and rollouts alike, so that their histograms can be compared. Every task of
this package carries its own rule; a user names another one as ``module:function``.
"""

import importlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

BehaviorRule = Callable[[Mapping[str, np.ndarray]], str]
"""Maps an episode's observations, ``{"observation.state": (T, d), ...}``, to a label.

The keys are LeRobot's feature names; T counts the states of the episode, the last one included where it is
known (rollouts) or recorded (demonstrations). An episode that fails the task gets a label of its own, which
no successful episode has.
"""


DATASET_RULES = {
    "maze2d_small": "lerobot_swr.envs.maze2d.behavior:small",
    "maze2d_medium": "lerobot_swr.envs.maze2d.behavior:medium",
    "maze2d_large": "lerobot_swr.envs.maze2d.behavior:large",
    "maze2d_scenes": "lerobot_swr.envs.maze2d.behavior:scenes",
    "maze2d_scenes_large": "lerobot_swr.envs.maze2d.behavior:scenes_large",
    "d3il_avoiding": "lerobot_swr.envs.d3il.behavior:avoiding_behavior",
    "d3il_aligning": "lerobot_swr.envs.d3il.behavior:aligning_behavior",
}
"""``robot_type`` of this package's own datasets to the rule that labels their episodes."""


def dataset_behavior_rule(path: str | None, robot_type: str | None) -> BehaviorRule | None:
    """The rule that labels a dataset's demonstrations.

    Args:
        path: ``module:function`` or ``behaviors.json``; None takes the rule of this package's own datasets.
        robot_type: Of the dataset's metadata.

    Returns:
        None if no path is given and the dataset is not this package's.

    Raises:
        ValueError: If the path does not lead to a function.
    """
    path = path or DATASET_RULES.get(robot_type or "")
    return None if path is None else load_behavior_rule(path)


def load_behavior_rule(path: str) -> BehaviorRule:
    """A behaviour rule given as ``module:function``, or as the file that ``lerobot-swr-behaviors`` writes.

    Args:
        path: Dotted module and function name, for example ``my_project.rules:which_side``; or a file
            ``….json``.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the path has another form, the module or the function does not exist, or the file
            holds something else.
    """
    if path.endswith(".json"):
        # Clustering needs scikit-learn, which takes a while to import.
        from lerobot_swr.discovery.rule import DiscoveredRule

        return DiscoveredRule.load(Path(path))
    return load_function("behavior_rule", path)


def load_function(key: str, path: str) -> Callable[..., Any]:
    """Import a user's function given as ``module:function``.

    Args:
        key: The option that names it, for messages.
        path: Dotted module and function name.

    Raises:
        ValueError: If the path has another form, or the module or the function does not exist.
    """
    module_name, separator, function_name = path.partition(":")
    if not (module_name and separator and function_name):
        raise ValueError(f"{key}={path!r}: expected 'module:function', e.g. 'my_project.rules:side'")
    try:
        function = getattr(importlib.import_module(module_name), function_name)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"{key}={path!r}: {error}; is the module on PYTHONPATH and spelled right?"
        ) from error
    except AttributeError as error:
        raise ValueError(f"{key}={path!r}: {error}") from error
    if not callable(function):
        raise ValueError(f"{key}={path!r}: {function_name} is not callable")
    return function


def load_style_metrics(paths: str | None) -> dict[str, Callable[..., Any]]:
    """Import user metrics given as ``module:function``, several separated by commas, by function name.

    Raises:
        ValueError: If a path does not lead to a function.
    """
    functions = [path for path in listed(paths) if not is_metric_file(path)]
    return {path.partition(":")[2]: load_function("style_metrics", path) for path in functions}


def is_metric_file(path: str) -> bool:
    """Whether a part of ``style_metrics`` is a file of values rather than ``module:function``."""
    return path.lower().endswith((".json", ".csv"))


def listed(paths: str | None) -> list[str]:
    """The parts of a list separated by commas."""
    return [path.strip() for path in (paths or "").split(",") if path.strip()]
