"""Scripted demonstrators of the D3IL avoiding task: human-like ways through given gaps, and their datasets.

A demonstration leads the desired tool position along a smooth path through free points and through points
inside its gaps, at a varying speed with slow-downs before gaps and a little hand tremor, in the real
simulation. All constants were fixed before any policy was trained on the datasets; lengths are in metres,
times in steps.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import PchipInterpolator

from lerobot_swr.demos.arm_pictures import PICTURE_SIZE, avoiding_pictures
from lerobot_swr.demos.parallel_generation import generate
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.envs.d3il.behavior import AVOIDING_BEHAVIORS, avoiding_behavior, gaps_of_behavior
from lerobot_swr.envs.d3il.layouts import (
    AVOIDING_DESCRIPTION,
    AVOIDING_EPISODE_LENGTH,
    AVOIDING_SCENE_NAMES,
    AVOIDING_START_TOOL,
    FINISH_LINE_Y,
    FPS,
)

# Where the tool may pass each gap: the obstacles' radius plus the rod's leave at least 15 mm on either side.
GAP_RANGES = (
    ((0.37, 0.44), (0.56, 0.63)),
    ((0.30, 0.37), (0.475, 0.525), (0.63, 0.69)),
    ((0.23, 0.295), (0.405, 0.445), (0.555, 0.595), (0.705, 0.74)),
)
LEVEL_Y = (-0.1, 0.08, 0.26)
APPROACH = 0.035  # the tool is in its gap up to this far before and 0.6 of it behind the obstacles
FREE_POINT_SPREAD = 0.02  # standard deviation of the points between the levels
STEP_RANGE = (0.0055, 0.0085)  # mean step of an episode; the reference scripts used 0.005 to 0.010
SPEED_WOBBLE = 0.12  # relative standard deviation of the speed along the way
SLOW_DOWNS = (0, 1, 1, 2)  # how often an episode hesitates; drawn from these
SLOWEST = (0.35, 0.7)  # range of the relative speed in a slow-down
TREMOR = 0.0004  # standard deviation of the hand's noise
MEMORY = 0.9  # correlation of wobble and tremor from one step to the next
MAX_ATTEMPTS = 50


def draw_path(behavior: str, rng: np.random.Generator) -> np.ndarray:
    """(P, 2) densely spaced points from the start through the gaps of `behavior` and past the finish line.

    y grows strictly, so that no gap is passed twice.
    """
    x, y = [AVOIDING_START_TOOL[0]], [AVOIDING_START_TOOL[1]]
    for ranges, gap, level_y in zip(GAP_RANGES, gaps_of_behavior(behavior), LEVEL_Y, strict=True):
        low, high = ranges[gap]
        entry = rng.uniform(low, high)
        leave = np.clip(entry + 0.3 * (high - low) * rng.standard_normal(), low, high)
        y += [level_y - APPROACH * rng.uniform(0.8, 1.0), level_y + 0.6 * APPROACH * rng.uniform(0.8, 1.0)]
        x += [entry, leave]
    x.append(x[-1] + FREE_POINT_SPREAD * rng.standard_normal())
    y.append(FINISH_LINE_Y + 0.08)
    dense_y = np.linspace(y[0], y[-1], 1000)
    return np.stack([PchipInterpolator(y, x)(dense_y), dense_y], axis=1)


def draw_set_points(path: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(T + 1, 2) desired positions along a path, one per step, the start first."""
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    step = rng.uniform(*STEP_RANGE)
    hesitations = [
        (np.interp(rng.choice(LEVEL_Y) - rng.uniform(0.03, 0.1), path[:, 1], arc), rng.uniform(*SLOWEST))
        for _ in range(rng.choice(SLOW_DOWNS))
    ]
    fresh = np.sqrt(1 - MEMORY**2)
    progress, wobble, tremor = 0.0, 0.0, np.zeros(2)
    set_points = [path[0]]
    while progress < arc[-1]:
        wobble = MEMORY * wobble + fresh * rng.standard_normal()
        tremor = MEMORY * tremor + fresh * rng.standard_normal(2)
        pace = step * max(0.3, 1 + SPEED_WOBBLE * wobble) * min(1.0, (len(set_points) + 2) / 8)
        for centre, slowest in hesitations:
            pace *= 1 - (1 - slowest) * np.exp(-(((progress - centre) / 0.025) ** 2))
        progress += pace
        on_path = np.array([np.interp(progress, arc, path[:, 0]), np.interp(progress, arc, path[:, 1])])
        set_points.append(on_path + TREMOR * tremor)
    return np.stack(set_points)


@lru_cache(maxsize=1)
def _environment():
    from lerobot_swr.envs.d3il.avoiding import AvoidingEnv  # needs MuJoCo, which listing the recipes must not

    return AvoidingEnv()


def record(set_points: np.ndarray) -> Demonstration:
    """Lead the desired position through (T + 1, 2) `set_points` until the episode ends.

    The last frame is the state that ended it, with the action that would have come next.
    """
    env = _environment()
    actions = np.diff(set_points, axis=0).astype(np.float32)[:AVOIDING_EPISODE_LENGTH]
    observation, _ = env.reset()
    observations = [observation]
    for action in actions[:-1]:
        observation, _, terminated, _, _ = env.step(action)
        observations.append(observation)
        if terminated:
            break
    return Demonstration(
        {
            "observation.state": np.stack([o["agent_pos"] for o in observations]),
            "observation.environment_state": np.stack([o["environment_state"] for o in observations]),
        },
        actions[: len(observations)],
    )


@dataclass(frozen=True)
class AvoidingJob:
    """Makes episode i of a dataset: one that shows `behaviors[i]`."""

    behaviors: tuple[str, ...]
    seed: int

    def __call__(self, i: int) -> Demonstration:
        """Draw paths until one shows the intended behaviour; nearly always the first does.

        Raises:
            RuntimeError: If none does, i.e. the constants above leave no way.
        """
        rng = np.random.default_rng([self.seed, i])
        for _ in range(MAX_ATTEMPTS):
            demonstration = record(draw_set_points(draw_path(self.behaviors[i], rng), rng))
            if avoiding_behavior(demonstration.observations) == self.behaviors[i]:
                return demonstration
        raise RuntimeError(
            f"episode {i}: no demonstration of {self.behaviors[i]!r} in {MAX_ATTEMPTS} attempts"
        )


def _recipe(name: str, counts: dict[str, int]) -> DatasetRecipe:
    n_episodes = sum(counts.values())

    def job(seed: int) -> AvoidingJob:
        behaviors = [behavior for behavior, count in counts.items() for _ in range(count)]
        return AvoidingJob(tuple(map(str, np.random.default_rng(seed).permutation(behaviors))), seed)

    return DatasetRecipe(
        name=name,
        instruction=AVOIDING_DESCRIPTION,
        fps=FPS,
        robot_type="d3il_avoiding",
        features={
            "observation.state": ("desired_x", "desired_y", "x", "y"),
            "observation.environment_state": AVOIDING_SCENE_NAMES,
            "action": ("dx", "dy"),
        },
        n_episodes=n_episodes,
        demonstrations=lambda seed: map(job(seed), range(n_episodes)),
        behavior_rule=avoiding_behavior,
        pictures=avoiding_pictures,
        picture_size=PICTURE_SIZE,
        resumable_demonstrations=lambda seed, work_dir: generate(job(seed), n_episodes, work_dir),
    )


BALANCED = dict.fromkeys(AVOIDING_BEHAVIORS, 4)

SCATTERED_BEHAVIORS = tuple(AVOIDING_BEHAVIORS[7 * k % 24] for k in range(24))
"""All of them in an order in which neighbours lie far apart: in a skewed dataset, the most frequent first."""
# Skewed like everyday habits: three ways make a third of the demonstrations, five are shown only once.
_SKEWED_COUNTS = (14, 11, 9, 8, 7, 6, 5, 4, 4, 3, 3, 3, 2, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1)
UNBALANCED = dict(zip(SCATTERED_BEHAVIORS, _SKEWED_COUNTS, strict=True))

AVOIDING_RECIPES = (_recipe("d3il_avoiding", BALANCED), _recipe("d3il_unbalanced_avoiding", UNBALANCED))
