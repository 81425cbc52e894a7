"""Behaviour rules by their names: of a task, of a user, or found in a dataset."""

from pathlib import Path

from lerobot_swr.behaviors import DATASET_RULES, BehaviorRule
from lerobot_swr.user_functions import load_function


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
