"""How far a point is from the surfaces of an MJX scene: the closed-form signed distances of MuJoCo's primitives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lala_jax.sim.quiet import mjx

TINY = 1e-24  # square metres under a root, so that its gradient stays finite

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


def distance(model: mjx.Model, data: mjx.Data, points: jax.Array, *, geoms: tuple[int, ...]) -> jax.Array:
    """Give the signed distance `[P]` in metres from world points `[P, 3]` to the nearest of the geoms, negative inside. Unbatched.

    The gradient is the unit normal of the nearest surface, finite everywhere. A plane is the half space below it whatever
    its sides, as in MuJoCo's collisions. Inside several geoms at once it is the depth in the deepest one, a lower bound of
    the way out of their union. Elementwise arithmetic in float32, no matrix unit. Raises ValueError on a geom type without
    a closed form, on no geoms, and on points of another shape.
    """
    if points.ndim != 2 or points.shape[-1] != 3:
        raise ValueError(f"distance is unbatched: points must be [P, 3], got {points.shape}; vmap over clouds")
    nearest = [_nearest(kind, model, data, np.asarray(ids), points) for kind, ids in _groups(model, geoms)]
    result = nearest[0]
    for other in nearest[1:]:
        result = jnp.minimum(result, other)
    return result


def _groups(model, geoms):
    """Sort the geoms by type: a list of (kind, ids)."""
    kinds = np.asarray(model.geom_type)
    if not geoms:
        raise ValueError("distance needs at least one geom")
    for geom in geoms:
        if not 0 <= geom < len(kinds):
            raise ValueError(f"geom {geom} is not in the model, which has {len(kinds)}")
        if int(kinds[geom]) not in _DISTANCES:
            name = mujoco.mjtGeom(int(kinds[geom])).name.removeprefix("mjGEOM_").lower()
            known = ", ".join(mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower() for kind in _DISTANCES)
            raise ValueError(f"geom {geom} is of type {name}, whose distance has no closed form; known are {known}")
    present = sorted({int(kinds[geom]) for geom in geoms})
    return [(kind, tuple(int(g) for g in geoms if kinds[g] == kind)) for kind in present]


def _nearest(kind, model, data, ids, points):
    """Give the distance `[P]` to the nearest geom of one type."""
    size, pos, mat = (jnp.asarray(leaf)[ids] for leaf in (model.geom_size, data.geom_xpos, data.geom_xmat))
    gap = [points[None, :, i] - pos[:, None, i] for i in range(3)]
    local = [sum(gap[i] * mat[:, i, k, None] for i in range(3)) for k in range(3)]  # in the geoms' frames, 3 of [G, P]
    return _DISTANCES[kind]([size[:, k, None] for k in range(3)], local).min(0)


def _norm(*parts):
    return jnp.sqrt(jnp.maximum(sum(part * part for part in parts), TINY))


def _plane(size, local):
    return local[2]


def _sphere(size, local):
    return _norm(*local) - size[0]


def _capsule(size, local):
    x, y, z = local
    return _norm(x, y, z - jnp.clip(z, -size[1], size[1])) - size[0]


def _cylinder(size, local):
    return _solid(_norm(local[0], local[1]) - size[0], jnp.abs(local[2]) - size[1])


def _box(size, local):
    return _solid(*(jnp.abs(axis) - half for axis, half in zip(local, size, strict=True)))


def _solid(*over):
    """Distance to where all of some orthogonal excesses are negative."""
    most = over[0]
    for axis in over[1:]:
        most = jnp.maximum(most, axis)
    return jnp.where(most > 0, _norm(*(jnp.maximum(axis, 0.0) for axis in over)), most)


_DISTANCES = {PLANE: _plane, SPHERE: _sphere, CAPSULE: _capsule, CYLINDER: _cylinder, BOX: _box}
