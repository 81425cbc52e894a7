"""The avoiding task: find one of 24 ways through three levels of obstacles."""

from functools import lru_cache
from typing import Any

import numpy as np

from lerobot_swr.envs.d3il.arm import ROD_GEOM
from lerobot_swr.envs.d3il.arm_task import ArmTask
from lerobot_swr.envs.d3il.behavior import Gaps, gaps_after, mode_bits
from lerobot_swr.envs.d3il.dependencies import mujoco
from lerobot_swr.envs.d3il.layouts import (
    AVOIDING_DESCRIPTION,
    AVOIDING_SCENE,
    AVOIDING_START_JOINTS,
    AVOIDING_START_TOOL,
    CAMERA_SIZE,
    FINISH_LINE_Y,
    OBSTACLES,
)
from lerobot_swr.envs.d3il.perturbations import ArmPerturbations
from lerobot_swr.envs.d3il.scene import TABLE_TOP_Z, new_scene

_START_QPOS = np.array([*AVOIDING_START_JOINTS, 0.0, 0.0])  # the fingers start closed


class AvoidingEnv(ArmTask):
    """Move a rod past six cylinders to the finish line without touching one.

    **Observation** (float32, metres)

    | key | index | meaning |
    |---|---|---|
    | `agent_pos` | 0-1 | desired tool x, y |
    | | 2-3 | actual tool x, y |
    | `environment_state` | 0-17 | x, y, radius of the six obstacles, by level and x |
    | | 18 | y of the finish line |

    **Action** (2): change of the desired tool x, y in metres per step, clipped to +-0.05. The desired height
    stays 0.122 m. One step is 35 ms; demonstrations move 5 to 9 mm per step.

    **Start**: always the same pose, tool at (0.525, -0.280), unless a perturbation draws from the seed; or
    where a recording starts, by `reset(options={"agent_pos": [...]})`, see `ArmTask.reset`.

    **Reward**: 1 on reaching the finish line, else 0.

    **End**: terminates when the tool crosses y = 0.35 (success) or the rod touches an obstacle at the end of
    a step (a contact that is over by then goes unnoticed, as in the benchmark). Truncated after 250 steps.

    **Info**: `is_success`; `collision`; `mode`, (9,) int8, one bit per gap taken (2 + 3 + 4, from small to
    large x).

    **Behaviour**: `lerobot_swr.envs.d3il.behavior.avoiding_behavior`.

    Source: Jia et al., ICLR 2024. Version 0: first.

    Args:
        render_mode: `rgb_array` or None.
        render_height: Of the pictures, in pixels.
        render_width: Of the pictures, in pixels.
        render_shadows: Whether the pictures show shadows.
        start_radius: See `ArmPerturbations`.
        action_noise: See `ArmPerturbations`.
        obs_type: `state`, `pixels` or `both`, see `lerobot_swr.envs.observed`.
        camera_size: Side of the observed pictures, in pixels.
    """

    task = "avoiding"
    task_description = AVOIDING_DESCRIPTION

    def __init__(
        self,
        render_mode: str | None = None,
        render_height: int = 480,
        render_width: int = 640,
        render_shadows: bool = True,
        start_radius: float = 0.0,
        action_noise: float = 0.0,
        obs_type: str = "state",
        camera_size: int = CAMERA_SIZE,
    ):
        super().__init__(
            model=avoiding_model(),
            start_tool=AVOIDING_START_TOOL,
            n_axes=2,
            environment_state_size=len(AVOIDING_SCENE),
            perturbations=ArmPerturbations(start_radius, action_noise),
            render_mode=render_mode,
            render_height=render_height,
            render_width=render_width,
            render_shadows=render_shadows,
            obs_type=obs_type,
            camera_size=camera_size,
        )
        model = self._simulation.model
        self._rod = model.geom(ROD_GEOM).id
        self._obstacles = frozenset(model.geom(obstacle.name).id for obstacle in OBSTACLES)
        self._gaps: Gaps = (None, None, None)
        self._collision = False
        self._success = False

    def _begin_episode(self, options: dict[str, Any]) -> None:
        self._simulation.reset(_START_QPOS)
        self._gaps = (None, None, None)
        self._collision = self._success = False

    def _numbers(self) -> dict[str, np.ndarray]:
        return {"agent_pos": self._agent_pos(), "environment_state": AVOIDING_SCENE.copy()}

    def _judge(self) -> None:
        # Judged on the observed float32 position, so that the behaviour rule cannot disagree by a rounding.
        tool_xy = self._agent_pos()[2:4]
        self._gaps = gaps_after(self._gaps, tool_xy)
        self._success = bool(tool_xy[1] > FINISH_LINE_Y)
        self._collision = self._rod_touches_obstacle()

    def _rod_touches_obstacle(self) -> bool:
        for first, second in self._simulation.data.contact.geom:
            if (first == self._rod and second in self._obstacles) or (
                second == self._rod and first in self._obstacles
            ):
                return True
        return False

    def _info(self) -> dict[str, Any]:
        return {"is_success": self._success, "collision": self._collision, "mode": mode_bits(self._gaps)}

    def _reward(self) -> float:
        return float(self._success)

    def _is_over(self) -> bool:
        return self._success or self._collision


@lru_cache(maxsize=1)
def avoiding_model() -> "mujoco.MjModel":
    """The compiled scene, shared by all environments of this process (nothing writes to it)."""
    spec = new_scene(camera_position=(1.4, 0.06, 0.9), camera_target=(0.44, 0.06, 0.14))
    for obstacle in OBSTACLES:
        spec.worldbody.add_geom(
            name=obstacle.name,
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            pos=(obstacle.x, obstacle.y, 0.0),
            size=(obstacle.radius, obstacle.half_height, 0.0),
            rgba=(0.85, 0.16, 0.16, 1.0),
        )
    spec.worldbody.add_geom(
        name="finish_line",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0.45, FINISH_LINE_Y, TABLE_TOP_Z + 0.002),
        size=(0.35, 0.006, 0.002),
        rgba=(0.1, 0.7, 0.25, 1.0),
        contype=0,
        conaffinity=0,
    )
    return spec.compile()
