"""Functions of a user's own, named as ``module:function``."""

import importlib
from collections.abc import Callable
from typing import Any


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
