"""What an environment shows of its state: numbers, pictures, or both (``--env.obs_type``).

============  ===============================================================================================
``state``     ``agent_pos`` and ``environment_state``: numbers alone
``both``      the same, and ``pixels``
``pixels``    ``pixels``, and ``agent_pos`` without any position: how far it has changed since the last step.
              The numbers of ``state`` go along under names that no policy looks at, for behaviour rules
============  ===============================================================================================
"""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np
from gymnasium import spaces
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_IMAGES, OBS_PREFIX

ObsType = Literal["state", "pixels", "both"]

CAMERA = "top"
"""Name of the camera: pictures are ``observation.images.top``."""
SIMULATOR = "simulator."
"""Before the names of numbers that the simulator knows and a policy must not see."""
SIMULATED = ("simulator.state", "simulator.environment_state")
"""Columns of datasets for ``obs_type=pixels``, in which rules find what ``observation.*`` does not tell."""
_NAMES = {"agent_pos": SIMULATED[0], "environment_state": SIMULATED[1]}


def check_obs_type(obs_type: str) -> None:
    """Refuse an unknown kind of observation.

    Raises:
        ValueError: Naming it.
    """
    if obs_type not in get_args(ObsType):
        raise ValueError(f"obs_type={obs_type!r}: expected 'state', 'pixels' or 'both'")


def shows_pictures(obs_type: str) -> bool:
    """Whether observations have pictures."""
    return obs_type != "state"


def picture_features(obs_type: str, height: int, width: int) -> dict[str, PolicyFeature]:
    """The camera as an environment's configuration declares it, if there is one."""
    if not shows_pictures(obs_type):
        return {}
    return {f"pixels/{CAMERA}": PolicyFeature(FeatureType.VISUAL, (height, width, 3))}


PICTURE_NAMES = {f"pixels/{CAMERA}": f"{OBS_IMAGES}.{CAMERA}"}
"""Of the camera, in an environment's configuration and in LeRobot's datasets."""


def observed(
    obs_type: str, numbers: Mapping[str, np.ndarray], before: np.ndarray, pictures: Any = None
) -> dict[str, Any]:
    """One observation, or a batch of them.

    Args:
        obs_type: What is shown.
        numbers: ``agent_pos`` and ``environment_state``.
        before: ``agent_pos`` at the last step; the present one at the first.
        pictures: (..., height, width, 3) uint8; None without a camera.
    """
    if obs_type == "state":
        return dict(numbers)
    return _shown(obs_type, numbers, numbers["agent_pos"] - before, pictures)


def observation_space(
    obs_type: str, numbers: Mapping[str, spaces.Box], picture_size: tuple[int, int]
) -> spaces.Dict:
    """Space of one observation.

    Args:
        obs_type: What is shown.
        numbers: Spaces of ``agent_pos`` and ``environment_state``.
        picture_size: Height and width of the pictures.
    """
    if obs_type == "state":
        return spaces.Dict(dict(numbers))
    place = numbers["agent_pos"]
    reach = (place.high - place.low).astype(np.float32)
    moved = spaces.Box(-reach, reach, dtype=np.float32)
    picture = spaces.Box(0, 255, (*picture_size, 3), np.uint8)
    shown = _shown(obs_type, numbers, moved, picture)
    return spaces.Dict({**shown, "pixels": spaces.Dict(shown["pixels"])})


def _shown(obs_type: str, numbers: Mapping[str, Any], moved: Any, picture: Any) -> dict[str, Any]:
    pixels = {"pixels": {CAMERA: picture}}
    if obs_type == "both":
        return {**numbers, **pixels}
    return {"agent_pos": moved, **pixels, **{_NAMES[key]: value for key, value in numbers.items()}}


def motion(states: np.ndarray) -> np.ndarray:
    """(T, d) how far the states (T, d) of an episode have changed since the last step; 0 at first."""
    return np.diff(states, axis=0, prepend=states[:1])


def as_simulated(observations: Mapping[str, Any]) -> dict[str, Any]:
    """An episode as the simulator knows it: what a camera policy does not see takes its usual names."""
    hidden = {key: value for key, value in observations.items() if SIMULATOR in key}
    seen = {key: value for key, value in observations.items() if key not in hidden}
    return {**seen, **{OBS_PREFIX + key.split(SIMULATOR)[1]: value for key, value in hidden.items()}}
