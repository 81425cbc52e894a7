"""The D3IL tasks as a LeRobot environment: ``--env.type=d3il --env.task=avoiding|aligning``.

Importing this module needs neither MuJoCo nor numba; making an environment does.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.envs.utils import freeze_after_episode_end
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.envs.configuration_env import TaskEnvConfig
from lerobot_swr.envs.d3il.behavior import aligning_behavior, avoiding_behavior, is_aligned
from lerobot_swr.envs.d3il.layouts import (
    ALIGNING_EPISODE_LENGTH,
    AVOIDING_EPISODE_LENGTH,
    BOX_POSITION_RANGE,
    CAMERA_SIZE,
    CONTROL_PERIOD_S,
    FINISH_LINE_Y,
    FPS,
    OBSTACLES,
    TARGET_POSITION_RANGE,
)
from lerobot_swr.envs.d3il.perturbations import ArmPerturbations
from lerobot_swr.envs.d3il.recorded_starts import aligning_start, avoiding_start
from lerobot_swr.envs.observed import PICTURE_NAMES, check_obs_type, picture_features, shows_pictures
from lerobot_swr.envs.pointer import Pointer
from lerobot_swr.envs.task import StartRule
from lerobot_swr.envs.thread_vector_env import ThreadVectorEnv

if TYPE_CHECKING:
    from matplotlib.axes import Axes  # half a second, for pictures alone

GYM_IDS = {"avoiding": "lerobot_swr/D3IL-Avoiding-v0", "aligning": "lerobot_swr/D3IL-Aligning-v0"}
EPISODE_LENGTHS = {"avoiding": AVOIDING_EPISODE_LENGTH, "aligning": ALIGNING_EPISODE_LENGTH}
_SIZES = {"avoiding": (2, 4, 19), "aligning": (3, 6, 14)}  # action, state, environment state
_ENTRY_POINTS = {"avoiding": "avoiding:AvoidingEnv", "aligning": "aligning:AligningEnv"}

for _task, _gym_id in GYM_IDS.items():
    if _gym_id not in gym.registry:
        gym.register(
            id=_gym_id,
            entry_point=f"lerobot_swr.envs.d3il.{_ENTRY_POINTS[_task]}",
            max_episode_steps=EPISODE_LENGTHS[_task],
        )


@EnvConfig.register_subclass("d3il")
@dataclass
class D3ILEnvConfig(TaskEnvConfig):
    """Configuration of the D3IL tasks; `AvoidingEnv` and `AligningEnv` document them.

    The control rate is 1 / 0.035 s = 28.57 Hz; LeRobot stores whole Hz, so `fps` is 29. It only sets the
    timestamps of datasets and the speed of videos.
    """

    # "avoiding" or "aligning".
    task: str | None = "avoiding"
    fps: int = FPS
    # Step limit of an episode; default: the benchmark's, 250 for avoiding and 400 for aligning.
    episode_length: int | None = None

    # Half the side of the square in which the tool's start is drawn, around its usual place, in metres.
    start_radius: float = 0.0
    # Standard deviation of the noise on each coordinate of every action, in metres; demonstrations move 5 to
    # 9 mm per step (avoiding), up to 9 mm (aligning).
    action_noise: float = 0.0
    # Once per episode the box is pushed so that, standing free, it slides this far, in metres (aligning).
    box_push: float = 0.0

    # What is observed: "state" (numbers), "both" (numbers and a camera) or "pixels" (the camera, and as
    # observation.state how far the set-point and the tool have moved in the last step).
    obs_type: str = "state"
    # Side of the camera's pictures, in pixels.
    camera_size: int = CAMERA_SIZE

    # Size of the rendered picture, in pixels.
    render_height: int = 480
    render_width: int = 640
    # Shadows; with a software renderer they take nine tenths of a picture's time.
    render_shadows: bool = True
    render_mode: str = "rgb_array"

    features: dict[str, PolicyFeature] = field(default_factory=dict)
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
        """Check the values and fill in what depends on the task.

        Raises:
            ValueError: Naming the offending key and value.
        """
        if self.task not in GYM_IDS:
            raise ValueError(f"task={self.task!r}: the d3il environment knows {', '.join(GYM_IDS)}")
        if self.box_push and self.task != "aligning":
            raise ValueError(f"box_push={self.box_push}: the {self.task} task has no box")
        ArmPerturbations(self.start_radius, self.action_noise, self.box_push)
        check_obs_type(self.obs_type)
        if self.camera_size < 16:
            raise ValueError(f"camera_size={self.camera_size}: expected at least 16 pixels")
        if self.episode_length is None:
            self.episode_length = EPISODE_LENGTHS[self.task]
        if self.episode_length < 1:
            raise ValueError(f"episode_length={self.episode_length}: expected at least 1 step")
        action, state, environment_state = _SIZES[self.task]
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(action,)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=(state,)),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=(environment_state,)),
            **picture_features(self.obs_type, self.camera_size, self.camera_size),
        }
        if self.obs_type == "pixels":
            del self.features["environment_state"]

    @property
    def gym_id(self) -> str:
        """Gymnasium id, with the module that registers it, since worker processes import nothing else."""
        return f"{self.package_name}:{GYM_IDS[self.task or '']}"

    @property
    def gym_kwargs(self) -> dict:
        """Arguments for `gymnasium.make`."""
        push = {"box_push": self.box_push} if self.task == "aligning" else {}
        return {
            "render_mode": self.render_mode,
            "render_height": self.render_height,
            "render_width": self.render_width,
            "render_shadows": self.render_shadows,
            "start_radius": self.start_radius,
            "action_noise": self.action_noise,
            "obs_type": self.obs_type,
            "camera_size": self.camera_size,
            **push,
            "max_episode_steps": self.episode_length,
        }

    def behavior_rule(self) -> BehaviorRule:
        """Avoiding: the gaps taken, like ``top-mid-bottom``. Aligning: ``inside`` or ``outside``."""
        return avoiding_behavior if self.task == "avoiding" else aligning_behavior

    def steps_to_end(self, observations: Mapping[str, np.ndarray]) -> int:
        """Actions until the first state beyond the finish line, or with the box on its target."""
        if self.task == "avoiding":
            reached = observations[OBS_STATE][:, 3] > FINISH_LINE_Y
        else:
            reached = is_aligned(observations[OBS_ENV_STATE])
        return int(reached.argmax()) if reached.any() else len(reached)

    @property
    def draws_scenes(self) -> bool:
        """In aligning, where box and target stand."""
        return self.task == "aligning"

    def start_rule(self) -> StartRule:
        """The tool's place and, for aligning, those of box and target."""
        return avoiding_start if self.task == "avoiding" else aligning_start

    def perturbations(self) -> dict[str, dict[str, Any]]:
        """Shifted starts, noisy actions and, for aligning, a pushed box."""
        found: dict[str, dict[str, Any]] = {
            "start ±2 cm": {"start_radius": 0.02},
            "start ±4 cm": {"start_radius": 0.04},
            "action noise 2 mm": {"action_noise": 0.002},
            "action noise 4 mm": {"action_noise": 0.004},
        }
        if self.task == "aligning":
            found |= {"box pushed 2 cm": {"box_push": 0.02}, "box pushed 5 cm": {"box_push": 0.05}}
        return found

    @property
    def rate_hz(self) -> float:
        """That of the arm's controller."""
        return 1 / CONTROL_PERIOD_S

    def live(self) -> EnvConfig:
        """Smaller pictures without shadows."""
        height, width = min(self.render_height, 360), min(self.render_width, 480)
        return replace(self, render_height=height, render_width=width, render_shadows=False)

    def pointer(self, env: gym.Env) -> Pointer:
        """The tool follows the pointer on the table as the camera shows it."""
        return env.unwrapped.pointer()  # type: ignore[attr-defined]

    def plot_path(self, observations: Mapping[str, np.ndarray]) -> np.ndarray:
        """(T, 2) path in the table's plane as pictures show it, y to the right: the tool's or the box's."""
        if self.task == "avoiding":
            return observations[OBS_STATE][:, [3, 2]]
        return observations[OBS_ENV_STATE][:, [1, 0]]

    def draw_scene(self, axes: "Axes") -> None:
        """Obstacles and finish line, or the areas where box and target start; the robot is at the top."""
        from matplotlib.patches import Circle, Rectangle

        if self.task == "avoiding":
            for obstacle in OBSTACLES:
                axes.add_patch(Circle((obstacle.y, obstacle.x), obstacle.radius, color="tab:red"))
            axes.axvline(FINISH_LINE_Y, color="tab:green", linewidth=2)
            axes.set(xlim=(-0.3, 0.4), ylim=(0.8, 0.2))
        else:
            for (x_range, y_range), colour in (
                (BOX_POSITION_RANGE, "tab:blue"),
                (TARGET_POSITION_RANGE, "tab:green"),
            ):
                corner, size = (y_range[0], x_range[0]), (y_range[1] - y_range[0], x_range[1] - x_range[0])
                axes.add_patch(Rectangle(corner, *size, color=colour, alpha=0.15))
            axes.set(xlim=(-0.4, 0.5), ylim=(0.75, 0.25))
        axes.set(xlabel="y (m)", ylabel="x (m)")

    def create_rollout_env(self, n_envs: int) -> gym.vector.VectorEnv:
        """All environments in this process, stepped by one thread per core; with a camera by this one."""
        make_one = partial(
            gym.make, self.gym_id, disable_env_checker=self.disable_env_checker, **self.gym_kwargs
        )
        env_fns = [freeze_after_episode_end(make_one) for _ in range(n_envs)]
        if shows_pictures(self.obs_type):
            return SyncVectorEnv(env_fns, autoreset_mode=AutoresetMode.SAME_STEP)
        return ThreadVectorEnv(env_fns)
