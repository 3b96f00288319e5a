"""Depth, colour and geom ids of an MJX scene as pure functions of (model, data, camera).

The images are a closed form (`render_shapes`), composed by depth. Work goes where it is seen: every geom is cast only on
the tiles of pixels that its bounding box projects to, so a small object costs little, a large one many tiles, and nothing
can be clipped whatever the tile's size. A scene's fixed part is rendered once (`background`) and what moves is drawn over it
(`render_over`). On a GPU every geom is cast on every pixel instead, which fuses into one kernel.

All functions are written for one scene; `jax.vmap` over scenes keeps the loop over tiles in place. Of
derivatives they know forward mode (`jax.jvp`) only.
"""

from __future__ import annotations

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax import types
from lala_jax.sim import render_shapes, render_tiles, scene
from lala_jax.sim.quiet import mjx

SKY = (0.0, 0.0, 0.0)  # RGB where nothing was hit
TILE = (24, 24)  # (rows, columns) of pixels cast at a time
METHODS = ("auto", "tiles", "full")

Layer = types.Views


def render(
    model: mjx.Model,
    data: mjx.Data,
    camera: types.Camera,
    *,
    geoms: tuple[int, ...] | None = None,
    background: Layer | None = None,
    window: tuple[int, int] = TILE,
    method: str = "auto",
    segmentation: bool = True,
) -> types.Views:
    """Render one scene with V cameras (leaves `[V, ...]`), unbatched.

    `geoms` are the geom ids to draw, all by default; `background` is a layer to draw them over. Colour
    is rgba * (scene.AMBIENT + scene.DIFFUSE * max(0, normal . light)), without shadows. A geom with alpha 0 is not drawn
    and every other is opaque; a camera inside a geom does not see it; a plane is seen from above only. Raises ValueError
    on a geom type without a closed form.
    """
    geoms = tuple(range(model.ngeom)) if geoms is None else tuple(int(g) for g in geoms)
    if background is None:
        background = blank(camera, segmentation=segmentation)
    return render_over(background, model, data, camera, geoms=geoms, window=window, method=method)


@functools.partial(jax.jit, static_argnames=("geoms", "segmentation"))
def background(model: mjx.Model, data: mjx.Data, camera: types.Camera, *, geoms: tuple[int, ...], segmentation: bool = True) -> Layer:
    """Render the geoms that never move, once, to draw others over it with `render_over`; jitted, as it is called outside a step."""
    return render(model, data, camera, geoms=geoms, segmentation=segmentation)


def blank(camera: types.Camera, *, segmentation: bool = True) -> Layer:
    """Give the views of an empty world."""
    _check_camera(camera)
    shape = (camera.intrinsics.shape[0], camera.height, camera.width)
    return types.Views(
        rgb=jnp.broadcast_to(jnp.asarray(SKY, jnp.float32), (*shape, 3)),
        depth=jnp.zeros(shape, jnp.float32),
        camera=camera,
        segmentation=jnp.full(shape, -1, jnp.int32) if segmentation else None,
    )


def render_over(
    layer: Layer,
    model: mjx.Model,
    data: mjx.Data,
    camera: types.Camera,
    *,
    geoms: tuple[int, ...],
    window: tuple[int, int] = TILE,
    method: str = "auto",
) -> types.Views:
    """Draw `geoms` over a layer that the same cameras saw, the nearer surface winning, unbatched.

    `window` is the tile in pixels: it changes the speed, never the picture. The layer decides whether there is a
    segmentation. `method` is "tiles" (CPU), "full" (GPU) or "auto".
    """
    _check_camera(camera)
    shape = (camera.intrinsics.shape[0], camera.height, camera.width)
    if layer.depth.shape != shape:
        raise ValueError(f"the layer's depth has shape {layer.depth.shape}, the cameras need {shape}")
    groups = render_shapes.groups(model, geoms)
    if not groups:
        return layer.replace(camera=camera)
    draw = render_tiles.drawing(tuple(kind for kind, _ in groups), tuple(window), _pick_method(method))
    lens = jax.vmap(_lens)(camera)
    jobs = [jax.vmap(functools.partial(_jobs, model, data, kind, ids_), in_axes=(0,))(camera) for kind, ids_ in groups]
    image = {"depth": layer.depth, "rgb": layer.rgb}
    if layer.segmentation is not None:
        image["segmentation"] = layer.segmentation
    image = draw(image, lens, jobs)
    return types.Views(image["rgb"], image["depth"], camera, image.get("segmentation"))


def render_batch(
    model: mjx.Model, data: mjx.Data, camera: types.Camera, *, geoms: tuple[int, ...] | None = None, layer: Layer | None = None, **options
) -> types.Views:
    """Render B scenes, leaves of the views `[B, V, ...]`.

    Of `model`, `data`, `camera` and `layer` any leaf may have a leading B; those without are shared. Options are those of
    `render_over`, and `segmentation` where no layer is given.
    """
    fields = {
        "size": (model.geom_size, 2), "rgba": (model.geom_rgba, 2), "pos": (data.geom_xpos, 2), "mat": (data.geom_xmat, 3),
        "intrinsics": (camera.intrinsics, 3), "pose": (camera.world_from_cam, 3),
    }  # fmt: skip
    axes = {name: (0 if leaf.ndim == rank + 1 else None) for name, (leaf, rank) in fields.items()}
    layer_axes = None
    if layer is not None:
        lead = None if layer.depth.ndim == 3 else 0
        layer_camera = types.Camera(axes["intrinsics"], axes["pose"], camera.height, camera.width)
        layer_axes = jax.tree.map(lambda _: lead, layer).replace(camera=layer_camera)
        layer = layer.replace(camera=camera)

    def one(leaves, layer):
        model_ = model.replace(geom_size=leaves["size"], geom_rgba=leaves["rgba"])
        data_ = data.replace(geom_xpos=leaves["pos"], geom_xmat=leaves["mat"])
        camera_ = types.Camera(leaves["intrinsics"], leaves["pose"], camera.height, camera.width)
        return render(model_, data_, camera_, geoms=geoms, background=layer, **options)

    leaves = {name: leaf for name, (leaf, _) in fields.items()}
    return jax.vmap(one, in_axes=(axes, layer_axes))(leaves, layer)


def window_for(camera: types.Camera, radius: float, *, min_distance: float) -> tuple[int, int]:
    """Give the tile (rows, columns) that holds an object of `radius` metres seen from at least `min_distance` metres.

    One tile then covers the object wherever it stands off the image's edges; a smaller one only takes more tiles.
    """
    if not 0 < radius < min_distance:
        raise ValueError(f"window_for needs 0 < radius < min_distance, got radius={radius} and min_distance={min_distance}")
    intrinsics = np.asarray(camera.intrinsics).reshape(-1, 3, 3)
    slope = np.tan(np.arcsin(radius / min_distance))
    sizes = []
    for axis, limit in ((1, camera.height), (0, camera.width)):
        edge = np.maximum(intrinsics[:, axis, 2], limit - intrinsics[:, axis, 2]) / intrinsics[:, axis, axis]
        stretch = (1 + edge**2).max()  # a sphere's picture stretches towards the edge
        sizes.append(min(limit, 8 * math.ceil((2 * slope * intrinsics[:, axis, axis].max() * stretch + 2) / 8)))
    return sizes[0], sizes[1]


def check_views(views: types.Views, *, min_fraction: float = 0.01) -> None:
    """Raise ValueError, on the host, naming the first camera with a hit in less than `min_fraction` of its pixels or with a bad depth."""
    depth = np.asarray(views.depth)
    depth = depth.reshape(-1, *depth.shape[-3:])
    for index in range(depth.shape[1]):
        seen = depth[:, index]
        if not np.isfinite(seen).all() or (seen < 0).any():
            raise ValueError(f"camera {index} has depths that are negative or not finite: is its pose rigid and its focal length positive?")
        fraction = float((seen > 0).mean(axis=(1, 2)).min())
        if fraction < min_fraction:
            raise ValueError(f"camera {index} sees something in {fraction:.2%} of its pixels, not {min_fraction:.2%}: where does it look?")


def _check_camera(camera):
    if camera.intrinsics.ndim != 3 or camera.world_from_cam.shape != (camera.intrinsics.shape[0], 4, 4):
        shapes = camera.intrinsics.shape, camera.world_from_cam.shape
        raise ValueError(f"cameras need leaves [V, 3, 3] and [V, 4, 4], got {shapes[0]} and {shapes[1]}")


def _pick_method(method):
    if method not in METHODS:
        raise ValueError(f"unknown render method {method!r}; choose from {METHODS}")
    if method == "auto":
        return "tiles" if jax.default_backend() == "cpu" else "full"
    return method


def _lens(camera):
    k = camera.intrinsics
    return jnp.stack([1 / k[0, 0], 1 / k[1, 1], k[0, 2], k[1, 2]])


def _jobs(model, data, kind, ids, camera):
    """Prepare all geoms of one type for one camera: parameters, colour, id and the pixels they project to, leaves `[G, ...]`."""
    index = np.asarray(ids)
    one = functools.partial(_job, kind, camera)
    return jax.vmap(one)(
        model.geom_size[index], model.geom_rgba[index], data.geom_xpos[index], data.geom_xmat[index], jnp.asarray(index, jnp.int32)
    )


def _job(kind, camera, size, rgba, pos, mat, index):
    rotation, centre = camera.world_from_cam[:3, :3], camera.world_from_cam[:3, 3]
    dot = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)
    eye, light = dot(mat.T, centre - pos), dot(mat.T, jnp.asarray(scene.LIGHT_DIR, jnp.float32))
    geom = render_shapes.prepare(kind, size, eye, dot(mat.T, rotation), light)
    box = _pixels(render_shapes.extents(kind, size), dot(rotation.T, pos - centre), dot(rotation.T, mat), camera)
    box = jnp.where(rgba[3] > 0, box, 0)
    return {"geom": geom, "rgb": rgba[:3], "id": index, "box": box}


def _pixels(half, centre, cam_from_geom, camera):
    """Bound the pixels a box projects to: (first row, first column, last row + 1, last column + 1), clipped, empty if unseen."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T.astype(np.float32)
    corners = sum(signs[:, k, None] * jnp.where(jnp.isfinite(half[k]), half[k], 0.0) * cam_from_geom[None, :, k] for k in range(3))
    corners = corners + centre[None, :]
    near = 1e-3
    depth = corners[:, 2]
    k = camera.intrinsics
    u = k[0, 0] * corners[:, 0] / jnp.maximum(depth, near) + k[0, 2]
    v = k[1, 1] * corners[:, 1] / jnp.maximum(depth, near) + k[1, 2]
    margin = 0.51  # a pixel is hit at its centre; the rest is for rounding
    low = jnp.floor(jnp.stack([v.min(), u.min()]) - margin)
    high = jnp.ceil(jnp.stack([v.max(), u.max()]) + margin)
    limit = jnp.array([camera.height, camera.width], jnp.float32)
    unbounded = (depth.min() < near) | ~jnp.isfinite(half).all()
    low, high = jnp.where(unbounded, 0.0, low), jnp.where(unbounded, limit, high)
    behind = (depth.max() < near) & jnp.isfinite(half).all()
    low, high = jnp.clip(low, 0.0, limit), jnp.where(behind, 0.0, jnp.clip(high, 0.0, limit))
    return jnp.concatenate([low, high]).astype(jnp.int32)
