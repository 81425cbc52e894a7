"""The arm of the D3IL tasks as MuJoCo bodies: a Franka Panda whose hand holds a vertical rod.

Frames, masses, inertias and joints are measurements of the benchmark's compiled model (Jia et al., ICLR
2024); they decide how far the arm lags behind its set-point, which a policy feels. The visible shapes are our
own, have no mass and touch nothing; only the rod can touch things.
"""

from typing import Literal, NamedTuple

from lerobot_swr.envs.d3il.dependencies import mujoco
from lerobot_swr.envs.d3il.layouts import ROD_RADIUS

N_ARM_JOINTS = 7
N_JOINTS = 9
"""Seven hinges of the arm and the slides of the two fingers, the first degrees of freedom of every scene."""
TOOL_SITE = "tool"
ROD_GEOM = "rod"

ROD_HALF_LENGTH = 0.15
ROD_CENTRE_Z = 0.075
TOOL_Z = 0.105
"""The tool centre point on the hand's z axis; the rod's tip is 0.12 m further."""

_MOTOR_FORCE_LIMITS = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Joint(NamedTuple):
    """A joint: hinges turn about z (rad), finger slides move along y (m)."""

    name: str
    kind: Literal["hinge", "slide"]
    axis: Triple
    range: tuple[float, float]
    damping: float


class ArmBody(NamedTuple):
    """A body: frame in its parent, mass (kg), principal moments (kg m^2) in an inertial frame."""

    name: str
    parent: str
    position: Triple
    quaternion: Quaternion
    mass: float
    inertial_position: Triple
    inertial_quaternion: Quaternion
    inertia: Triple
    joint: Joint | None = None


_Z: Triple = (0.0, 0.0, 1.0)
_ORIGIN: Triple = (0.0, 0.0, 0.0)
_UNROTATED: Quaternion = (1.0, 0.0, 0.0, 0.0)
_QUARTER_X: Quaternion = (0.70710678, 0.70710678, 0.0, 0.0)
_BACK_QUARTER_X: Quaternion = (0.70710678, -0.70710678, 0.0, 0.0)

# fmt: off
BODIES = (
    ArmBody("link0", "world", _ORIGIN, _UNROTATED, 3.01399,
            (-0.0291898, -0.00087946, 0.0566032), (0.00411744, 0.56491607, 0.0132875, 0.8250311),
            (0.0126801, 0.0117603, 0.00856656)),
    ArmBody("link1", "link0", (0.0, 0.0, 0.333), _UNROTATED, 2.77281,
            (1.14e-05, -0.0312655, -0.0693733), (0.98466046, 0.17448108, -0.00010182, 0.00034766),
            (0.0164224, 0.0153969, 0.00546286), Joint("joint1", "hinge", _Z, (-2.9671, 2.9671), 0.0)),
    ArmBody("link2", "link1", _ORIGIN, _BACK_QUARTER_X, 2.7996,
            (-1.318e-05, -0.0703216, 0.0311782), (0.57483992, 0.81826589, -6.058e-05, -6.616e-05),
            (0.016787, 0.0157415, 0.00553027), Joint("joint2", "hinge", _Z, (-1.8326, 1.8326), 0.0)),
    ArmBody("link3", "link2", (0.0, -0.316, 0.0), _QUARTER_X, 2.14603,
            (0.0443483, 0.0249283, -0.03813), (0.0615263, 0.34982401, 0.23429101, 0.90495602),
            (0.00915257, 0.00896477, 0.00384742), Joint("joint3", "hinge", _Z, (-2.9671, 2.9671), 0.0)),
    ArmBody("link4", "link3", (0.0825, 0.0, 0.0), _QUARTER_X, 2.18807,
            (-0.0385503, 0.0395256, 0.0247162), (0.81356635, 0.4650412, 0.30979213, 0.16085807),
            (0.00946899, 0.00928491, 0.00396694), Joint("joint4", "hinge", _Z, (-3.1416, 0.0873), 0.0)),
    ArmBody("link5", "link4", (-0.0825, 0.384, 0.0), _BACK_QUARTER_X, 3.19545,
            (-6.368e-05, 0.0384124, -0.10997), (0.99076692, -0.13557099, 0.00096311, 0.00069441),
            (0.0278873, 0.0268823, 0.00569569), Joint("joint5", "hinge", _Z, (-2.9671, 2.9671), 0.0)),
    ArmBody("link6", "link5", _ORIGIN, _QUARTER_X, 1.35761,
            (0.0510023, 0.00693267, 0.00616899), (-0.04608412, 0.75436236, 0.04449402, 0.65332531),
            (0.00412168, 0.0033698, 0.00213304), Joint("joint6", "hinge", _Z, (-0.0873, 3.8223), 0.0)),
    ArmBody("link7", "link6", (0.088, 0.0, 0.0), _QUARTER_X, 0.417345,
            (0.0103614, 0.0103596, 0.0791078), (0.6354699, 0.27802096, -0.67046189, 0.26336896),
            (0.000637671, 0.000528056, 0.000279577), Joint("joint7", "hinge", _Z, (-2.9671, 2.9671), 0.0)),
    ArmBody("link8", "link7", (0.0, 0.0, 0.107), _UNROTATED, 0.1, _ORIGIN, _UNROTATED, (0.1, 0.1, 0.1)),
    ArmBody("hand", "link8", _ORIGIN, (0.92388, 0.0, 0.0, -0.382683), 0.670782,
            (-2.77e-06, -0.00061547, 0.0239295), (0.69794516, 0.71615116, -0.00024249, 8.476e-05),
            (0.00227632, 0.00206087, 0.000456542)),
    ArmBody("rod", "hand", _ORIGIN, _UNROTATED, 0.09424777960769382,
            (0.0, 0.0, ROD_CENTRE_Z), _UNROTATED,
            (0.0007092145415478959, 0.0007092145415478959, 4.71238898038469e-06)),
    ArmBody("rod_tip", "rod", _ORIGIN, _UNROTATED, 0.004188790204786391,
            (0.0, 0.0, 0.225), _UNROTATED,
            (1.6755160819145565e-07, 1.6755160819145565e-07, 1.6755160819145565e-07)),
    ArmBody("left_finger", "hand", (0.0, 0.0, 0.0584), _UNROTATED, 0.0218754,
            (-2.423e-05, 0.0119585, 0.0237816), (0.99617716, 0.08686311, -2.794e-05, -0.00926642),
            (5.69661e-06, 5.56035e-06, 1.55183e-06),
            Joint("left_finger_slide", "slide", (0.0, 1.0, 0.0), (0.0, 0.04), 10.0)),
    ArmBody("left_finger_tip", "left_finger", (0.0, 0.0085, 0.056), _UNROTATED, 0.01,
            _ORIGIN, (0.0, 0.0, 0.0, 1.0), (0.01, 0.01, 0.01)),
    ArmBody("right_finger", "hand", (0.0, 0.0, 0.0584), _UNROTATED, 0.0218754,
            (2.423e-05, -0.0119585, 0.0237816), (0.99617716, -0.08686311, 2.794e-05, -0.00926642),
            (5.69661e-06, 5.56035e-06, 1.55183e-06),
            Joint("right_finger_slide", "slide", (0.0, -1.0, 0.0), (0.0, 0.04), 10.0)),
    ArmBody("right_finger_tip", "right_finger", (0.0, -0.0085, 0.056), _UNROTATED, 0.01,
            _ORIGIN, (0.0, 0.0, 0.0, 1.0), (0.01, 0.01, 0.01)),
)


class VisualShape(NamedTuple):
    """A capsule between two points of a body's frame, or, where `box` is given, a box about `start`."""

    body: str
    start: Triple
    end: Triple = _ORIGIN
    radius: float = 0.0
    box: Triple | None = None
    dark: bool = False


VISUAL_SHAPES = (
    VisualShape("link0", (-0.05, 0.0, 0.04), box=(0.11, 0.09, 0.06), dark=True),
    VisualShape("link0", (0.0, 0.0, 0.05), (0.0, 0.0, 0.2), 0.065),
    VisualShape("link1", (0.0, 0.0, -0.12), (0.0, 0.0, -0.02), 0.062),
    VisualShape("link2", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.062, dark=True),
    VisualShape("link2", (0.0, -0.03, 0.0), (0.0, -0.19, 0.0), 0.058),
    VisualShape("link3", (0.0, 0.0, -0.12), (0.0, 0.0, -0.02), 0.056),
    VisualShape("link3", (0.0, 0.0, -0.02), (0.0825, 0.0, 0.0), 0.052),
    VisualShape("link4", (0.0, 0.0, -0.055), (0.0, 0.0, 0.055), 0.056, dark=True),
    VisualShape("link4", (0.0, 0.0, 0.0), (-0.0825, 0.08, 0.0), 0.05),
    VisualShape("link5", (0.0, 0.0, -0.26), (0.0, 0.03, -0.14), 0.05),
    VisualShape("link5", (0.0, 0.06, -0.14), (0.0, 0.04, -0.03), 0.035),
    VisualShape("link6", (0.0, 0.0, -0.05), (0.0, 0.0, 0.05), 0.048, dark=True),
    VisualShape("link6", (0.0, 0.0, 0.0), (0.088, 0.0, 0.0), 0.045),
    VisualShape("link7", (0.0, 0.0, 0.0), (0.0, 0.0, 0.08), 0.042),
    VisualShape("hand", (0.0, 0.0, 0.03), box=(0.025, 0.1, 0.032), dark=True),
    VisualShape("left_finger", (0.0, 0.01, 0.025), box=(0.01, 0.008, 0.028)),
    VisualShape("right_finger", (0.0, -0.01, 0.025), box=(0.01, 0.008, 0.028)),
)
# fmt: on

_LIGHT_SHELL = (0.93, 0.94, 0.95, 1.0)
_DARK_SHELL = (0.30, 0.32, 0.35, 1.0)
_ROD_COLOUR = (0.98, 0.80, 0.05, 1.0)


def add_arm(spec: "mujoco.MjSpec") -> None:
    """Add the arm, its motors, the rod and the tool centre point to a scene that has no joint yet."""
    bodies = {"world": spec.worldbody}
    for facts in BODIES:
        bodies[facts.name] = body = bodies[facts.parent].add_body(
            name=facts.name,
            pos=facts.position,
            quat=facts.quaternion,
            mass=facts.mass,
            ipos=facts.inertial_position,
            iquat=facts.inertial_quaternion,
            inertia=facts.inertia,
            explicitinertial=True,
        )
        if facts.joint is not None:
            _add_joint_with_motor(spec, body, facts.joint)
    for shape in VISUAL_SHAPES:
        _add_visual(bodies[shape.body], shape)
    bodies["rod"].add_geom(
        name=ROD_GEOM,
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        pos=(0.0, 0.0, ROD_CENTRE_Z),
        size=(ROD_RADIUS, ROD_HALF_LENGTH, 0.0),
        rgba=_ROD_COLOUR,
    )
    bodies["hand"].add_site(name=TOOL_SITE, pos=(0.0, 0.0, TOOL_Z), rgba=(0.0, 0.0, 0.0, 0.0))


def _add_joint_with_motor(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", joint: Joint) -> None:
    is_hinge = joint.kind == "hinge"
    body.add_joint(
        name=joint.name,
        type=mujoco.mjtJoint.mjJNT_HINGE if is_hinge else mujoco.mjtJoint.mjJNT_SLIDE,
        axis=joint.axis,
        range=joint.range,
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        damping=joint.damping,
    )
    motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    if is_hinge:
        limit = _MOTOR_FORCE_LIMITS[len(spec.actuators) - 1]
        motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        motor.forcerange = (-limit, limit)


def _add_visual(body: "mujoco.MjsBody", shape: VisualShape) -> None:
    colour = _DARK_SHELL if shape.dark else _LIGHT_SHELL
    untouchable = {"contype": 0, "conaffinity": 0, "mass": 0.0, "rgba": colour}
    if shape.box is not None:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=shape.start, size=shape.box, **untouchable)
    else:
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(*shape.start, *shape.end),
            size=(shape.radius, 0.0, 0.0),
            **untouchable,
        )
