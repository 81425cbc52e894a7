"""Maze2D as a Gymnasium environment, for one agent and for a batch of agents."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from PIL import Image

from lerobot_swr.envs.maze2d.agents import MazeAgents
from lerobot_swr.envs.maze2d.camera import CAMERA_SIZE
from lerobot_swr.envs.maze2d.rendering import draw_episode, draw_maze
from lerobot_swr.envs.maze2d.scenes import maze_of, scene_names

FPS = 20
INSTRUCTION = "Walk through the maze to the goal."


class Maze2DEnv(gym.Env):
    """A point agent in a maze of horizontal walls with numbered doors.

    **Observation** (dict of float32 arrays):

    | key | shape | meaning | range |
    |---|---|---|---|
    | `agent_pos` | (2,) | x, y of the agent, as shares of the maze's side | 0 to 1 |
    | `environment_state` | (2,) | x, y of the goal | 0 to 1 |
    | | (2 + D,) | in `scenes` and `scenes_large`: also the x of each door, lowest wall first | 0 to 1 |

    **Action** (2,) float32 in -1 to 1: displacement in x and y, in units of 0.02 of the side. Larger values
    are clipped. Walls and the border stop the agent; by default it slides along them.

    **Start**: `fixed` (the layout's start), `pseudo_random` (uniform in a square around it, cut at the
    border) or `random` (uniform in the maze); or given by `reset(options={"agent_pos": [x, y]})`.

    **Scenes**: in `scenes` and `scenes_large`, start, goal and doors are drawn from the seed of every episode
    (`lerobot_swr.envs.maze2d.layouts.Scenes`: the ranges); `fixed` is then the start that was drawn. Goal and
    doors are given by `reset(options={"environment_state": [...]})`, as they are observed.

    **Pictures**: with `obs_type` `both` also `pixels`, of one camera above the maze, (camera_size,
    camera_size, 3) uint8; with `pixels` no position is told but by the picture (`lerobot_swr.envs.observed`).

    **Reward**: 1 when the goal is reached, else 0. **Termination**: goal reached. **Truncation**: by the
    registered step limit (200).

    **Behaviour**: the doors' numbers in the order in which they are first passed, ending in 0 at the goal
    (`lerobot_swr.envs.maze2d.behavior`).

    **Info**: `is_success` (bool).

    Versions: v0, first release.

    Args:
        task: Layout: `small` (2 forward behaviours), `medium` (12), `large` (24), or with a scene of its own
            for every episode `scenes` (2) or `scenes_large` (6).
        start: `fixed`, `pseudo_random` or `random`.
        start_radius: Half the side of the pseudo-random start square, as a share of the maze's side.
        transition_noise: Standard deviation of Gaussian noise on every displacement, in units of the largest
            step.
        sticky_walls: An agent that hits a wall or the border does not move in that step.
        obs_type: `state`, `pixels` or `both`.
        camera_size: Side of the observed pictures, in pixels.
        render_size: Side of the rendered picture, in pixels.
        render_mode: `rgb_array` or None.

    Raises:
        ValueError: For an unknown layout, start or kind of observation, or a number out of range.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012

    def __init__(
        self,
        task: str = "medium",
        start: str = "fixed",
        start_radius: float = 0.10,
        transition_noise: float = 0.0,
        sticky_walls: bool = False,
        obs_type: str = "state",
        camera_size: int = CAMERA_SIZE,
        render_size: int = 320,
        render_mode: str | None = None,
    ):
        self.agents = MazeAgents(
            task, start, start_radius, transition_noise, sticky_walls, obs_type, camera_size
        )
        self.task, self.task_description = task, INSTRUCTION
        self.observation_space = self.agents.observation_space()
        self.action_space = self.agents.action_space()
        self.render_mode = render_mode
        self._render_size = render_size
        self._maze_picture: Image.Image | None = None
        self._path: list[np.ndarray] = []
        self._scene = np.zeros(len(scene_names(self.agents.layout)))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode; the class says what the arguments do."""
        super().reset(seed=seed)
        start, self._scene = self.agents.begin(self.np_random, options)
        self._path, self._maze_picture = [start], None
        return self._observe(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply a (2,) action."""
        positions, reached = self.agents.step(
            self._path[-1][None], np.asarray(action)[None], [self.np_random], self._scene[None]
        )
        self._path.append(positions[0])
        success = bool(reached[0])
        return self._observe(), float(success), success, False, {"is_success": success}

    def render(self) -> np.ndarray | None:
        """(render_size, render_size, 3) uint8 picture of the maze and the path so far."""
        if self.render_mode is None:
            return None
        if self._maze_picture is None:
            self._maze_picture = draw_maze(maze_of(self.agents.layout, self._scene), self._render_size)
        return draw_episode(self._maze_picture, np.stack(self._path))

    def _observe(self) -> dict[str, Any]:
        found = self.agents.observe(self._path[-1][None], self._scene[None], self._path[-2:][0][None])
        return _first(found)


class Maze2DVectorEnv(gym.vector.VectorEnv):
    """`Maze2DEnv` for n agents in one array; finished agents keep their last state until the next reset.

    Args:
        num_envs: Number of agents.
        max_episode_steps: Step limit.
        **maze_options: Those of `Maze2DEnv`, without `render_size` and `render_mode`.
    """

    metadata = {"render_fps": FPS, "autoreset_mode": AutoresetMode.DISABLED}  # noqa: RUF012

    def __init__(self, num_envs: int, max_episode_steps: int = 200, **maze_options: Any):
        self.task = maze_options.get("task", "medium")
        self.task_description = INSTRUCTION
        template = Maze2DEnv(**maze_options)
        self.agents = template.agents
        self.num_envs, self._max_episode_steps = num_envs, max_episode_steps
        self.single_observation_space = template.observation_space
        self.single_action_space = template.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs = [np.random.default_rng() for _ in range(num_envs)]
        self._positions: np.ndarray = np.zeros((num_envs, 2))
        self._before: np.ndarray = np.zeros((num_envs, 2))
        self._scenes: np.ndarray = np.zeros((num_envs, len(scene_names(self.agents.layout))))
        self._terminated = np.zeros(num_envs, dtype=bool)
        self._steps = np.zeros(num_envs, dtype=int)

    def reset(  # type: ignore[override]
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode for every agent, or those of ``options["reset_mask"]`` (n,).

        Seeds and options are as in Gymnasium's vector environments.
        """
        chosen = (options or {}).get("reset_mask", np.ones(self.num_envs, dtype=bool))
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
            fresh = [gym.utils.seeding.np_random(s)[0] for s in seeds]
            self._rngs = [
                new if use else old for use, new, old in zip(chosen, fresh, self._rngs, strict=True)
            ]
        for i in np.flatnonzero(chosen):
            self._positions[i], self._scenes[i] = self.agents.begin(self._rngs[i], options)
        self._before = np.where(chosen[:, None], self._positions, self._before)
        self._terminated[chosen] = False
        self._steps[chosen] = 0
        observations = self.agents.observe(self._positions, self._scenes, self._before)
        return observations, {"is_success": self._terminated.copy()}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Apply (n, 2) actions to the agents that are still under way."""
        moved, reached = self.agents.step(self._positions, actions, self._rngs, self._scenes)
        under_way = ~self._terminated
        self._before = np.where(under_way[:, None], self._positions, self._before)
        self._positions = np.where(under_way[:, None], moved, self._positions)
        reward = (reached & under_way).astype(np.float64)
        self._terminated = self._terminated | (reached & under_way)
        self._steps += 1
        truncated = (self._steps >= self._max_episode_steps) & ~self._terminated
        info = {"is_success": self._terminated.copy()}
        return (
            self.agents.observe(self._positions, self._scenes, self._before),
            reward,
            self._terminated.copy(),
            truncated,
            info,
        )

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """The attribute or method result `name`, once per agent."""
        value = getattr(self, name)
        return (value(*args, **kwargs) if callable(value) else value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """The attribute `name`, once per agent."""
        return self.call(name)


def _first(batch: dict[str, Any]) -> dict[str, Any]:
    """The first of a batch of observations."""
    return {key: _first(value) if isinstance(value, dict) else value[0] for key, value in batch.items()}
