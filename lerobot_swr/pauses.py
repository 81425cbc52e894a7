"""Pauses of a demonstrator: frames that tell a policy without memory nothing but to stay where it is.

A person hesitates before moving off, or in the middle of the way. A policy that sees the present observation
alone cannot wait and then go on: while nothing changes, the frames of the pause and the frame in which the
person moved on look the same, and the mean of their actions is a creep, the slower the longer the pause. Such
frames can only be left out.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_swr.trajectories import Trajectories

STILL = 0.1  # largest movement of an observation from one frame of a pause to the next, in mean steps
DRIFT = 1.0  # and over the whole pause: a slow movement is none
HELD = 0.02  # largest change of an action in a pause, in standard deviations
NOISE = 0.8  # an observation whose mean step is so many standard deviations only jitters (white noise: 1.13)


def pause_frames(trajectories: Trajectories, observations: Sequence[str], action: str) -> np.ndarray:
    """Which frames are pauses.

    Those in which no observation moves, while the action is the one before or after, and after which
    something moves again in the same episode. What an episode ends with is no pause: there, staying is what
    was shown. Dimensions of the observations that only jitter tell nothing.

    Args:
        trajectories: Episodes with F frames in all.
        observations: All features that the policy sees.
        action: Name of the action.

    Returns:
        (F,) bool.
    """
    last = np.zeros(trajectories.lengths.sum(), dtype=bool)
    last[np.cumsum(trajectories.lengths) - 1] = True
    seen = np.concatenate([trajectories.columns[key] for key in observations], axis=1)
    moved = _to_next(seen, last)
    step = moved.mean(axis=0)  # (d,)
    telling = step < NOISE * seen.std(axis=0)
    if not telling.any():
        return np.zeros(len(seen), dtype=bool)
    seen, moved, step = seen[:, telling], moved[:, telling], step[telling]
    changed = _to_next(trajectories.columns[action], last)
    as_next = (changed <= HELD * trajectories.columns[action].std(axis=0)).all(axis=1) & ~last
    as_before = np.append(True, (as_next | last)[:-1])  # an episode may begin with a pause
    held = as_next | as_before
    idle = (moved <= STILL * step).all(axis=1) & held
    frames = np.arange(len(idle))
    last_moving = np.maximum.reduceat(np.where(idle, -1, frames), trajectories.starts)  # (N,)
    idle &= frames < np.repeat(last_moving, trajectories.lengths)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], idle, [False]])))
    for first, moving in edges.reshape(-1, 2):  # `moving` is the frame after, in the same episode
        if (np.abs(seen[moving] - seen[first]) > DRIFT * step).any():
            idle[first:moving] = False
    return idle


def _to_next(values: np.ndarray, last: np.ndarray) -> np.ndarray:
    """(F, d) absolute changes to the next frame; 0 for an episode's last one."""
    changes = np.abs(np.diff(values, axis=0, append=values[-1:]))
    changes[last] = 0
    return changes
