"""Maze2D as a LeRobot environment: ``--env.type=maze2d --env.task=small|medium|large|scenes``, and more."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.envs.configuration_env import TaskEnvConfig
from lerobot_swr.envs.maze2d.agents import MazeAgents
from lerobot_swr.envs.maze2d.behavior import MazeBehaviorRule
from lerobot_swr.envs.maze2d.camera import CAMERA_SIZE
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, in_goal
from lerobot_swr.envs.maze2d.env import FPS, Maze2DVectorEnv
from lerobot_swr.envs.maze2d.layouts import MazeLayout, Scenes, get_layout
from lerobot_swr.envs.maze2d.scenes import scene_names
from lerobot_swr.envs.observed import PICTURE_NAMES, picture_features
from lerobot_swr.envs.pointer import PlanePointer, Pointer
from lerobot_swr.envs.task import StartRule

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # half a second, for pictures alone

GYM_ID = "lerobot_swr/Maze2D-v0"

if GYM_ID not in gym.registry:
    gym.register(
        id=GYM_ID,
        entry_point="lerobot_swr.envs.maze2d.env:Maze2DEnv",
        max_episode_steps=200,
    )


@EnvConfig.register_subclass("maze2d")
@dataclass
class Maze2DEnvConfig(TaskEnvConfig):
    """Configuration of `lerobot_swr.envs.maze2d.env.Maze2DEnv`, which documents the task."""

    task: str | None = "medium"
    fps: int = FPS
    # Step limit of an episode.
    episode_length: int = 200

    # Start: "fixed", "pseudo_random" (uniform square around the fixed start) or "random" (anywhere).
    start: str = "fixed"
    # Half the side of the pseudo-random start square, as a share of the maze's side.
    start_radius: float = 0.10

    # Standard deviation of the noise on every displacement, in units of the largest step (0.02 of the side).
    transition_noise: float = 0.0
    # Whether an agent that hits a wall stays where it was instead of sliding along.
    sticky_walls: bool = False

    # What is observed: "state" (numbers), "both" (numbers and a camera) or "pixels" (the camera, and as
    # observation.state how far the agent has moved in the last step: its place is only seen).
    obs_type: str = "state"
    # Side of the camera's pictures, in pixels.
    camera_size: int = CAMERA_SIZE

    # Side of the rendered picture, in pixels.
    render_size: int = 320
    render_mode: str = "rgb_array"

    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(2,)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(2,)),
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            ACTION: ACTION,
            "agent_pos": OBS_STATE,
            "environment_state": OBS_ENV_STATE,
            **PICTURE_NAMES,
        }
    )

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check every value now, before any environment or worker process is started.

        Raises:
            ValueError: Naming the offending key and value.
        """
        layout = MazeAgents(**self._maze_options).layout
        if self.obs_type == "pixels":
            self.features.pop("environment_state", None)
        else:
            scene = PolicyFeature(FeatureType.ENV, (len(scene_names(layout)),))
            self.features["environment_state"] = scene
        self.features |= picture_features(self.obs_type, self.camera_size, self.camera_size)
        if self.episode_length < 1:
            raise ValueError(f"episode_length={self.episode_length}: expected at least 1 step")

    @property
    def _maze_options(self) -> dict:
        return {
            "task": self.task,
            "start": self.start,
            "start_radius": self.start_radius,
            "transition_noise": self.transition_noise,
            "sticky_walls": self.sticky_walls,
            "obs_type": self.obs_type,
            "camera_size": self.camera_size,
        }

    @property
    def gym_id(self) -> str:
        """Gymnasium id of the environment."""
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict:
        """Arguments for `gymnasium.make`."""
        return {
            **self._maze_options,
            "render_size": self.render_size,
            "render_mode": self.render_mode,
            "max_episode_steps": self.episode_length,
        }

    def behavior_rule(self) -> MazeBehaviorRule:
        """The checkpoints in the order in which they are first passed."""
        return MazeBehaviorRule(get_layout(self.task or ""))

    @property
    def draws_scenes(self) -> bool:
        """In the tasks `scenes` and `scenes_large`: start, goal and doors."""
        return get_layout(self.task or "").scenes is not None

    def start_rule(self) -> StartRule:
        """The agent's first recorded position and the scene, which are all of the maze's state."""
        if not self.draws_scenes:
            return lambda observations: {"agent_pos": observations[OBS_STATE][0]}
        return lambda observations: {
            "agent_pos": observations[OBS_STATE][0],
            "environment_state": observations[OBS_ENV_STATE][0],
        }

    def steps_to_end(self, observations: Mapping[str, np.ndarray]) -> int:
        """Actions until the first state in the goal disc."""
        reached = in_goal(observations[OBS_STATE], self.behavior_rule().maze(observations))
        return int(reached.argmax()) if reached.any() else len(reached)

    def expected_behavior(self, requested: str, observations: Mapping[str, np.ndarray]) -> str:
        """The requested checkpoints that lie ahead: a start beyond a wall leaves that wall's door out.

        Labels of other rules, which are no checkpoints, are left as they are.
        """
        layout = get_layout(self.task or "")
        if not set(requested) <= {str(d.checkpoint) for wall in layout.walls for d in wall.doors} | {"0"}:
            return requested
        y = observations[OBS_STATE][0, 1]
        ahead = {str(d.checkpoint) for wall in layout.walls if wall.y >= y for d in wall.doors} | {"0"}
        return "".join(checkpoint for checkpoint in requested if checkpoint in ahead)

    def perturbations(self) -> dict[str, dict[str, Any]]:
        """Shifted and random starts, noise on every displacement, walls that hold the agent."""
        return {
            "start ±0.10": {"start": "pseudo_random", "start_radius": 0.10},
            "start ±0.20": {"start": "pseudo_random", "start_radius": 0.20},
            "start anywhere": {"start": "random"},
            "noise 0.5": {"transition_noise": 0.5},
            "noise 1": {"transition_noise": 1.0},
            "noise 2": {"transition_noise": 2.0},
            "sticky walls": {"sticky_walls": True},
            "sticky, noise 1": {"sticky_walls": True, "transition_noise": 1.0},
        }

    def live(self) -> EnvConfig:
        """Larger pictures."""
        return replace(self, render_size=max(self.render_size, 480))

    def pointer(self, env: gym.Env) -> Pointer:
        """The agent follows the pointer, as fast as it can."""
        return PlanePointer((0, 1), (0, 1), "displacement", speed=MAX_STEP, scale=MAX_STEP)

    def draw_scene(self, axes: "Axes") -> None:
        """Walls, door numbers and the goal; where scenes differ, all that they have in common."""
        from matplotlib.patches import Circle

        layout = get_layout(self.task or "")
        axes.set(xlim=(0, 1), ylim=(0, 1))
        if layout.scenes is not None:
            _draw_ranges(axes, layout, layout.scenes)
            return
        for wall in layout.walls:
            edges = [0.0]
            for door in sorted(wall.doors, key=lambda door: door.x):
                edges += [door.x - door.half_width, door.x + door.half_width]
                axes.text(
                    door.x, wall.y, str(door.checkpoint), color="0.4", ha="center", va="center", zorder=5
                )
            edges.append(1.0)
            for left, right in zip(edges[::2], edges[1::2], strict=True):
                axes.plot([left, right], [wall.y, wall.y], color="0.15", linewidth=3, solid_capstyle="butt")
        goal = Circle(layout.goal, layout.goal_radius, fill=False, color="tab:green", linewidth=2)
        axes.add_patch(goal)

    def create_rollout_env(self, n_envs: int) -> gym.vector.VectorEnv:
        """All agents in one array."""
        return Maze2DVectorEnv(n_envs, max_episode_steps=self.episode_length, **self._maze_options)


def _draw_ranges(axes: "Axes", layout: MazeLayout, scenes: Scenes) -> None:
    """Walls, dotted where doors may be, and the areas of start and goal."""
    from matplotlib.patches import Rectangle

    for wall in layout.walls:
        axes.axhline(wall.y, color="0.15", linewidth=3)
        for door in wall.doors:
            reach = scenes.door_shift + door.half_width
            axes.plot([door.x - reach, door.x + reach], [wall.y, wall.y], color="white", linewidth=3)
            axes.plot([door.x - reach, door.x + reach], [wall.y, wall.y], ":", color="0.15", linewidth=1)
            axes.text(door.x, wall.y, str(door.checkpoint), color="0.4", ha="center", va="center")
    for ((left, right), (bottom, top)), colour in ((scenes.start, "tab:blue"), (scenes.goal, "tab:green")):
        axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, color=colour, alpha=0.15))
