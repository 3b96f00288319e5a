"""From a task and a scene to a MuJoCo model, cameras and light; and the same scene as MJX pytrees for the renderer."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lala_jax import types
from lala_jax.perception import camera as pinhole
from lala_jax.perception import transforms
from lala_jax.sim import robot, suction
from lala_jax.sim.tasks import base

if TYPE_CHECKING:
    from mujoco import mjx

TIMESTEP = 0.004  # seconds
# Contacts this stiff let a block sink in by less than 0.01 mm under its own weight; MuJoCo's defaults let a tower of five sag by 2 mm.
SOLREF = (0.008, 1.0)
SOLIMP = (0.99, 0.999, 0.001, 0.5, 2.0)
TRIES = 100  # scenes, of which one has room for its objects
IMPRATIO = 10.0  # friction stiffer than the normal force: nothing creeps
FRICTION = (1.0, 0.005, 0.0001)  # sliding; torsional and rolling in metres
TABLE_COLOR = (51 / 255, 51 / 255, 51 / 255)
AMBIENT, DIFFUSE = 0.65, 0.35  # a surface facing the light shows its own colour
LIGHT_DIR = (0.25, 0.15, 0.96)  # towards the light, normalised below
LIGHT_DIR = tuple(float(v) for v in np.array(LIGHT_DIR) / np.linalg.norm(LIGHT_DIR))

# name -> (eyes [V, 3], target [3]) in metres. `paper`: the ring around (0.25, 0) of the paper's author. `ring`: the same ring around
# the workspace's centre, turned by 45 degrees so that no camera looks along the arm.
_DIAGONAL = 0.75 * np.sqrt(0.5)
PRESETS = {
    "ring": ([(0.5 + sx * _DIAGONAL, sy * _DIAGONAL, 0.75) for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1))], (0.5, 0.0, 0.0)),
    "paper": ([(1.0, 0.0, 0.75), (0.25, 0.75, 0.75), (-0.5, 0.0, 0.75), (0.25, -0.75, 0.75)], (0.25, 0.0, 0.0)),
}


def cameras(preset: str = "ring", *, height: int = 480, width: int = 640) -> types.Camera:
    """Give a preset's cameras, leaves `[V, ...]`: a RealSense D415 model (focal length 450 pixels at 640 wide), scaled to the image size.

    Raises ValueError naming the presets.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown camera preset {preset!r}, choose one of {', '.join(sorted(PRESETS))}")
    eyes, target = PRESETS[preset]
    full = pinhole.pinhole(pinhole.look_at(np.array(eyes), np.array(target)), height=480, width=640, focal=450.0)
    return pinhole.scale(full, height, width)


def build_spec(task: base.Task, scene: types.Scene, *, cameras: types.Camera | None = None) -> mujoco.MjSpec:
    """Describe a scene: `table`, `base`, objects `object0` .. at their start poses, the arm, its suction welds and `camera0` ..."""
    spec = mujoco.MjSpec()
    spec.modelname = task.name
    spec.option.timestep = TIMESTEP
    spec.option.gravity = [0.0, 0.0, -9.81]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPRATIO
    spec.add_material(name="plain")  # the ray functions of MJX index the materials' colours, so there must be one
    _add_light(spec)
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05], rgba=[*TABLE_COLOR, 1.0])
    size, start, color = (np.asarray(leaf, np.float64) for leaf in (scene.size, scene.start, scene.color))
    _add_box(spec, "base", np.asarray(scene.base, np.float64), task.base_size, task.base_color)
    masses = np.asarray(task.object_mass(scene))
    if masses.shape != (len(size),):
        raise ValueError(f"task {task.name}: object_mass must give one mass for each of {len(size)} objects, got shape {masses.shape}")
    for i, mass in enumerate(masses):
        _add_box(spec, f"object{i}", start[i], size[i], color[i], mass=mass)
    robot.add_ur5e(spec)
    for geom in spec.geoms:
        geom.solref, geom.solimp = SOLREF, SOLIMP
    suction.add(spec, len(size))
    if cameras is not None:
        _add_cameras(spec, cameras)
    return spec


def build_model(task: base.Task, scene: types.Scene, *, cameras: types.Camera | None = None) -> mujoco.MjModel:
    """Compile `build_spec`; the model's initial state has the objects at the scene's start poses."""
    return build_spec(task, scene, cameras=cameras).compile()


def _add_box(spec, name, pose, size, color, *, mass=None):
    body = spec.worldbody.add_body(name=name, pos=pose[:3], quat=pose[3:])
    geom = body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=np.asarray(size) / 2, rgba=[*color, 1.0], friction=FRICTION)
    if mass is not None:
        geom.mass = mass
        geom.conaffinity = robot.OBJECT_CONAFFINITY
        body.add_freejoint(name=name)


def _add_light(spec):
    spec.visual.headlight.active = 0
    spec.worldbody.add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0.5, 0.0, 2.0],
        dir=[-v for v in LIGHT_DIR],
        ambient=[AMBIENT] * 3,
        diffuse=[DIFFUSE] * 3,
        specular=[0.0] * 3,
        castshadow=False,
    )


def _add_cameras(spec, cameras):
    """Add MuJoCo cameras, which look along -z with y up and centre the principal point."""
    for i, (world_from_cam, intrinsics) in enumerate(zip(np.asarray(cameras.world_from_cam), np.asarray(cameras.intrinsics), strict=True)):
        spec.worldbody.add_camera(
            name=f"camera{i}",
            pos=world_from_cam[:3, 3],
            quat=transforms.quat_from_matrix(np.asarray(world_from_cam[:3, :3], np.float64) * [1.0, -1.0, -1.0]),
            fovy=float(np.rad2deg(2 * np.arctan(cameras.height / 2 / intrinsics[1, 1]))),
            resolution=[cameras.width, cameras.height],
        )
    spec.visual.global_.offwidth, spec.visual.global_.offheight = cameras.width, cameras.height


def _geoms(model: mujoco.MjModel | mjx.Model) -> dict[str, int]:
    """Give the geom indices by name; geoms without a name are left out."""
    names = (model.names[start:].split(b"\0", 1)[0].decode() for start in model.name_geomadr)
    return {name: i for i, name in enumerate(names) if name}


def object_geoms(model: mujoco.MjModel | mjx.Model) -> tuple[int, ...]:
    """Give the geom indices of the objects, in the scene's order."""
    geoms = _geoms(model)
    return tuple(geoms[f"object{i}"] for i in range(sum(name.removeprefix("object").isdigit() for name in geoms)))


def base_geom(model: mujoco.MjModel | mjx.Model) -> int:
    """Give the geom index of the stand or pallet."""
    return _geoms(model)["base"]


def static_geoms(model: mujoco.MjModel | mjx.Model) -> tuple[int, ...]:
    """Give the geom indices that look the same in every observed scene of a task: the table and the arm at home."""
    moving = {*object_geoms(model), base_geom(model)}
    return tuple(i for i in range(model.ngeom) if i not in moving)


def _any_scene(task: base.Task) -> types.Scene:
    """Give the first scene of a task that has room for its objects."""
    for _, drawn in task.roomy(range(TRIES)):
        return drawn
    raise base.NoFreePose(f"task {task.name}: none of the first {TRIES} scenes has a free pose for every object")


@functools.cache
def geom_template(task: base.Task) -> tuple[mjx.Model, mjx.Data]:
    """Give a task's MJX model and data with the arm at home, as a canvas for `place`; for looking at only, it has no contacts."""
    from lala_jax.sim.quiet import mjx  # slow to import, and only the renderer's side needs it

    model = build_model(task, _any_scene(task))
    model.geom_contype[:] = 0
    model.geom_conaffinity[:] = 0
    data = mujoco.MjData(model)
    robot.Arm(model).reset(data)
    mujoco.mj_forward(model, data)
    with jax.ensure_compile_time_eval():  # the cache must not keep tracers of a caller's jit
        here = jax.local_devices()[0]  # MJX's own choice is the first device of all processes
        return mjx.put_model(model, device=here), mjx.put_data(model, data, device=here)


def place(
    model: mjx.Model, data: mjx.Data, *, size: jax.Array, color: jax.Array, poses: jax.Array, base: jax.Array
) -> tuple[mjx.Model, mjx.Data]:
    """Put objects of `size` `[N, 3]` (full, metres) and `color` `[N, 3]` at `poses` `[N, 7]`, the base at `base` `[7]`. Unbatched.

    Changes the geoms only (`geom_size`, `geom_rgba`, `geom_rbound`, `geom_xpos`, `geom_xmat`), which is what a renderer looks at.
    """
    objects = np.array(object_geoms(model))
    if size.shape != (len(objects), 3) or poses.shape != (len(objects), 7):
        raise ValueError(f"place is unbatched, for {len(objects)} objects: got size {size.shape}, poses {poses.shape}; vmap over scenes")
    half = jnp.asarray(size) / 2
    rgba = jnp.concatenate([jnp.asarray(color), jnp.ones_like(color[:, :1])], axis=-1)
    moved = np.array([*objects, base_geom(model)])
    pose = jnp.concatenate([jnp.asarray(poses), jnp.asarray(base)[None]])
    model = model.replace(
        geom_size=model.geom_size.at[objects].set(half),
        geom_rgba=model.geom_rgba.at[objects].set(rgba),
        geom_rbound=jnp.asarray(model.geom_rbound).at[objects].set(jnp.linalg.norm(half, axis=-1)),
    )
    data = data.replace(
        geom_xpos=data.geom_xpos.at[moved].set(pose[:, :3]),
        geom_xmat=data.geom_xmat.at[moved].set(transforms.matrix_from_quat(pose[:, 3:])),
    )
    return model, data
