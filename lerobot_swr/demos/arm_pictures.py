"""What a camera sees of an arm's demonstration: its actions are played again, the objects put in place."""

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE

from lerobot_swr.demos.recipe import Demonstration
from lerobot_swr.envs.d3il.layouts import CAMERA_SIZE

PICTURE_SIZE = (CAMERA_SIZE, CAMERA_SIZE)


def avoiding_pictures(demonstration: Demonstration) -> np.ndarray:
    """(T, CAMERA_SIZE, CAMERA_SIZE, 3) uint8 of every state of a demonstration of avoiding."""
    from lerobot_swr.envs.d3il.avoiding import AvoidingEnv  # needs MuJoCo, which listing the recipes must not
    from lerobot_swr.envs.d3il.recorded_starts import avoiding_start

    return _pictures(AvoidingEnv(), avoiding_start(demonstration.observations), demonstration)


def aligning_pictures(demonstration: Demonstration) -> np.ndarray:
    """(T, CAMERA_SIZE, CAMERA_SIZE, 3) uint8 of every state of a demonstration of aligning.

    A push that is repeated open loop may end elsewhere; box and target are shown where they were recorded.
    """
    from lerobot_swr.envs.d3il.aligning import AligningEnv
    from lerobot_swr.envs.d3il.recorded_starts import aligning_start

    return _pictures(AligningEnv(), aligning_start(demonstration.observations), demonstration)


def _pictures(env, start: dict, demonstration: Demonstration) -> np.ndarray:
    env.reset(seed=0, options=start)
    found = []
    for scene, action in zip(demonstration.observations[OBS_ENV_STATE], demonstration.actions, strict=True):
        found.append(env.picture_of({"environment_state": scene}))
        env.step(action)
    return np.stack(found)
