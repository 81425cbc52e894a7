"""The aligning task: move an open box onto a target pose, from its inside or from its outside."""

import math
from functools import lru_cache
from typing import Any, NamedTuple, SupportsFloat

import numpy as np

from lerobot_swr.envs.d3il.arm import N_JOINTS
from lerobot_swr.envs.d3il.arm_task import ArmTask, Observation, given_numbers
from lerobot_swr.envs.d3il.behavior import is_aligned, is_inside, rotation_distance
from lerobot_swr.envs.d3il.dependencies import mujoco
from lerobot_swr.envs.d3il.layouts import (
    ALIGNING_DESCRIPTION,
    ALIGNING_SCENE_NAMES,
    ALIGNING_START_JOINTS,
    ALIGNING_START_TOOL,
    ANGLE_RANGE,
    BOX_POSITION_RANGE,
    CAMERA_SIZE,
    TARGET_POSITION_RANGE,
)
from lerobot_swr.envs.d3il.perturbations import ArmPerturbations
from lerobot_swr.envs.d3il.scene import new_scene

_START_ARM = (*ALIGNING_START_JOINTS, 0.0, 0.0)  # the fingers start closed

# Box: floor plate (half sizes) and four walls; the plate carries nearly all of the mass and slides easily.
_FLOOR_PLATE = (0.05, 0.05, 0.01)
_FLOOR_MASS = 1.0
_FLOOR_FRICTION = (0.3, 0.001, 0.0001)
_WALL_THICKNESS, _WALL_LENGTH, _WALL_HEIGHT = 0.005, 0.05, 0.045  # half sizes
_WALL_OFFSET, _WALL_Z = 0.05, 0.0485
_WALL_MASS = 0.001
_WALL_COLOURS = {
    (1, 0): (0.10, 0.25, 0.90, 1.0),
    (0, 1): (0.10, 0.65, 0.20, 1.0),
    (-1, 0): (0.85, 0.12, 0.12, 1.0),
    (0, -1): (0.05, 0.75, 0.80, 1.0),
}
_FLOOR_COLOUR = (0.95, 0.93, 0.88, 1.0)
_TARGET_OPACITY = 0.35


class PlanarPose(NamedTuple):
    """Where a box stands: position in metres and turn about the vertical in rad."""

    x: float
    y: float
    angle_rad: float

    @property
    def pose(self) -> np.ndarray:
        """(7,) position at z = 0 and quaternion (wxyz)."""
        return np.array(
            [self.x, self.y, 0.0, math.cos(self.angle_rad / 2), 0.0, 0.0, math.sin(self.angle_rad / 2)]
        )


class AligningEnv(ArmTask):
    """Push or pull an open box onto a target pose with a rod that can also reach into the box.

    **Observation** (float32, metres; quaternions w, x, y, z)

    | key | index | meaning |
    |---|---|---|
    | `agent_pos` | 0-2 | desired tool x, y, z |
    | | 3-5 | actual tool x, y, z |
    | `environment_state` | 0-6 | box position and quaternion |
    | | 7-13 | target position and quaternion |

    **Action** (3): change of the desired tool x, y, z in metres per step, clipped to +-0.05; one step is 35
    ms. The rod's tip is 0.12 m below the tool: it enters the box below z = 0.204 and touches its floor at z =
    0.121.

    **Start**: the arm always at (0.525, -0.349, 0.252). Box and target are drawn uniformly from the seed: box
    x 0.4 to 0.6, y -0.25 to -0.1, target x 0.4 to 0.6, y 0.2 to 0.35, both angles -90 to 90 degrees; or given
    by `reset(options={"box": [x, y, angle_rad], "target": [x, y, angle_rad]})`, either or both. The arm
    starts where a recording does by `"agent_pos": [...]`, see `ArmTask.reset`.

    **Reward**: -3.5 |box - target| - rotation distance / pi.

    **End**: terminates (success) when the box is within 18 mm (3-D; 15.5 mm in the plane, since the box rests
    9.2 mm below the target) and 8.64 degrees of its target. Truncated after 400 steps.

    **Info**: `is_success`; `mode`, 0 if the tool is inside the box (closer than 51 mm to its centre), else 1;
    `collision`, always False (touching the box is the task; LeRobot users read the same key for both tasks).

    **Behaviour**: `lerobot_swr.envs.d3il.behavior.aligning_behavior`.

    Source: Jia et al., ICLR 2024. Version 0: first.

    Args:
        render_mode: `rgb_array` or None.
        render_height: Of the pictures, in pixels.
        render_width: Of the pictures, in pixels.
        render_shadows: Whether the pictures show shadows.
        start_radius: See `ArmPerturbations`.
        action_noise: See `ArmPerturbations`.
        box_push: See `ArmPerturbations`.
        obs_type: `state`, `pixels` or `both`, see `lerobot_swr.envs.observed`.
        camera_size: Side of the observed pictures, in pixels.
    """

    task = "aligning"
    task_description = ALIGNING_DESCRIPTION

    def __init__(
        self,
        render_mode: str | None = None,
        render_height: int = 480,
        render_width: int = 640,
        render_shadows: bool = True,
        start_radius: float = 0.0,
        action_noise: float = 0.0,
        box_push: float = 0.0,
        obs_type: str = "state",
        camera_size: int = CAMERA_SIZE,
    ):
        super().__init__(
            model=aligning_model(),
            start_tool=ALIGNING_START_TOOL,
            n_axes=3,
            environment_state_size=len(ALIGNING_SCENE_NAMES),
            perturbations=ArmPerturbations(start_radius, action_noise, box_push),
            render_mode=render_mode,
            render_height=render_height,
            render_width=render_width,
            render_shadows=render_shadows,
            obs_type=obs_type,
            camera_size=camera_size,
        )
        self._box = self._simulation.data.joint("box").qpos
        self._box_velocity = self._simulation.data.joint("box").qvel
        self._push: tuple[int, np.ndarray] | None = None
        self._steps = 0
        self._target = np.zeros(7)

    def _begin_episode(self, options: dict[str, Any]) -> None:
        box = _given_pose(options, "box") or _draw_pose(self.np_random, BOX_POSITION_RANGE)
        target = _given_pose(options, "target") or _draw_pose(self.np_random, TARGET_POSITION_RANGE)
        self._target[:] = target.pose
        self._simulation.reset(np.concatenate([_START_ARM, box.pose]), marker=self._target)
        self._push = self._perturbations.draw_push(_FLOOR_FRICTION[0], self.np_random)
        self._steps = 0

    def step(self, action: np.ndarray) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """As `ArmTask.step`; the push, if any, comes first."""
        if self._push is not None and self._steps == self._push[0]:
            self._box_velocity[:2] += self._push[1]
        self._steps += 1
        return super().step(action)

    def _scene_state(self) -> np.ndarray:
        return np.concatenate([self._box, self._target]).astype(np.float32)

    def _numbers(self) -> dict[str, np.ndarray]:
        return {"agent_pos": self._agent_pos(), "environment_state": self._scene_state()}

    def _place_objects(self, data: "mujoco.MjData", environment_state: np.ndarray) -> None:
        data.joint("box").qpos[:] = environment_state[:7]
        data.mocap_pos[0], data.mocap_quat[0] = environment_state[7:10], environment_state[10:14]

    def _judge(self) -> None:
        """Nothing to remember: success and mode are read from the present state."""

    def _info(self) -> dict[str, Any]:
        scene = self._scene_state()
        inside = bool(is_inside(self._agent_pos()[3:6], scene[0:3]))
        return {"is_success": self._is_over(), "collision": False, "mode": 0 if inside else 1}

    def _reward(self) -> float:
        distance = float(np.linalg.norm(self._box[:3] - self._target[:3]))
        angle = float(rotation_distance(self._box[3:7], self._target[3:7]))
        return -3.5 * distance - angle / math.pi

    def _is_over(self) -> bool:
        # Judged on the observed float32 poses, so that the behaviour rule cannot disagree by a rounding.
        return bool(is_aligned(self._scene_state()))


def _given_pose(options: dict[str, Any], name: str) -> PlanarPose | None:
    """The pose [x, y, angle_rad] that `reset(options=...)` gives for `name`, if it does."""
    if options.get(name) is None:
        return None
    return PlanarPose(*given_numbers(options, name, PlanarPose._fields).tolist())


def _draw_pose(
    generator: np.random.Generator, position_range: tuple[tuple[float, float], tuple[float, float]]
) -> PlanarPose:
    x, y, angle = (float(generator.uniform(*limits)) for limits in (*position_range, ANGLE_RANGE))
    return PlanarPose(x, y, angle)


@lru_cache(maxsize=1)
def aligning_model() -> "mujoco.MjModel":
    """The compiled scene, shared by all environments of this process (nothing writes to it)."""
    spec = new_scene(camera_position=(1.4, 0.02, 0.85), camera_target=(0.46, 0.02, 0.14))
    box = spec.worldbody.add_body(name="box")
    box.add_freejoint(name="box")
    target = spec.worldbody.add_body(name="target", mocap=True)
    for body, touchable in ((box, True), (target, False)):
        _add_plate_and_walls(body, touchable)
    model = spec.compile()
    assert model.joint("box").qposadr[0] == N_JOINTS
    return model


def _add_plate_and_walls(body: "mujoco.MjsBody", touchable: bool) -> None:
    """Five box geoms; those that cannot be touched are translucent and have no mass."""

    def add(position, size, mass, colour, **contact):
        if not touchable:
            colour, mass, contact = (*colour[:3], _TARGET_OPACITY), 0.0, {"contype": 0, "conaffinity": 0}
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=position, size=size, mass=mass, rgba=colour, **contact
        )

    add((0.0, 0.0, 0.0), _FLOOR_PLATE, _FLOOR_MASS, _FLOOR_COLOUR, friction=_FLOOR_FRICTION, priority=1)
    for (along_x, along_y), colour in _WALL_COLOURS.items():
        position = (_WALL_OFFSET * along_x, _WALL_OFFSET * along_y, _WALL_Z)
        size = (
            (_WALL_THICKNESS, _WALL_LENGTH, _WALL_HEIGHT)
            if along_x
            else (_WALL_LENGTH, _WALL_THICKNESS, _WALL_HEIGHT)
        )
        add(position, size, _WALL_MASS, colour)
