"""A suction cup: one weld a graspable object, inactive until the cup sits fully on a face of it.

The welds are part of the model (MuJoCo cannot add constraints at run time); attaching writes the weld's relative
pose into the episode's own model and switches it on in the episode's own data.
"""

from __future__ import annotations

import mujoco
import numpy as np

from lala_jax.sim import robot

CUP_RADIUS = robot.TIP_RADIUS  # metres: this much of the face is needed around the tip
REACH = 0.003  # metres: a face further below the tip than this is not sucked on
HOLDING_FORCE = 30.0  # newtons: a stronger pull tears the object off
_RIM = 8  # rays around the rim of the cup
_LIFT = 0.005  # metres: rays start this far above the tip, for a tip pressed into the face by a fraction of a millimetre
_SOLREF = (0.008, 1.0)  # stiff: the held object follows the tool within 0.1 mm
_SOLIMP = (0.95, 0.999, 0.001, 0.5, 2.0)


def add(spec: mujoco.MjSpec, num_objects: int) -> None:
    """Add the inactive welds `suction0` .. between the tool's body and `object0` ..; the robot and the objects must be in `spec`."""
    tool = spec.geom(robot.TIP_GEOM).parent.name
    for i in range(num_objects):
        spec.add_equality(
            name=f"suction{i}",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=tool,
            name2=f"object{i}",
            active=False,
            solref=_SOLREF,
            solimp=_SOLIMP,
        )


def seals(model: mujoco.MjModel, data: mujoco.MjData, tip: np.ndarray, body: int) -> bool:
    """Say whether the cup at `tip` `[3]` (world metres) sits fully on `body`: every ray down from its rim must hit it within `REACH`."""
    tool = int(model.geom_bodyid[model.geom(robot.TIP_GEOM).id])
    angles = 2.0 * np.pi * np.arange(_RIM) / _RIM
    offsets = np.stack([CUP_RADIUS * np.cos(angles), CUP_RADIUS * np.sin(angles), np.full(_RIM, _LIFT)], axis=-1)
    down, geom = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    for start in np.concatenate([tip + offsets, [tip + (0.0, 0.0, _LIFT)]]):
        distance = mujoco.mj_ray(model, data, start, down, None, 1, tool, geom)
        if distance < 0.0 or distance > _LIFT + REACH or model.geom_bodyid[geom[0]] != body:
            return False
    return True


def attach(model: mujoco.MjModel, data: mujoco.MjData, index: int) -> None:
    """Weld `object{index}` to the tool where both are now; writes the relative pose into `model` and switches the weld on in `data`."""
    equality = model.equality(f"suction{index}").id
    tool, body = model.eq_obj1id[equality], model.eq_obj2id[equality]
    position, quat, inverse = np.zeros(3), np.zeros(4), np.zeros(4)
    mujoco.mju_negQuat(inverse, data.xquat[tool])
    mujoco.mju_rotVecQuat(position, data.xpos[body] - data.xpos[tool], inverse)
    mujoco.mju_mulQuat(quat, inverse, data.xquat[body])
    model.eq_data[equality, :3] = 0.0  # the anchor: the object's own origin
    model.eq_data[equality, 3:6] = position
    model.eq_data[equality, 6:10] = quat
    data.eq_active[equality] = 1


def detach(model: mujoco.MjModel, data: mujoco.MjData, index: int) -> None:
    """Switch the weld of `object{index}` off in `data`."""
    data.eq_active[model.equality(f"suction{index}").id] = 0


def pull(data: mujoco.MjData) -> float:
    """Give the force in newtons on the one active weld, as of the last step."""
    if not data.ne:
        return 0.0
    return float(np.sqrt(np.square(data.efc_force[:3]).sum()))  # equality rows come first, translation before rotation


def body_below(model: mujoco.MjModel, data: mujoco.MjData, tip: np.ndarray) -> int:
    """Give the body within `REACH` below `tip` `[3]` (world metres), the tool itself left out; -1 where there is none."""
    tool = int(model.geom_bodyid[model.geom(robot.TIP_GEOM).id])
    geom = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(model, data, tip + (0.0, 0.0, _LIFT), np.array([0.0, 0.0, -1.0]), None, 1, tool, geom)
    return int(model.geom_bodyid[geom[0]]) if 0.0 <= distance <= _LIFT + REACH else -1


def touches(data: mujoco.MjData, moving: np.ndarray, own: np.ndarray) -> bool:
    """Say whether a geom of `moving` `[G]` bool presses on one that is neither of `moving` nor of the robot's `own` `[G]` bool."""
    pairs = data.contact.geom[data.contact.dist < 0.0]
    other = ~(moving | own)
    return bool(((moving[pairs[:, 0]] & other[pairs[:, 1]]) | (moving[pairs[:, 1]] & other[pairs[:, 0]])).any())


def gap_below(model: mujoco.MjModel, data: mujoco.MjData, moving: np.ndarray, own: np.ndarray) -> float:
    """Give how far the geoms of `moving` `[G]` bool can go straight down before one may touch another thing, in metres; a lower bound.

    Exact for upright boxes: two geoms pass each other only where some horizontal axis of either one separates their
    bounding boxes. Infinite where nothing lies below.
    """
    corners = _corners(model, data)
    result = np.inf
    for i in np.flatnonzero(moving):
        for j in np.flatnonzero(~(moving | own) & (model.geom_contype | model.geom_conaffinity > 0)):
            if not _separated(corners[i], corners[j], data.geom_xmat[[i, j]]):
                result = min(result, corners[i][:, 2].min() - corners[j][:, 2].max())
    return max(result, 0.0)


def _corners(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Give the corners `[G, 8, 3]` of every geom's bounding box, world metres."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    local = model.geom_aabb[:, None, :3] + signs * model.geom_aabb[:, None, 3:]
    return data.geom_xpos[:, None] + local @ data.geom_xmat.reshape(-1, 3, 3).transpose(0, 2, 1)


def _separated(first: np.ndarray, second: np.ndarray, frames: np.ndarray) -> bool:
    """Say whether a vertical plane along some horizontal frame axis separates two sets of corners `[8, 3]`."""
    axes = frames.reshape(2, 3, 3)[:, :2, :].transpose(1, 0, 2).reshape(2, 6)
    axes = axes[:, np.abs(axes).max(0) > 1e-3]
    a, b = first[:, :2] @ axes, second[:, :2] @ axes
    return bool(((a.max(0) < b.min(0)) | (b.max(0) < a.min(0))).any())
