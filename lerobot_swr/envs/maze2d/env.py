"""Maze2D as a Gymnasium environment, for one agent and for a batch of agents."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from PIL import Image

from lerobot_swr.envs.maze2d.camera import MazeCamera
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, in_goal, move
from lerobot_swr.envs.maze2d.layouts import get_layout
from lerobot_swr.envs.maze2d.rendering import draw_episode, draw_maze
from lerobot_swr.envs.maze2d.scenes import draw_scene, draw_start, maze_of, scene_names
from lerobot_swr.envs.observed import check_obs_type, observation_space, observed

STARTS = ("fixed", "pseudo_random", "random")
FPS = 20
CAMERA_SIZE = 64
INSTRUCTION = "Walk through the maze to the goal."


class MazeAgents:
    """Positions of n agents in one maze; the single implementation behind both environments.

    Args are those of `Maze2DEnv`.
    """

    def __init__(
        self,
        task: str,
        start: str,
        start_radius: float,
        transition_noise: float,
        sticky_walls: bool,
        obs_type: str = "state",
        camera_size: int = CAMERA_SIZE,
    ):
        check_obs_type(obs_type)
        if start not in STARTS:
            raise ValueError(f"start={start!r}: expected one of {', '.join(STARTS)}")
        if not 0 <= start_radius <= 1:
            raise ValueError(f"start_radius={start_radius}: expected a share of the maze's side, 0 to 1")
        if not transition_noise >= 0:
            raise ValueError(f"transition_noise={transition_noise}: expected a standard deviation >= 0")
        self.layout = get_layout(task)
        self.start, self.start_radius = start, start_radius
        self.transition_noise, self.sticky_walls = transition_noise, sticky_walls
        self.obs_type, self.camera = obs_type, MazeCamera(self.layout, camera_size)

    def begin(
        self, rng: np.random.Generator, options: dict[str, Any] | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """(2,) start and (S,) scene of one episode: those of ``options``, or else drawn ones.

        Raises:
            ValueError: If what is given is not one of the maze.
        """
        given = options or {}
        scene, position = given.get("environment_state"), given.get("agent_pos")
        if scene is None:
            scene = draw_scene(self.layout, rng)
        else:
            scene = _in_maze("environment_state", scene, scene_names(self.layout))
            if self.layout.scenes is None and not np.allclose(scene, self.layout.goal, atol=1e-6):
                raise ValueError(f"options['environment_state']={scene}: this maze's goal does not move")
        if position is None:
            return self.draw_start(rng), scene
        return _in_maze("agent_pos", position, ("x", "y")), scene

    def draw_start(self, rng: np.random.Generator) -> np.ndarray:
        """(2,) start position of one episode."""
        if self.start == "random":
            return rng.uniform(0.0, 1.0, size=2)
        start = draw_start(self.layout, rng)
        if self.start == "fixed":
            return start
        return rng.uniform(
            np.maximum(start - self.start_radius, 0.0), np.minimum(start + self.start_radius, 1.0)
        )

    def step(
        self,
        positions: np.ndarray,
        actions: np.ndarray,
        rngs: list[np.random.Generator],
        scenes: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Apply (n, 2) actions to (n, 2) positions in (n, S) scenes; new positions, (n,) goal reached."""
        displacements = np.clip(np.asarray(actions, dtype=np.float64), -1.0, 1.0) * MAX_STEP
        if self.transition_noise > 0:
            noise = np.stack([rng.standard_normal(2) for rng in rngs])
            displacements = displacements + noise * (self.transition_noise * MAX_STEP)
        mazes = maze_of(self.layout, scenes)
        positions = move(positions, displacements, mazes, self.sticky_walls)
        return positions, in_goal(positions, mazes)

    def observe(
        self, positions: np.ndarray, scenes: np.ndarray, before: np.ndarray | None = None
    ) -> dict[str, Any]:
        """Observations of (n, 2) positions in (n, S) scenes, numbers as float32.

        Args:
            positions: Where the agents are.
            scenes: Their scenes.
            before: (n, 2) where they were one step ago; None at the start.
        """
        numbers = {
            "agent_pos": positions.astype(np.float32),
            "environment_state": scenes.astype(np.float32),
        }
        if self.obs_type == "state":
            return numbers
        last = numbers["agent_pos"] if before is None else before.astype(np.float32)
        return observed(self.obs_type, numbers, last, self.camera.pictures(positions, scenes))

    def observation_space(self) -> spaces.Dict:
        """Space of one agent's observation."""
        sizes = {"agent_pos": 2, "environment_state": len(scene_names(self.layout))}
        numbers = {key: spaces.Box(0.0, 1.0, (size,), np.float32) for key, size in sizes.items()}
        return observation_space(self.obs_type, numbers, (self.camera.size, self.camera.size))

    @staticmethod
    def action_space() -> spaces.Box:
        """Space of one agent's action."""
        return spaces.Box(-1.0, 1.0, (2,), np.float32)


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

    Observations hold their own arrays: what a step returned is not changed by the next one.
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


def _in_maze(key: str, given: Any, meanings: tuple[str, ...]) -> np.ndarray:
    """(n,) float64 of what ``reset(options=...)`` gives for `key`: numbers of 0 to 1."""
    numbers = np.asarray(given, dtype=np.float64)
    if numbers.shape != (len(meanings),) or not ((numbers >= 0) & (numbers <= 1)).all():
        raise ValueError(f"options[{key!r}]={given!r}: expected {' and '.join(meanings)} in the maze, 0 to 1")
    return numbers
