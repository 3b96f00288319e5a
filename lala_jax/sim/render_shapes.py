"""Closed-form rays against MuJoCo's primitives: what one geom looks like to one pinhole camera.

A geom is prepared once per image (`prepare`: everything that does not depend on the pixel) and cast on a rectangle
of pixels (`cast`). Pixels are given by their normalised coordinates x = (u - cx) / fx along columns and
y = (v - cy) / fy along rows, so that the ray of a pixel is (x, y, 1) in the camera frame and the ray parameter is
the z-depth itself. A hit is the first entry into the solid from outside: a camera inside a geom does not see it.
Geometry stays in float32 and uses no matrix unit.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

BIG = 1e9  # an inverse depth no plane reaches
TINY = 1e-12

PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


def extents(kind: int, size: jax.Array) -> jax.Array:
    """Give the half extents `[3]` in metres of the geom's bounding box in its own frame; infinite for an unbounded plane."""
    if kind == PLANE:
        sides = jnp.where(size[:2] > 0, size[:2], jnp.inf)
        return jnp.concatenate([sides, jnp.zeros(1)])
    if kind == SPHERE:
        return jnp.full(3, size[0])
    if kind == CAPSULE:
        return jnp.stack([size[0], size[0], size[0] + size[1]])
    if kind == CYLINDER:
        return jnp.stack([size[0], size[0], size[1]])
    return size


def prepare(kind: int, size: jax.Array, eye: jax.Array, geom_from_cam: jax.Array, light: jax.Array) -> dict:
    """Collect what `cast` needs of one geom seen by one camera (unbatched).

    `size` `[3]` is MuJoCo's geom_size, `eye` `[3]` the camera's centre and `light` `[3]` the unit vector towards the
    light, both in the geom's frame; `geom_from_cam` `[3, 3]` is a rotation.
    """
    if kind == BOX:
        return _prepare_box(size, eye, geom_from_cam, light)
    return {"size": size, "eye": eye, "rotation": geom_from_cam, "light": light}


def cast(kind: int, geom: dict, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Cast the pixels of columns `x` `[w]` and rows `y` `[h]` against one prepared geom.

    Returns the z-depth `[h, w]` of the first entry, infinite on a miss, and the cosine `[h, w]` between the normal
    there and the light, 0 where it looks away (undefined on a miss).
    """
    if kind == BOX:
        return _cast_box(geom, x[None, :], y[:, None])
    rotation, x, y = geom["rotation"], x[None, :], y[:, None]
    ray = [rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] for k in range(3)]
    eye = [geom["eye"][k] for k in range(3)]
    depth, normal = _ENTRIES[kind](geom["size"], eye, ray)
    cosine = sum(normal[k] * geom["light"][k] for k in range(3))
    return depth, jnp.broadcast_to(jnp.maximum(cosine, 0.0), depth.shape)


def _prepare_box(size, eye, geom_from_cam, light):
    """Write a box as linear bounds on the inverse depth w: below each face seen from outside, above every other.

    The half space s (eye + ray / w) <= size becomes s ray <= (size - s eye) w, which bounds w from above where the
    camera is outside it and from below where it is inside; both bounds are linear in the pixel.
    """
    sign = jnp.where(eye >= 0, 1.0, -1.0)
    outside = jnp.abs(eye) - size  # > 0: the face towards the camera is seen
    none = jnp.zeros(3)
    near = -sign[:, None] * geom_from_cam / jnp.where(outside == 0, TINY, outside)[:, None]
    far = -sign[:, None] * geom_from_cam / (size + jnp.abs(eye))[:, None]
    seen = (outside > 0)[:, None]
    return {
        "upper": jnp.where(seen, near, none.at[2].set(BIG)),
        "lower": jnp.concatenate([far, jnp.where(seen, none.at[2].set(-BIG), near)]),
        "cosine": jnp.maximum(sign * light, 0.0),
    }


def _cast_box(geom, x, y):
    upper = [plane[0] * x + (plane[1] * y + plane[2]) for plane in geom["upper"]]
    lower = [plane[0] * x + (plane[1] * y + plane[2]) for plane in geom["lower"]]
    entry = jnp.minimum(jnp.minimum(upper[0], upper[1]), upper[2])
    leave = lower[0]
    for bound in lower[1:]:
        leave = jnp.maximum(leave, bound)
    hit = (leave <= entry) & (entry > 0) & (entry < 0.5 * BIG)
    depth = jnp.where(hit, 1.0 / jnp.where(hit, entry, 1.0), jnp.inf)
    cosine = geom["cosine"]
    return depth, jnp.where(entry == upper[0], cosine[0], jnp.where(entry == upper[1], cosine[1], cosine[2]))


def _enter_plane(size, eye, ray):
    down = ray[2] < -TINY
    depth = jnp.where(down, -eye[2] / jnp.where(down, ray[2], -1.0), -1.0)
    inside = depth > 0
    for k in range(2):
        inside &= (size[k] <= 0) | (jnp.abs(eye[k] + depth * ray[k]) <= size[k])
    return jnp.where(inside, depth, jnp.inf), (0.0, 0.0, 1.0)


def _enter_round(radius, eye, ray):
    """Enter a sphere (three axes) or an infinite cylinder (two axes) around the origin: depth in, depth out, whether hit.

    Measured from the point nearest to the centre, where float32 still resolves a graze.
    """
    square = jnp.maximum(sum(r * r for r in ray), TINY)
    middle = -sum(e * r for e, r in zip(eye, ray, strict=True)) / square
    nearest = sum((e + middle * r) ** 2 for e, r in zip(eye, ray, strict=True))
    hit = nearest <= radius * radius
    half = jnp.sqrt(jnp.where(hit, radius * radius - nearest, 0.0) / square)
    return middle - half, middle + half, hit


def _enter_sphere(size, eye, ray):
    depth, _, hit = _enter_round(size[0], eye, ray)
    depth = jnp.where(hit & (depth > 0), depth, jnp.inf)
    at = jnp.where(jnp.isfinite(depth), depth, 0.0)
    return depth, [(e + at * r) / size[0] for e, r in zip(eye, ray, strict=True)]


def _enter_ellipsoid(size, eye, ray):
    depth, point = _enter_sphere(jnp.ones(1), [eye[k] / size[k] for k in range(3)], [ray[k] / size[k] for k in range(3)])
    normal = [point[k] / size[k] for k in range(3)]
    length = jnp.sqrt(jnp.maximum(sum(n * n for n in normal), TINY))
    return depth, [n / length for n in normal]


def _enter_capsule(size, eye, ray):
    radius, half = size[0], size[1]
    side, _, hit = _enter_round(radius, eye[:2], ray[:2])
    best = jnp.where(hit & (side > 0) & (jnp.abs(eye[2] + side * ray[2]) <= half), side, jnp.inf)
    for sign in (1.0, -1.0):
        end, _, hit = _enter_round(radius, [eye[0], eye[1], eye[2] - sign * half], ray)
        best = jnp.minimum(best, jnp.where(hit & (end > 0) & (sign * (eye[2] + end * ray[2]) >= half), end, jnp.inf))
    at = jnp.where(jnp.isfinite(best), best, 0.0)
    point = [eye[k] + at * ray[k] for k in range(3)]
    axis = jnp.clip(point[2], -half, half)
    return best, [point[0] / radius, point[1] / radius, (point[2] - axis) / radius]


def _enter_cylinder(size, eye, ray):
    radius, half = size[0], size[1]
    side_in, side_out, hit = _enter_round(radius, eye[:2], ray[:2])
    level = jnp.abs(ray[2]) < TINY
    slope = jnp.where(level, TINY, ray[2])
    bottom, top = (-half - eye[2]) / slope, (half - eye[2]) / slope
    cap_in, cap_out = jnp.minimum(bottom, top), jnp.maximum(bottom, top)
    depth = jnp.maximum(side_in, cap_in)
    hit &= (depth <= jnp.minimum(side_out, cap_out)) & (depth > 0)
    depth = jnp.where(hit, depth, jnp.inf)
    at, flat = jnp.where(hit, depth, 0.0), (cap_in > side_in)
    point = [(eye[k] + at * ray[k]) / radius for k in range(2)]
    return depth, [jnp.where(flat, 0.0, point[0]), jnp.where(flat, 0.0, point[1]), jnp.where(flat, -jnp.sign(ray[2]), 0.0)]


_ENTRIES = {
    PLANE: _enter_plane,
    SPHERE: _enter_sphere,
    CAPSULE: _enter_capsule,
    ELLIPSOID: _enter_ellipsoid,
    CYLINDER: _enter_cylinder,
}
KINDS = {PLANE: "plane", SPHERE: "sphere", CAPSULE: "capsule", ELLIPSOID: "ellipsoid", CYLINDER: "cylinder", BOX: "box"}


def groups(model, geoms: Sequence[int], *, known: Collection[int] = tuple(KINDS)) -> list[tuple[int, tuple[int, ...]]]:
    """Sort geoms by type: a list of (kind, ids). Raises ValueError on a geom that is not in the model or of no `known` type."""
    kinds = np.asarray(model.geom_type)
    for geom in geoms:
        if not 0 <= geom < len(kinds):
            raise ValueError(f"geom {geom} is not in the model, which has {len(kinds)}")
        kind = int(kinds[geom])
        if kind not in known:
            name, names = KINDS.get(kind, "other"), ", ".join(KINDS[one] for one in known)
            raise ValueError(f"geom {geom} is of mjtGeom type {kind} ({name}), which has no closed form; known are {names}")
    present = sorted({int(kinds[geom]) for geom in geoms})
    return [(kind, tuple(int(geom) for geom in geoms if kinds[geom] == kind)) for kind in present]
