"""What a behaviour is: a label that a pure rule gives to the states of one episode.

One rule labels demonstrations and rollouts alike, so that their histograms can be compared. Every task of
this package carries its own rule; a user names another one as ``module:function``.
"""

import importlib
from collections.abc import Callable, Mapping

import numpy as np

BehaviorRule = Callable[[Mapping[str, np.ndarray]], str]
"""Maps an episode's observations, ``{"observation.state": (T, d), ...}``, to a label.

The keys are LeRobot's feature names; T counts the states of the episode, the last one included where it is
known (rollouts) or recorded (demonstrations). An episode that fails the task gets a label of its own, which
no successful episode has.
"""


def load_behavior_rule(path: str) -> BehaviorRule:
    """Import a behaviour rule given as ``module:function``.

    Args:
        path: Dotted module and function name, for example ``my_project.rules:which_side``.

    Raises:
        ValueError: If the path has another form, or the module or the function does not exist.
    """
    module_name, separator, function_name = path.partition(":")
    if not (module_name and separator and function_name):
        raise ValueError(f"behavior_rule={path!r}: expected 'module:function', e.g. 'my_project.rules:side'")
    try:
        rule = getattr(importlib.import_module(module_name), function_name)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"behavior_rule={path!r}: {error}; is the module on PYTHONPATH and spelled right?"
        ) from error
    except AttributeError as error:
        raise ValueError(f"behavior_rule={path!r}: {error}") from error
    if not callable(rule):
        raise ValueError(f"behavior_rule={path!r}: {function_name} is not callable")
    return rule
