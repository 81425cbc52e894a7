"""Which behaviour an episode of PushT shows: a pure function of its states, without a simulator."""

from collections.abc import Mapping

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_swr.envs.pusht.block import GOAL_POSE, OUTLINE, SIDES, keypoints_of, nearest_side
from lerobot_swr.envs.pusht.dependencies import shapely

REACHED = 0.75
"""Share of the goal that the block has to cover for an episode to have a behaviour. The environment's success
takes more than .95, which no state of the 206 human recordings has: their best cover .77 to .90."""

PUSH = 20.0
"""Pixels by which the block, 120 wide, has to be moved from a side for that to be a push."""

STILL = 1.0
"""Pixels per step below which the block counts as lying still: trembling adds up to no push."""

UNFINISHED = "unfinished"
NO_PUSH = "no_push"


def goal_coverage(observations: Mapping[str, np.ndarray]) -> np.ndarray:
    """(T,) share of the goal that the block covers, from ``observation.environment_state`` (T, 16)."""
    keypoints = np.asarray(observations[OBS_ENV_STATE], np.float64).reshape(-1, 8, 2)
    goal = shapely.Polygon(keypoints_of(GOAL_POSE)[list(OUTLINE)])
    return shapely.area(shapely.intersection(shapely.polygons(keypoints[:, OUTLINE]), goal)) / goal.area


def first_push(observations: Mapping[str, np.ndarray]) -> str:
    """The side of the T from which it is pushed first, as seen from the T.

    That is the strategy in the human recordings: a person sees where the block lies and decides where to take
    hold of it; that push brings and turns it, those that follow correct. The label does not change when a
    recording begins earlier, pauses or goes on, and the start does not settle it. It does settle the sense in
    which the block is turned, in 203 of 206 recordings the shorter way round: that is no strategy. See
    docs/pusht.md for figures, and for other rules that were tried.

    Args:
        observations: ``observation.state`` (T, 2), the agent's position; ``observation.environment_state``
            (T, 16), the block's keypoints; both in pixels.

    Returns:
        One of `SIDES`: the first from which the block is moved by `PUSH` pixels in all, counting the mean of
        its keypoints and steps of at least `STILL`; if none moves it that far, the one that moves it most;
        ``"no_push"`` if nothing moves it. ``"unfinished"`` if it never covers `REACHED` of the goal. What
        comes after the first time that it does is ignored.
    """
    reached = goal_coverage(observations) >= REACHED
    if not reached.any():
        return UNFINISHED
    end = int(reached.argmax()) + 1
    keypoints = np.asarray(observations[OBS_ENV_STATE], np.float64).reshape(-1, 8, 2)
    agent = np.asarray(observations[OBS_STATE], np.float64)
    moved = np.linalg.norm(np.diff(keypoints[:end], axis=0), axis=2).mean(axis=1)  # (end - 1,)
    moved[moved < STILL] = 0.0
    if not moved.any():
        return NO_PUSH
    pusher = nearest_side(agent[1:end], keypoints[1:end])
    by_side = np.cumsum(moved[:, None] * (pusher[:, None] == np.arange(len(SIDES))), axis=0)
    pushed = (by_side >= PUSH).any(axis=1)  # (end - 1,)
    decided = int(pushed.argmax()) if pushed.any() else -1
    return SIDES[int(by_side[decided].argmax())]
