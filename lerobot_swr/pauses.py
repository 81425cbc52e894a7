"""Pauses of a demonstrator: frames that tell a policy without memory nothing but to stay where it is.

A person hesitates before moving off, or in the middle of the way. A policy that sees the present observation
alone cannot wait and then go on: while nothing changes, the frames of the pause and the frame in which the
person moved on look the same, and the mean of their actions is a creep, the slower the longer the pause. Such
frames can only be left out.
"""

from collections.abc import Sequence

import numpy as np

from lerobot_swr.trajectories import Trajectories

STILL = 0.1  # largest movement of an observation in a pause, in mean steps of the dataset
HELD = 0.02  # largest change of an action in a pause, in standard deviations of the dataset


def pause_frames(trajectories: Trajectories, observations: Sequence[str], action: str) -> np.ndarray:
    """Which frames are pauses.

    Those in which no observation moves, while the action stays as it was, and after which something moves
    again in the same episode. What an episode ends with is no pause: there, staying is what was shown.

    Args:
        trajectories: Episodes with F frames in all.
        observations: All features that the policy sees.
        action: Name of the action.

    Returns:
        (F,) bool.
    """
    seen = np.concatenate([trajectories.columns[key] for key in observations], axis=1)
    first = np.zeros(len(seen), dtype=bool)
    first[trajectories.starts] = True
    moved = np.abs(np.diff(seen, axis=0, append=seen[-1:]))  # (F, d), to the next frame
    moved[np.append(first[1:], True)] = 0  # the last frames have no next one
    changed = np.abs(np.diff(trajectories.columns[action], axis=0, prepend=0))  # (F, A), from the last frame
    changed[first] = 0  # an episode may begin with a pause
    still = (moved <= STILL * moved.mean(axis=0)).all(axis=1)
    held = (changed <= HELD * trajectories.columns[action].std(axis=0)).all(axis=1)
    idle = still & held
    last_moving = np.maximum.reduceat(np.where(idle, -1, np.arange(len(idle))), trajectories.starts)  # (N,)
    return idle & (np.arange(len(idle)) < np.repeat(last_moving, trajectories.lengths))
