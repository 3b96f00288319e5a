"""The UR5e with a suction tool as a MuJoCo body tree, its limits, its reach and its joint controller.

The arm stands at the world origin on the table top (z = 0) and faces +x. Frames, masses and inertias are those of the maker's robot
description (Universal_Robots_ROS2_Description, config/ur5e); shapes are primitives. The tool is a rod along the flange's z axis
with a suction cup at its end; the site `tip` is the centre of the cup's face, its z pointing out of the tool.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from lala_jax.sim import kinematics

JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
ACTUATORS = tuple(name.removesuffix("_joint") for name in JOINTS)
LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
HOME = math.pi * np.array([-1, -0.5, 0.5, -0.5, -0.5, 0])  # folded back over -x, out of the cameras' way
HOME_BRANCH = kinematics.branch_of(HOME)  # elbow up, wrist 2 outwards: has the largest reach with the tool pointing down
MAX_SPEED = np.full(6, math.pi)  # rad/s, the maker's
MAX_ACCELERATION = np.array([10.0, 10, 14, 20, 20, 20])  # rad/s^2, keeps the torques below their limits in every pose
MAX_TORQUE = np.array([150.0, 150, 150, 28, 28, 28])  # N m, the maker's

TIP_SITE = "tip"
TIP_GEOM = "tip"
TOOL_BODY = "tool"
TIP_RADIUS = 0.008  # metres, the cup's
TOOL_LENGTH = 0.12  # metres from the flange to the tip
MAX_STRETCH = 0.995  # of upper arm plus forearm; short of the singular straight arm

ARM_CONTYPE = 2  # links touch the geoms whose conaffinity has this bit (the objects): not the table, the base or each other
OBJECT_CONAFFINITY = 1 | ARM_CONTYPE

_STIFFNESS = np.array([12000.0, 12000, 12000, 4000, 4000, 4000])  # N m / rad
_DAMPING = np.array([400.0, 400, 300, 50, 50, 50])  # N m s / rad
_TOOL_MASS = 0.2  # kg
_ARMATURE = 0.1  # kg m^2, rotor inertia behind the gear

_MASS = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)  # kg
_CENTER = (  # metres in the link's frame
    (0, -0.00193, -0.02561),
    (-0.2125, 0, 0.11336),
    (-0.2422, 0, 0.0265),
    (0, -0.01634, -0.0018),
    (0, 0.01634, -0.0018),
    (0, 0, -0.001159),
)
_ROLL = (math.pi / 2, 0, 0, math.pi / 2, -math.pi / 2, 0)  # of the inertia's frame about the link's x
_INERTIA = (  # kg m^2: xx, yy, zz, xy, xz, yz
    (0.00700210, 0.00648091, 0.00657286, 0.00000073, -0.00001053, 0.00049994),
    (0.01505885, 0.33388086, 0.33247207, -0.00005400, 0.00000563, -0.00000181),
    (0.00399632, 0.07879254, 0.07848510, -0.00001365, 0.00137272, -0.00000660),
    (0.00165491, 0.00135962, 0.00126279, -0.00000282, -0.00000438, 0.00010157),
    (0.00135617, 0.00127827, 0.00096614, -0.00000274, 0.00000444, -0.00005048),
    (0.00018694, 0.00018908, 0.00025756, 0.00000006, -0.00000017, -0.00000092),
)
_OFFSET = (  # of each link's frame in the one before; its joint turns about its own z
    (0, 0, kinematics.D1),
    (0, 0, 0),
    (kinematics.A2, 0, 0),
    (kinematics.A3, 0, kinematics.D4),
    (0, -kinematics.D5, 0),
    (0, kinematics.D6, 0),
)
_TWIST = (0, math.pi / 2, 0, 0, math.pi / 2, -math.pi / 2)  # about x

_LIGHT, _BLUE, _DARK = (0.82, 0.82, 0.82, 1), (0.49, 0.68, 0.80, 1), (0.28, 0.28, 0.28, 1)
_CYLINDER, _CAPSULE = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE
_SHAPES = {  # geom name: link, type, from, to (metres in the link's frame), radius, colour
    "robot_base": ("base", _CYLINDER, (0, 0, 0), (0, 0, 0.09), 0.075, _DARK),
    "robot_shoulder": ("shoulder", _CYLINDER, (0, 0, -0.0725), (0, 0, 0.06), 0.06, _BLUE),
    "robot_shoulder_lift": ("upper_arm", _CYLINDER, (0, 0, 0.05), (0, 0, 0.2), 0.06, _LIGHT),
    "robot_upper_arm": ("upper_arm", _CAPSULE, (0, 0, 0.138), (kinematics.A2, 0, 0.138), 0.048, _LIGHT),
    "robot_elbow": ("forearm", _CYLINDER, (0, 0, -0.03), (0, 0, 0.2), 0.05, _BLUE),
    "robot_forearm": ("forearm", _CAPSULE, (0, 0, 0.007), (kinematics.A3, 0, 0.007), 0.04, _LIGHT),
    "robot_wrist_1": ("wrist_1", _CYLINDER, (0, 0, -0.17), (0, 0, 0.045), 0.04, _BLUE),
    "robot_wrist_2": ("wrist_2", _CYLINDER, (0, 0, -0.06), (0, 0, 0.045), 0.04, _BLUE),
    "robot_wrist_3": ("wrist_3", _CYLINDER, (0, 0, -0.06), (0, 0, 0), 0.0375, _LIGHT),
    "robot_mount": ("tool", _CYLINDER, (0, 0, 0), (0, 0, 0.02), 0.03, _DARK),
    "robot_rod": ("tool", _CYLINDER, (0, 0, 0.02), (0, 0, TOOL_LENGTH - 0.02), 0.01, _LIGHT),
    TIP_GEOM: ("tool", _CYLINDER, (0, 0, TOOL_LENGTH - 0.02), (0, 0, TOOL_LENGTH), TIP_RADIUS, _DARK),
}
GEOMS = tuple(_SHAPES)


def _about_x(angle: float) -> tuple[float, float, float, float]:
    return (math.cos(angle / 2), math.sin(angle / 2), 0, 0)


def _inertia(link: int) -> np.ndarray:
    """Turn a link's inertia into the link's axes, as xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = _INERTIA[link]
    c, s = math.cos(_ROLL[link]), math.sin(_ROLL[link])
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    return tensor[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _add_shapes(body: mujoco.MjsBody, link: str) -> None:
    for name, (owner, kind, start, end, radius, rgba) in _SHAPES.items():
        if owner != link:
            continue
        touch = (1, 1) if name == TIP_GEOM else (ARM_CONTYPE, 0)
        body.add_geom(
            name=name,
            type=kind,
            fromto=(*start, *end),
            size=(radius, 0, 0),
            rgba=rgba,
            contype=touch[0],
            conaffinity=touch[1],
            friction=(1, 0.005, 0.0001),
        )


def _add_joint(spec: mujoco.MjSpec, body: mujoco.MjsBody, index: int) -> None:
    unit = 180 / math.pi if spec.compiler.degree else 1.0
    limit, torque = kinematics.LIMITS[index], MAX_TORQUE[index]
    body.add_joint(
        name=JOINTS[index],
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=(0, 0, 1),
        limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        range=(-limit * unit, limit * unit),
        armature=_ARMATURE,
        actfrclimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        actfrcrange=(-torque, torque),
        actgravcomp=True,
    )
    kp, kv = _STIFFNESS[index], _DAMPING[index]
    spec.add_actuator(
        name=ACTUATORS[index],
        target=JOINTS[index],
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=(kp, *[0] * 9),
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=(0, -kp, -kv, *[0] * 7),
        ctrllimited=mujoco.mjtLimited.mjLIMITED_FALSE,
        forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        forcerange=(-torque, torque),
    )


def add_ur5e(spec: mujoco.MjSpec) -> None:
    """Add the arm, its tool and one position actuator per joint to the world body of `spec`.

    Weights are compensated by the joints themselves (within their torque limits), so the controller only meets inertia and what the
    tip carries. The links touch only geoms with the bit `ARM_CONTYPE` in their conaffinity; the cup touches everything.
    The new qpos are zero: set them to `HOME` (see `Arm.reset`).
    """
    body = spec.worldbody.add_body(name="robot_base", quat=(0, 0, 0, 1))
    _add_shapes(body, "base")
    for index, link in enumerate(LINKS):
        body = body.add_body(
            name=link,
            pos=_OFFSET[index],
            quat=_about_x(_TWIST[index]),
            mass=_MASS[index],
            ipos=_CENTER[index],
            fullinertia=_inertia(index),
            explicitinertial=True,
            gravcomp=1,
        )
        _add_joint(spec, body, index)
        _add_shapes(body, link)
    tool = body.add_body(
        name=TOOL_BODY,
        mass=_TOOL_MASS,
        ipos=(0, 0, TOOL_LENGTH / 3),
        inertia=np.array([1, 1, 0.2]) * _TOOL_MASS * TOOL_LENGTH**2 / 12,
        explicitinertial=True,
        gravcomp=1,
    )
    _add_shapes(tool, "tool")
    tool.add_site(name=TIP_SITE, pos=(0, 0, TOOL_LENGTH))


def tip_pose_target(xyz: np.ndarray, yaw: float) -> np.ndarray:
    """Give the `world_from_flange` `[4, 4]` that holds the tip at `xyz` (metres, world) straight down.

    The flange's x axis points along `(cos yaw, sin yaw, 0)`; adding to `yaw` turns what hangs at the tip about world z by as much.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    x, y, z = (float(v) for v in xyz)
    return np.array([[c, s, 0, x], [s, -c, 0, y], [0, 0, -1, z + TOOL_LENGTH], [0, 0, 0, 1.0]])


def tip_yaw(q: np.ndarray) -> float:
    """Give the yaw in radians, as `tip_pose_target` means it, of joint angles `q` `[6]`."""
    flange = kinematics.forward(q)
    return math.atan2(flange[1, 0], flange[0, 0])


def tip_joints(xyz: np.ndarray, yaw: float, q_near: np.ndarray) -> np.ndarray | None:
    """Give the joint angles `[6]` of `HOME`'s branch nearest to `q_near` for a tip pointing down, None where `reachable` says no."""
    if not reachable(xyz, yaw):
        return None
    return kinematics.nearest(tip_pose_target(xyz, yaw), q_near, branch=HOME_BRANCH)


def _outwards(xy: np.ndarray) -> np.ndarray:
    """Give how far the elbow chain's end (wrist 1) is from the pan axis when the tip is at `xy`, NaN where the tip is too close."""
    square = (np.asarray(xy, float) ** 2).sum(-1) - kinematics.D4**2
    return np.sqrt(np.where(square >= 0, square, np.nan)) - kinematics.D5


_WRIST_HEIGHT = TOOL_LENGTH + kinematics.D6 - kinematics.D1  # of wrist 1 above the shoulder when the tip is at z = 0
_LONGEST = MAX_STRETCH * -(kinematics.A2 + kinematics.A3)
_SHORTEST = abs(kinematics.A2 - kinematics.A3) + 0.02


def reachable(xyz: np.ndarray, yaw: float | None = None) -> bool | np.ndarray:
    """Say whether the tip can be at `xyz` `[..., 3]` (metres, world) pointing straight down, in `HOME`'s branch.

    The last joint turns freely about the tool, so `yaw` changes nothing unless it is not finite. A single point gives a bool,
    an array of points an array of bools; not finite means not reachable.
    """
    xyz = np.asarray(xyz, float)
    out = _outwards(xyz[..., :2])
    stretch = np.hypot(out, xyz[..., 2] + _WRIST_HEIGHT)
    inside = (out > 0) & (stretch >= _SHORTEST) & (stretch <= _LONGEST)  # NaN compares false
    if yaw is not None:
        inside = inside & np.isfinite(yaw)
    return bool(inside) if inside.ndim == 0 else inside


def _run(start: int) -> slice:
    """Give where the six of a chain lie, one after the other: a slice is read several times as fast as six indices."""
    return slice(int(start), int(start) + len(JOINTS))


class Arm:
    """Where the arm's joints live in a compiled model, and how to command them."""

    def __init__(self, model: mujoco.MjModel):
        first = model.joint(JOINTS[0]).id
        self.model = model
        self.qpos = _run(model.jnt_qposadr[first])  # into data.qpos
        self.dof = _run(model.jnt_dofadr[first])  # into data.qvel
        self.actuators = _run(model.actuator(ACTUATORS[0]).id)  # into data.ctrl
        self._gain = model.actuator_gainprm[self.actuators, 0]
        self._damping = -model.actuator_biasprm[self.actuators, 2]
        self._acceleration = np.zeros(model.nv)
        self._torque = np.zeros(model.nv)

    def reset(self, data: mujoco.MjData, q: np.ndarray = HOME) -> None:
        """Put the arm at rest at `q` `[6]` and command it to stay; the caller runs `mj_forward`."""
        data.qpos[self.qpos] = q
        data.qvel[self.dof] = 0
        data.ctrl[self.actuators] = q

    def command(self, data: mujoco.MjData, q: np.ndarray, v: np.ndarray | None = None, a: np.ndarray | None = None) -> None:
        """Set the actuators to follow `q` (rad), `v` (rad/s), `a` (rad/s^2), `[6]` each, from the state in `data`.

        A position actuator alone lags by damping / stiffness * speed. The set point is moved ahead by that, and by the computed
        torque over the stiffness (inertia and Coriolis terms of the last step). Command before every step: a set point held over
        several steps ripples; if it must be, sample the path at the mean time of those steps.
        """
        torque = data.qfrc_bias[self.dof] - data.qfrc_gravcomp[self.dof]
        if v is not None:
            torque += self._damping * v
        if a is not None:
            self._acceleration[self.dof] = a
            mujoco.mj_mulM(self.model, data, self._torque, self._acceleration)
            torque += self._torque[self.dof]
        data.ctrl[self.actuators] = q + torque / self._gain
