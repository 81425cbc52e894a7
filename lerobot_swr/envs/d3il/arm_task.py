"""What the two D3IL tasks share as Gymnasium environments: the set-point, the clock and the pictures."""

import abc
import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, SupportsFloat

import gymnasium as gym
import numpy as np

from lerobot_swr.envs.d3il.dependencies import mujoco
from lerobot_swr.envs.d3il.layouts import ACTION_LIMIT_M, FPS
from lerobot_swr.envs.d3il.perturbations import ArmPerturbations
from lerobot_swr.envs.d3il.pointer import CameraPointer
from lerobot_swr.envs.d3il.rendering import OffscreenCamera, shared_camera
from lerobot_swr.envs.d3il.scene import CAMERA
from lerobot_swr.envs.d3il.simulation import SETTLING_STEPS, ArmSimulation
from lerobot_swr.envs.observed import check_obs_type, observation_space, observed, shows_pictures

Observation = dict[str, Any]

_OBSERVATION_BOUND = (
    100.0  # metres; far outside of anything that can be reached, but finite as Gymnasium wants it
)


class ArmTask(gym.Env[Observation, np.ndarray], abc.ABC):
    """An arm whose desired tool position is moved by the actions, 35 ms of physics at a time.

    Args:
        model: The compiled scene.
        start_tool: (3,) tool position in the start pose, which is also the first desired position.
        n_axes: How many coordinates of the desired position the actions change (2: xy, 3: xyz).
        environment_state_size: Length of the observation's ``environment_state``.
        perturbations: How episodes differ from the benchmark's.
        render_mode: ``"rgb_array"`` or None.
        render_height: Of the pictures, in pixels.
        render_width: Of the pictures, in pixels.
        obs_type: What is observed, see `lerobot_swr.envs.observed`.
        camera_size: Side of the observed pictures, in pixels.
        render_shadows: Whether the pictures show shadows.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012  as Gymnasium declares it
    task: ClassVar[str]
    task_description: ClassVar[str]

    def __init__(
        self,
        model: "mujoco.MjModel",
        start_tool: tuple[float, float, float],
        n_axes: int,
        environment_state_size: int,
        perturbations: ArmPerturbations,
        render_mode: str | None,
        render_height: int,
        render_width: int,
        obs_type: str,
        camera_size: int,
        render_shadows: bool,
    ):
        check_obs_type(obs_type)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode={render_mode!r}: the D3IL tasks know None and 'rgb_array'")
        self.render_mode = render_mode
        self._picture_size = (render_height, render_width)
        self._shadows = render_shadows
        self._camera: OffscreenCamera | None = None
        self._simulation = ArmSimulation(model)
        self._perturbations = perturbations
        self._start_tool = np.array(start_tool)
        self._desired = self._start_tool.copy()
        self._n_axes = n_axes
        self.action_space = gym.spaces.Box(-ACTION_LIMIT_M, ACTION_LIMIT_M, (n_axes,), np.float32)
        numbers = {
            key: gym.spaces.Box(-_OBSERVATION_BOUND, _OBSERVATION_BOUND, (size,), np.float32)
            for key, size in (("agent_pos", 2 * n_axes), ("environment_state", environment_state_size))
        }
        self._obs_type, self._camera_size = obs_type, camera_size
        self._before: np.ndarray | None = None
        self.observation_space = observation_space(  # type: ignore[assignment]
            obs_type, numbers, (camera_size, camera_size)
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Put the arm into its start pose and begin an episode; the class says what the arguments do.

        ``options["agent_pos"]``, desired and actual tool position as they are observed, is where a recording
        begins: the arm moves there from its start pose, see `ArmSimulation.approach`.
        """
        super().reset(seed=seed)
        options = options or {}
        self._desired, self._before = self._start_tool.copy(), None
        self._begin_episode(options)
        if options.get("agent_pos") is not None:
            axes = ("x", "y", "z")[: self._n_axes]
            given = given_numbers(options, "agent_pos", [f"desired_{axis}" for axis in axes] + [*axes])
            desired, actual = given.reshape(2, -1)
            self._desired[: self._n_axes] = desired
            self._simulation.approach(self._desired, actual)
            return self._observation(), self._info()
        shift = self._perturbations.draw_shift(self.np_random)
        if shift.any():
            self._desired += shift
            for _ in range(SETTLING_STEPS):
                self._simulation.advance(self._desired)
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Move the desired tool position by `action` (n_axes,) in metres, clipped, and let 35 ms pass."""
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (self._n_axes,) or not np.isfinite(action).all():
            raise ValueError(
                f"action={action!r}: the {self.task} task takes {self._n_axes} finite numbers, the change of "
                "the desired tool position in metres"
            )
        action = self._perturbations.disturb(action, self.np_random)
        self._desired[: self._n_axes] += np.clip(action, -ACTION_LIMIT_M, ACTION_LIMIT_M)
        self._simulation.advance(self._desired)
        self._judge()
        info = self._info()
        return self._observation(), self._reward(), self._is_over(), False, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """(height, width, 3) uint8 picture, or None without a render mode."""
        if self.render_mode is None:
            return None
        if self._camera is None:
            self._camera = OffscreenCamera(
                self._simulation.model, *self._picture_size, fast=not self._shadows
            )
        return self._camera.picture(self._simulation.data)

    def pointer(self) -> CameraPointer:
        """How a pointer in the pictures moves the tool."""
        model, data = self._simulation.model, mujoco.MjData(self._simulation.model)
        camera = model.camera(CAMERA).id
        mujoco.mj_forward(model, data)  # the camera does not move, so that any state shows where it stands
        height, width = self._picture_size
        fovy = np.radians(model.cam_fovy[camera])
        return CameraPointer(data.cam_xpos[camera], data.cam_xmat[camera], fovy, width / height, self._n_axes)

    def close(self) -> None:
        """Free the OpenGL context, if any picture was made."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def picture_of(self, numbers: Mapping[str, np.ndarray]) -> np.ndarray:
        """(camera_size, camera_size, 3) uint8 of the arm as it is, and of the objects where they are given.

        Args:
            numbers: An observation's ``environment_state``.
        """
        shown = copy.copy(self._simulation.data)
        self._place_objects(shown, numbers["environment_state"])
        mujoco.mj_forward(self._simulation.model, shown)
        return shared_camera(self._simulation.model, self._camera_size).picture(shown)

    def _observation(self) -> Observation:
        numbers = self._numbers()
        before = numbers["agent_pos"] if self._before is None else self._before
        self._before = numbers["agent_pos"]
        if not shows_pictures(self._obs_type):
            return numbers
        camera = shared_camera(self._simulation.model, self._camera_size)
        return observed(self._obs_type, numbers, before, camera.picture(self._simulation.data))

    def _agent_pos(self) -> np.ndarray:
        """(2 n_axes,) desired, then actual tool position."""
        actual = self._simulation.tool_position[: self._n_axes]
        return np.concatenate([self._desired[: self._n_axes], actual]).astype(np.float32)

    @abc.abstractmethod
    def _begin_episode(self, options: dict[str, Any]) -> None:
        """Reset the simulation and what is remembered of the episode."""

    @abc.abstractmethod
    def _numbers(self) -> dict[str, np.ndarray]:
        """``agent_pos`` and ``environment_state``."""

    def _place_objects(self, data: "mujoco.MjData", environment_state: np.ndarray) -> None:
        """Put what can move where an observation says; by default nothing can."""

    @abc.abstractmethod
    def _judge(self) -> None:
        """Update what is remembered of the episode after a step."""

    @abc.abstractmethod
    def _info(self) -> dict[str, Any]: ...

    @abc.abstractmethod
    def _reward(self) -> float: ...

    @abc.abstractmethod
    def _is_over(self) -> bool: ...


def given_numbers(options: dict[str, Any], name: str, meanings: Sequence[str]) -> np.ndarray:
    """(n,) float64 of what `reset(options=...)` gives for `name`.

    Raises:
        ValueError: If it is not a finite number for each of the n meanings.
    """
    try:
        numbers = np.asarray(options[name], dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (len(meanings),) or not np.isfinite(numbers).all():
        raise ValueError(
            f"options[{name!r}]={options[name]!r}: expected finite numbers [{', '.join(meanings)}]"
        )
    return numbers
