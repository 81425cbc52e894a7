"""The columns of a dataset: a recipe's demonstrations as an environment with that ``obs_type`` shows them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.envs.observed import CAMERA, SIMULATED, check_obs_type, motion, shows_pictures

PICTURE = f"{OBS_IMAGES}.{CAMERA}"


def check_columns(recipe: DatasetRecipe, obs_type: str) -> None:
    """Refuse an unknown kind of observation, and pictures of a dataset that has none.

    Raises:
        ValueError: Naming the value.
    """
    check_obs_type(obs_type)
    if shows_pictures(obs_type) and recipe.pictures is None:
        raise ValueError(f"obs_type={obs_type!r}: {recipe.name} has no pictures; leave out --images")


def number_columns(features: Mapping[str, Sequence[str]]) -> dict[str, dict[str, Any]]:
    """LeRobot's features of observations and actions, each with the names of its dimensions."""
    return {
        key: {"dtype": "float32", "shape": (len(names),), "names": list(names)}
        for key, names in features.items()
    }


def feature_columns(recipe: DatasetRecipe, obs_type: str) -> dict[str, dict[str, Any]]:
    """LeRobot's features of a recipe.

    Args:
        recipe: What to write.
        obs_type: Of the environment that the dataset is for.
    """
    numbers = number_columns(recipe.features)
    if obs_type == "state":
        return numbers
    shape = (*recipe.picture_size, 3)
    picture = {PICTURE: {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}}
    if obs_type == "both":
        return {**numbers, **picture}
    state, scene = numbers[OBS_STATE], numbers[OBS_ENV_STATE]
    moved = {**state, "names": [f"{name}_change" for name in state["names"]]}
    hidden = dict(zip(SIMULATED, (state, scene), strict=True))
    return {OBS_STATE: moved, **picture, ACTION: numbers[ACTION], **hidden}


def frame_columns(
    recipe: DatasetRecipe, demonstration: Demonstration, obs_type: str
) -> dict[str, np.ndarray]:
    """Feature name to the (T, ...) frames of one episode.

    Args:
        recipe: Of the dataset.
        demonstration: The episode.
        obs_type: Of the environment that the dataset is for.
    """
    numbers: Mapping[str, np.ndarray] = demonstration.observations
    if obs_type == "state":
        return {**numbers, ACTION: demonstration.actions}
    assert recipe.pictures is not None
    picture = {PICTURE: recipe.pictures(demonstration)}
    if obs_type == "both":
        return {**numbers, **picture, ACTION: demonstration.actions}
    state, scene = numbers[OBS_STATE], numbers[OBS_ENV_STATE]
    hidden = dict(zip(SIMULATED, (state, scene), strict=True))
    return {OBS_STATE: motion(state), **picture, ACTION: demonstration.actions, **hidden}
