"""The implementation behind both environments of Maze2D: any number of agents, each in its own scene."""

from typing import Any

import numpy as np
from gymnasium import spaces

from lerobot_swr.envs.maze2d.camera import CAMERA_SIZE, MazeCamera
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, in_goal, move
from lerobot_swr.envs.maze2d.layouts import get_layout
from lerobot_swr.envs.maze2d.scenes import draw_scene, draw_start, maze_of, scene_names
from lerobot_swr.envs.observed import check_obs_type, observation_space, observed

STARTS = ("fixed", "pseudo_random", "random")


class MazeAgents:
    """What happens to n agents, given their positions and scenes.

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


def _in_maze(key: str, given: Any, meanings: tuple[str, ...]) -> np.ndarray:
    """(n,) float64 of what ``reset(options=...)`` gives for `key`: numbers of 0 to 1."""
    numbers = np.asarray(given, dtype=np.float64)
    if numbers.shape != (len(meanings),) or not ((numbers >= 0) & (numbers <= 1)).all():
        raise ValueError(f"options[{key!r}]={given!r}: expected {' and '.join(meanings)} in the maze, 0 to 1")
    return numbers
