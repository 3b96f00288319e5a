"""How far a point is from the surfaces of an MJX scene: the closed-form signed distances of MuJoCo's primitives."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax.sim import render_shapes
from lala_jax.sim.quiet import mjx

TINY = 1e-24  # square metres under a root, so that its gradient stays finite


def distance(model: mjx.Model, data: mjx.Data, points: jax.Array, *, geoms: tuple[int, ...]) -> jax.Array:
    """Give the signed distance `[P]` in metres from world points `[P, 3]` to the nearest of the geoms, negative inside. Unbatched.

    The gradient is the unit normal of the nearest surface, finite everywhere. A plane is the half space below it whatever
    its sides, as in MuJoCo's collisions. Inside several geoms at once it is the depth in the deepest one, a lower bound of
    the way out of their union. Elementwise arithmetic in float32, no matrix unit. Raises ValueError on a geom type without
    a closed form, on no geoms, and on points of another shape.
    """
    if points.ndim != 2 or points.shape[-1] != 3:
        raise ValueError(f"distance is unbatched: points must be [P, 3], got {points.shape}; vmap over clouds")
    if not geoms:
        raise ValueError("distance needs at least one geom")
    groups = render_shapes.groups(model, geoms, known=_DISTANCES)
    return functools.reduce(jnp.minimum, [_nearest(kind, model, data, np.asarray(ids), points) for kind, ids in groups])


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
    most = functools.reduce(jnp.maximum, over)
    return jnp.where(most > 0, _norm(*(jnp.maximum(axis, 0.0) for axis in over)), most)


_DISTANCES = {
    render_shapes.PLANE: _plane,
    render_shapes.SPHERE: _sphere,
    render_shapes.CAPSULE: _capsule,
    render_shapes.CYLINDER: _cylinder,
    render_shapes.BOX: _box,
}
