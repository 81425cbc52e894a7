"""Scripted demonstrators of the D3IL aligning task, and their datasets.

Contexts (poses of box and target) are drawn uniformly; in each, a hand with drawn habits tries to bring the
box home in the intended way. An attempt that fails is thrown away and other habits are tried; in the rare
context that defeats `MAX_ATTEMPTS` habits, another context is drawn.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lerobot_swr.demos.arm_pictures import PICTURE_SIZE, aligning_pictures
from lerobot_swr.demos.box_handler import BoxHandler, Habits
from lerobot_swr.demos.box_steering import INSIDE_CORNER, OUTSIDE_FACE, Gains
from lerobot_swr.demos.parallel_generation import generate
from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.envs.d3il.behavior import INSIDE, OUTSIDE, aligning_behavior
from lerobot_swr.envs.d3il.layouts import (
    ALIGNING_DESCRIPTION,
    ALIGNING_EPISODE_LENGTH,
    ALIGNING_SCENE_NAMES,
    FPS,
)

MAX_ATTEMPTS = 8


def draw_habits(inside: bool, attempt: int, rng: np.random.Generator) -> Habits:
    """Habits of one attempt; later attempts are also ready to take a less obvious face or corner."""
    spread = 1.0 if attempt == 0 else 2.0
    turn, smallest = (1.2, 0.05) if inside else (2.0, 0.0)
    return Habits(
        grip=INSIDE_CORNER if inside else OUTSIDE_FACE,
        choice=int(rng.random() < 0.2) if attempt else 0,
        gains=Gains(
            turn=turn * np.exp(0.08 * spread * rng.standard_normal()),
            approach=3.0 * np.exp(0.08 * spread * rng.standard_normal()),
            smallest_distance=smallest,
        ),
        pace=rng.uniform(0.85, 1.05),
        flying_z=rng.uniform(0.232, 0.245),
        # Deep inside, a tilted rod stays clearly closer to the box's centre than the 51 mm that count as
        # inside.
        working_z=rng.uniform(0.127, 0.135) if inside else rng.uniform(0.14, 0.158),
        pause=int(rng.choice(np.array([0, 0, 0, rng.integers(3, 12)]))),
        tremor=rng.uniform(0.0001, 0.0003),
    )


@lru_cache(maxsize=1)
def _environment():
    from lerobot_swr.envs.d3il.aligning import AligningEnv  # needs MuJoCo, which listing the recipes must not

    return AligningEnv()


def attempt_demonstration(context_seed: int, habits: Habits, rng: np.random.Generator) -> Demonstration:
    """One attempt in the context that the environment draws from `context_seed`.

    The last frame is the state that ended the episode, with the action that would have come next.
    """
    env = _environment()
    hand = BoxHandler(habits, rng)
    observation, _ = env.reset(seed=context_seed)
    observations, actions, terminated = [], [], False
    while True:
        state, scene = observation["agent_pos"], observation["environment_state"]
        action = hand.act(state, scene).astype(np.float32)
        observations.append(observation)
        actions.append(action)
        if terminated or hand.gave_up or len(actions) > ALIGNING_EPISODE_LENGTH:
            break
        observation, _, terminated, _, _ = env.step(action)
    return Demonstration(
        {
            "observation.state": np.stack([o["agent_pos"] for o in observations]),
            "observation.environment_state": np.stack([o["environment_state"] for o in observations]),
        },
        np.stack(actions),
    )


@dataclass(frozen=True)
class AligningJob:
    """Makes episode i of a dataset: one that shows `behaviors[i]`."""

    behaviors: tuple[str, ...]
    seed: int

    def __call__(self, i: int) -> Demonstration:
        """Try habits, and if need be contexts, until one attempt shows the intended behaviour."""
        rng = np.random.default_rng([self.seed, i])
        while True:
            context_seed = int(rng.integers(2**31))
            for attempt in range(MAX_ATTEMPTS):
                habits = draw_habits(self.behaviors[i] == INSIDE, attempt, rng)
                demonstration = attempt_demonstration(context_seed, habits, rng)
                if aligning_behavior(demonstration.observations) == self.behaviors[i]:
                    return demonstration


def _recipe(name: str, counts: dict[str, int]) -> DatasetRecipe:
    behaviors = [behavior for behavior, count in counts.items() for _ in range(count)]

    def job(seed: int) -> AligningJob:
        return AligningJob(tuple(map(str, np.random.default_rng(seed).permutation(behaviors))), seed)

    return DatasetRecipe(
        name=name,
        instruction=ALIGNING_DESCRIPTION,
        fps=FPS,
        robot_type="d3il_aligning",
        features={
            "observation.state": ("desired_x", "desired_y", "desired_z", "x", "y", "z"),
            "observation.environment_state": ALIGNING_SCENE_NAMES,
            "action": ("dx", "dy", "dz"),
        },
        n_episodes=len(behaviors),
        demonstrations=lambda seed: map(job(seed), range(len(behaviors))),
        behavior_rule=aligning_behavior,
        pictures=aligning_pictures,
        picture_size=PICTURE_SIZE,
        resumable_demonstrations=lambda seed, work_dir: generate(job(seed), len(behaviors), work_dir),
    )


BALANCED = {INSIDE: 500, OUTSIDE: 500}
UNBALANCED = {INSIDE: 150, OUTSIDE: 850}
"""Pushing from outside is what most people try first."""

ALIGNING_RECIPES = (_recipe("d3il_aligning", BALANCED), _recipe("d3il_unbalanced_aligning", UNBALANCED))
