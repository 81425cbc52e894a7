"""Scripted demonstrators of Maze2D: human-like walks through given doors, and the datasets made of them.

A demonstration is a smooth path through points inside its doors and through free points between the walls,
followed at a smoothly varying speed with a little hand tremor, in the real environment. All constants below
were fixed before any method was trained on the datasets; units are shares of the maze's side.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import pairwise

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from scipy.interpolate import PchipInterpolator

from lerobot_swr.demos.recipe import DatasetRecipe, Demonstration
from lerobot_swr.envs.maze2d.agents import MazeAgents
from lerobot_swr.envs.maze2d.behavior import MazeBehaviorRule
from lerobot_swr.envs.maze2d.camera import CAMERA_SIZE, MazeCamera
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, in_goal
from lerobot_swr.envs.maze2d.env import FPS, INSTRUCTION
from lerobot_swr.envs.maze2d.layouts import MazeLayout, get_layout
from lerobot_swr.envs.maze2d.scenes import draw_scene, draw_start, maze_of, scene_names

DOOR_SPREAD = 0.75  # paths use this share of a door's width
PATH_SPREAD = 0.05  # standard deviation of the free points between the walls
SPEED_WOBBLE = 0.10  # relative standard deviation of the speed along the way
TREMOR = 0.06  # standard deviation of the hand's noise, in units of the largest step
LOOKAHEAD = 1.5  # how far ahead the hand aims, in steps
MEMORY = 0.9  # correlation of wobble and tremor from one step to the next
FRAMES_AT_GOAL = 3  # frames recorded inside the goal disc, as a human who stops the recording would

SpeedRule = Callable[[np.random.Generator, float], float]
"""Draws the mean speed of one demonstration (side lengths per step) given the length of its path."""


def forward_path(
    checkpoints: str,
    layout: MazeLayout,
    rng: np.random.Generator,
    path_spread: float = PATH_SPREAD,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """A smooth path from the start through one door of every wall to the goal.

    Args:
        checkpoints: Behaviour label, one door per wall, e.g. ``"6410"``.
        layout: The maze.
        rng: Source of the variation.
        path_spread: Standard deviation of the free points between the walls.
        start: (2,) where the path begins; None takes the layout's start.

    Returns:
        (P, 2) densely spaced points; y grows strictly, so no wall is crossed outside its door.
    """
    points = [np.array(layout.start) if start is None else start]
    for wall, checkpoint in zip(layout.walls, checkpoints[:-1], strict=True):
        door = next(door for door in wall.doors if str(door.checkpoint) == checkpoint)
        x = door.x + DOOR_SPREAD * door.half_width * rng.uniform(-1, 1)
        points.append(np.array([x, wall.y]))
    goal_jitter = 0.4 * layout.goal_radius * rng.uniform(-1, 1, size=2)
    points.append(np.array(layout.goal) + goal_jitter)

    with_free_points = [points[0]]
    for before, after in pairwise(points):
        share = rng.uniform(0.35, 0.65)
        free = before + share * (after - before)
        free[0] = np.clip(free[0] + path_spread * rng.standard_normal(), 0.03, 0.97)
        with_free_points += [free, after]
    x, y = np.array(with_free_points).T
    dense_y = np.linspace(y[0], y[-1], 2000)
    return np.stack([PchipInterpolator(y, x)(dense_y), dense_y], axis=1)


def walk(
    path: np.ndarray,
    speed: float,
    task: str,
    rng: np.random.Generator,
    speed_wobble: float = SPEED_WOBBLE,
    scene: np.ndarray | None = None,
) -> Demonstration:
    """Follow a path in the environment.

    Args:
        path: (P, 2) densely spaced points.
        speed: Mean speed, in side lengths per step.
        task: Name of the maze.
        rng: Source of the variation.
        speed_wobble: Relative standard deviation of the speed along the way.
        scene: (S,) scene, where the maze has scenes.

    Returns:
        The demonstration; its last `FRAMES_AT_GOAL` frames lie in the goal disc.

    Raises:
        RuntimeError: If the goal is not reached, i.e. the path cannot be followed.
    """
    agents = MazeAgents(task, "fixed", 0.0, 0.0, sticky_walls=False)
    scenes = (np.array(agents.layout.goal) if scene is None else scene)[None]
    maze = maze_of(agents.layout, scenes[0])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    position, progress = path[0][None], 0.0
    wobble, tremor = 0.0, np.zeros(2)
    states, actions, frames_at_goal = [], [], 0
    fresh = np.sqrt(1 - MEMORY**2)
    for _ in range(20 * int(arc[-1] / speed)):
        wobble = MEMORY * wobble + fresh * rng.standard_normal()
        tremor = MEMORY * tremor + fresh * rng.standard_normal(2)
        pace = speed * max(0.3, 1 + speed_wobble * wobble)

        near = (arc >= progress - 3 * speed) & (arc <= progress + 3 * speed)
        progress = arc[near][np.linalg.norm(path[near] - position, axis=1).argmin()]
        aim = min(progress + LOOKAHEAD * pace, arc[-1])
        target = np.array([np.interp(aim, arc, path[:, 0]), np.interp(aim, arc, path[:, 1])])
        direction = target - position[0]
        distance = np.linalg.norm(direction)
        step = direction * min(1.0, pace / max(distance, 1e-9))
        action = np.clip(step / MAX_STEP + TREMOR * tremor, -1, 1).astype(np.float32)

        states.append(agents.observe(position, scenes))
        actions.append(action)
        frames_at_goal += bool(in_goal(position, maze)[0])
        if frames_at_goal == FRAMES_AT_GOAL:
            observations = {
                "observation.state": np.concatenate([state["agent_pos"] for state in states]),
                "observation.environment_state": np.concatenate(
                    [state["environment_state"] for state in states]
                ),
            }
            return Demonstration(observations, np.stack(actions))
        position, _ = agents.step(position, action[None], [], scenes)
    raise RuntimeError(f"the demonstrator did not reach the goal of {task!r}")


def steady(rng: np.random.Generator, path_length: float) -> float:
    """Moderately varied speed, independent of the path."""
    return 0.018 * (1 + 0.08 * rng.standard_normal())


def spread_lengths(rng: np.random.Generator, path_length: float) -> float:
    """A speed that spreads the episodes' lengths evenly over about 62 to 107 steps."""
    return path_length / rng.uniform(62, 107)


def even(rng: np.random.Generator, path_length: float) -> float:
    """Nearly the same speed in every episode."""
    return 0.018 * (1 + 0.01 * rng.standard_normal())


def demonstrate(
    task: str,
    behaviors: Sequence[str],
    speed: SpeedRule,
    seed: int,
    path_spread: float = PATH_SPREAD,
    speed_wobble: float = SPEED_WOBBLE,
) -> Iterator[Demonstration]:
    """One demonstration per entry of `behaviors`, in an order shuffled by the seed, each in its own scene."""
    rng = np.random.default_rng(seed)
    layout = get_layout(task)
    rule = MazeBehaviorRule(layout)
    for behavior in rng.permutation(np.array(behaviors)):
        while True:
            scene, start = draw_scene(layout, rng), draw_start(layout, rng)
            path = forward_path(behavior, maze_of(layout, scene), rng, path_spread, start)
            path_length = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
            demonstration = walk(path, speed(rng, path_length), task, rng, speed_wobble, scene)
            # Hand tremor near a door's edge can, rarely, miss the door: such a recording is thrown away.
            if rule(demonstration.observations) == behavior:
                break
        yield demonstration


def _recipe(
    name: str,
    task: str,
    counts: dict[str, int],
    speed: SpeedRule,
    resized: Callable[[int], DatasetRecipe] | None = None,
    **variation: float,
) -> DatasetRecipe:
    behaviors = [behavior for behavior, count in counts.items() for _ in range(count)]
    return DatasetRecipe(
        name=name,
        instruction=INSTRUCTION,
        fps=FPS,
        robot_type=f"maze2d_{task}",
        features={
            "observation.state": ("x", "y"),
            "observation.environment_state": scene_names(get_layout(task)),
            "action": ("dx", "dy"),
        },
        n_episodes=len(behaviors),
        demonstrations=lambda seed: demonstrate(task, behaviors, speed, seed, **variation),
        behavior_rule=MazeBehaviorRule(get_layout(task)),
        pictures=partial(_seen, MazeCamera(get_layout(task), CAMERA_SIZE)),
        picture_size=(CAMERA_SIZE, CAMERA_SIZE),
        resized=resized,
    )


def _seen(camera: MazeCamera, demonstration: Demonstration) -> np.ndarray:
    return camera.pictures(*(demonstration.observations[key] for key in (OBS_STATE, OBS_ENV_STATE)))


def _scenes_recipe(name: str, task: str, ways: Sequence[str], n_episodes: int) -> DatasetRecipe:
    """Every episode in a scene of its own, the behaviours as equally often as they can be."""
    counts = {way: len(range(i, n_episodes, len(ways))) for i, way in enumerate(ways)}
    return _recipe(name, task, counts, steady, lambda n: _scenes_recipe(name, task, ways, n))


# All 12 forward behaviours of the medium maze, unbalanced.
ONLY_FORWARD = {
    "6410": 16,
    "7420": 14,
    "6310": 12,
    "7520": 11,
    "6420": 10,
    "7410": 8,
    "6320": 7,
    "7510": 6,
    "7310": 5,
    "6520": 4,
    "7320": 4,
    "6510": 3,
}

# Through which doors, wherever these are.
TWO_WAYS = ("10", "20")
SIX_WAYS = ("410", "420", "430", "510", "520", "530")

MAZE_RECIPES = (
    _recipe("medium_maze-one_side", "medium", {"6410": 50, "7420": 50}, steady),
    _recipe("medium_maze-only_forward", "medium", ONLY_FORWARD, steady),
    _recipe(
        "medium_maze-only_fast",
        "medium",
        {"6410": 25, "7420": 25, "6310": 25, "7520": 25},
        spread_lengths,
    ),
    # one_side by another demonstrator: paths spread twice as far between the walls, at an even pace.
    _recipe(
        "medium_maze-spread_out",
        "medium",
        {"6410": 50, "7420": 50},
        even,
        path_spread=2 * PATH_SPREAD,
        speed_wobble=0.02,
    ),
    _scenes_recipe("scenes_maze-two_ways", "scenes", TWO_WAYS, 100),
    _scenes_recipe("scenes_maze-two_ways_500", "scenes", TWO_WAYS, 500),
    _scenes_recipe("scenes_large_maze-six_ways", "scenes_large", SIX_WAYS, 100),
)
