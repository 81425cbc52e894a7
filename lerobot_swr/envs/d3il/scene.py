"""What both D3IL scenes share: solver settings, table, floor, light and camera."""

from lerobot_swr.envs.d3il.arm import add_arm
from lerobot_swr.envs.d3il.dependencies import mujoco

TABLE_TOP_Z = -0.019
CAMERA = "overview"
SQUARE_CAMERA = "square overview"
"""The same place, with an angle that shows all of the table's used part in a square picture."""

_TABLE_HALF_SIZE = (0.49, 0.98, 0.001)
_FLOOR_Z = -0.9


def new_scene(
    camera_position: tuple[float, float, float], camera_target: tuple[float, float, float]
) -> "mujoco.MjSpec":
    """A table with the arm on it and no task yet.

    Solver and contact settings are the benchmark's (Jia et al., ICLR 2024), since pushes depend on them.

    Args:
        camera_position: Where the camera of `render` stands, in metres.
        camera_target: The point it looks at.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 3.0
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    spec.option.tolerance = 1e-10
    spec.option.iterations = 100
    # The benchmark's MuJoCo 2.3.2 had only the older convex collision code. With it, nearly all of its box
    # pushes are reproduced to the last digits; the newer default decides stick and slip differently within
    # ten steps.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    spec.option.gravity = (0.0, 0.0, -9.81)
    add_arm(spec)
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=(0.4, 0.0, TABLE_TOP_Z - _TABLE_HALF_SIZE[2]),
        size=_TABLE_HALF_SIZE,
        solref=(0.002, 1.0),
        solimp=(0.999, 0.999, 0.001, 0.5, 2.0),
        rgba=(0.72, 0.66, 0.58, 1.0),
    )
    # Catches a box that is pushed off the table; the benchmark would let it fall for ever.
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=(0.0, 0.0, _FLOOR_Z),
        size=(5.0, 5.0, 0.1),
        rgba=(0.5, 0.55, 0.6, 1.0),
    )
    _add_light_and_camera(spec, camera_position, camera_target)
    return spec


def _add_light_and_camera(
    spec: "mujoco.MjSpec",
    camera_position: tuple[float, float, float],
    camera_target: tuple[float, float, float],
) -> None:
    spec.visual.headlight.ambient = (0.35, 0.35, 0.35)
    spec.visual.headlight.diffuse = (0.45, 0.45, 0.45)
    spec.worldbody.add_light(pos=(0.9, -0.6, 1.8), dir=(-0.3, 0.4, -1.0), diffuse=(0.5, 0.5, 0.5))
    target = spec.worldbody.add_body(name="camera_target", pos=camera_target)
    for name, angle in ((CAMERA, 36.0), (SQUARE_CAMERA, 46.0)):
        spec.worldbody.add_camera(
            name=name,
            pos=camera_position,
            mode=mujoco.mjtCamLight.mjCAMLIGHT_TARGETBODY,
            targetbody=target.name,
            fovy=angle,
        )
