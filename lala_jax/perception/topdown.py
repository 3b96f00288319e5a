"""Points with features to the top-down map of height slices, and what can be read off it. Pure and unbatched."""

from __future__ import annotations

import operator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lala_jax import types
from lala_jax.perception import batches, image
from lala_jax.perception import camera as cameras

SKIN = 0.005  # metres under a cell's highest point that still count as its top face


def fuse(
    points: Float[Array, "p 3"],
    features: Float[Array, "p f"],
    valid: Bool[Array, " p"],
    *,
    spec: types.MapSpec,
    floor_margin: float = 0.01,
    surface_margin: float = 0.001,
    skin: float = SKIN,
) -> types.TopDownMap:
    """Average the features and the place of the points in each voxel, and keep each cell's highest point.

    The mean place within the cell (as in PointPillars, CVPR 2019) says where an edge runs to a fraction of a cell; that of the
    points within `skin` metres of the cell's highest one does so for a top face, without the points of the side under it.

    Points outside the map, at or above `z_max`, or more than `floor_margin` metres below `z_min` are dropped; those within
    `floor_margin` below count as the floor (slice 0, height 0). `surface_margin` metres are taken off z before slicing:
    the face of a thing that ends where a slice ends (a 4 cm block, 2 cm slices) then lies wholly in the slice under it,
    where rounding would deal its points to two slices. Heights are not touched by it.
    The result does not depend on the order of points, up to float32 rounding of the sums.
    """
    return _fuse(_in_cells(spec, points), features, valid, spec, skin, floor_margin, surface_margin)


def _fuse(at, features, valid, spec, skin, *margins):
    """Fuse points whose places are given by `_in_cells`.

    The features are added as they are, and the places apart from them: to write both side by side first costs more than all additions.
    """
    cells, shape = spec.rows * spec.cols, (spec.rows, spec.cols, spec.slices)
    voxel, cell, within = _locate(at, valid, spec, *margins)
    place = jnp.concatenate([within, jnp.ones_like(within[:, :1])], axis=-1)
    total = jnp.zeros((cells * spec.slices, features.shape[1])).at[voxel].add(features.astype(jnp.float32), **_DROP)
    placed = jnp.zeros((cells * spec.slices, 3)).at[voxel].add(place, **_DROP)
    top = jnp.zeros(cells, at.dtype).at[cell].max(at[:, 2], **_DROP)
    high = jnp.where(at[:, 2] > top.at[cell].get(mode="fill", fill_value=jnp.inf) - skin, cell, cells)
    face = jnp.zeros((cells, 3)).at[high].add(place, **_DROP)
    points = jnp.maximum(placed[:, 2:], 1)
    return types.TopDownMap(
        features=(total / points).reshape(*shape, -1),
        count=placed[:, 2].reshape(shape),
        offset=(placed[:, :2] / points).reshape(*shape, 2),
        height=top.reshape(shape[:2]),
        skin=(face[:, :2] / jnp.maximum(face[:, 2:], 1)).reshape(*shape[:2], 2),
    )


# Dropping by an index past the end costs nothing, where a spare row would collect three quarters of all writes.
_DROP = {"mode": "drop", "wrap_negative_indices": False}


def _in_cells(spec, points):
    """Give points `[..., 3]` as continuous `(row, col)` and metres above the map's floor.

    As one array, which XLA stores on a CPU; of three it would compute each again wherever it is read.
    """
    return jnp.concatenate([types.cell_from_world(spec, points[..., :2]), points[..., 2:] - spec.z[0]], axis=-1)


def _locate(at, valid, spec, floor_margin, surface_margin):
    """Give each point's flat voxel index, flat cell index (both past the end if the point is dropped) and place within the cell."""
    low = jnp.floor(at[:, :2])
    row, col, height = low[:, 0].astype(jnp.int32), low[:, 1].astype(jnp.int32), at[:, 2]
    keep = valid & (row >= 0) & (row < spec.rows) & (col >= 0) & (col < spec.cols)
    keep &= (height >= -floor_margin) & (height < spec.z[1] - spec.z[0])
    layer = jnp.clip(jnp.floor((height - surface_margin) / spec.slice_height).astype(jnp.int32), 0, spec.slices - 1)
    voxel = jnp.where(keep, (row * spec.cols + col) * spec.slices + layer, spec.rows * spec.cols * spec.slices)
    return voxel, voxel // spec.slices, at[:, :2] - low - 0.5


def from_views(
    views: types.Views,
    *,
    spec: types.MapSpec,
    features: Float[Array, "v height width f"] | None = None,
    floor_margin: float = 0.01,
    surface_margin: float = 0.001,
) -> types.TopDownMap:
    """Fuse any number of views of one scene; the map's features are the colour, then the extra per-pixel `features` if given.

    `views.rgb` is `[V, H, W, 3]` in 0..1 and `views.depth` `[V, H, W]` in metres along the camera's z, 0 where nothing was measured; the
    cameras' poses are in the frame of the map: the robot's base, x forward, z up, the table at z = 0. The margins are those of `fuse`.
    Raises ValueError for whole numbers and for shapes that do not fit. Of wrong units, inverted poses or OpenGL's camera axes it knows
    nothing: the map is then empty (`count` is 0), or wrong.
    """
    cameras.check_floating("views.rgb", views.rgb, "in 0..1")
    cameras.check_floating("views.depth", views.depth, "metres")
    _check_shapes(views)
    at = _in_cells(spec, jax.vmap(cameras.unproject)(views.depth, views.camera))
    values = views.rgb if features is None else jnp.concatenate([views.rgb, features], axis=-1)
    values, valid = values.reshape(-1, values.shape[-1]), (views.depth > 0).reshape(-1)
    return _fuse(at.reshape(-1, 3), values, valid, spec, SKIN, floor_margin, surface_margin)


def _check_shapes(views: types.Views) -> None:
    """Raise ValueError, naming the field, where the leaves of V views do not fit each other."""
    count, camera = len(views.depth), views.camera
    shapes = {"depth": (count, camera.height, camera.width), "rgb": (count, camera.height, camera.width, 3)}
    shapes |= {"camera.intrinsics": (count, 3, 3), "camera.world_from_cam": (count, 4, 4)}
    for name, shape in shapes.items():
        if (found := np.shape(operator.attrgetter(name)(views))) != shape:
            raise ValueError(f"views.{name} must be {list(shape)} for {count} views of the camera's size, got {list(found)}")


def from_views_batch(
    views: types.Views,
    *,
    spec: types.MapSpec,
    features: Float[Array, "b v height width f"] | None = None,
    method: str = "auto",
    **margins: float,
) -> types.TopDownMap:
    """Fuse the views of B scenes (leaves `[B, V, ...]`); the margins are those of `fuse`.

    `method` is that of `batches.each`: on a CPU a batched scatter costs four times the loop.
    """

    def one(example):
        return from_views(example[0], spec=spec, features=example[1], **margins)

    return batches.each(one, (views, features), method=method)


def surface_features(
    views: types.Views,
    features: Float[Array, "v h w c"],
    *,
    spec: types.MapSpec,
    floor_margin: float = 0.01,
    surface_margin: float = 0.001,
) -> Float[Array, "rows cols c"]:
    """Fuse per-view feature maps of any resolution into one map of the surface: LALA's feature fusion (section IV, figure 2).

    Each view gives a cell the feature, read bilinearly, of the highest point that it saw there; a cell's value is the mean over the
    views that saw it, 0 where none did. Which points count is as in `fuse`. The order of the views does not matter. Features at `1 / s`
    of the image's sides are taken to be centred on every `s`-th pixel from the first, as strided convolutions leave them.
    """
    scale = np.array([features.shape[1] / views.depth.shape[1], features.shape[2] / views.depth.shape[2]], np.float32)
    most = np.array(features.shape[1:3], np.float32) - 0.5  # past the outermost centres the outermost values hold

    def one(view):
        depth, camera, grid = view
        at = _in_cells(spec, cameras.unproject(depth, camera)).reshape(-1, 3)
        height = at[:, 2]
        _, cell, _ = _locate(at, (depth > 0).ravel(), spec, floor_margin, surface_margin)
        top = jnp.full(spec.rows * spec.cols, -jnp.inf).at[cell].max(height, **_DROP)
        highest = height >= top.at[cell].get(mode="fill", fill_value=jnp.inf)
        pixel = jnp.full(spec.rows * spec.cols, -1).at[jnp.where(highest, cell, spec.rows * spec.cols)].max(jnp.arange(len(cell)), **_DROP)
        at = jnp.stack([pixel // depth.shape[1], pixel % depth.shape[1]], axis=-1) * scale + 0.5
        seen = (pixel >= 0)[:, None]
        return jnp.where(seen, image.sample(grid, jnp.clip(at, 0.5, most)), 0.0), seen

    value, seen = batches.each(one, (views.depth, views.camera, features))
    return (value.sum(0) / jnp.maximum(seen.sum(0), 1)).reshape(spec.rows, spec.cols, -1)


def max_height(topdown: types.TopDownMap) -> Float[Array, "rows cols channels"]:
    """Give what is seen from above, `[rows, cols, C + 1]`: each cell's features in its highest seen slice, then its height in metres.

    Features of the surface, where the map has them, come between the two.
    """
    more = [] if topdown.surface is None else [topdown.surface]
    return jnp.concatenate([highest(topdown.features, topdown.count > 0), *more, topdown.height[..., None]], axis=-1)


def keep_highest(topdown: types.TopDownMap) -> types.TopDownMap:
    """Forget all but each column's highest voxel: what a max-height map knows."""
    seen = topdown.count > 0
    keep = seen & (jnp.cumsum(seen[..., ::-1], axis=-1)[..., ::-1] == 1)
    return topdown.replace(
        features=jnp.where(keep[..., None], topdown.features, 0.0),
        count=jnp.where(keep, topdown.count, 0.0),
        offset=jnp.where(keep[..., None], topdown.offset, 0.0),
    )


def half_turn(topdown: types.TopDownMap) -> types.TopDownMap:
    """Turn a map by 180 degrees about its middle."""
    turned = jax.tree.map(lambda leaf: leaf[::-1, ::-1], topdown)
    return turned.replace(offset=-turned.offset, skin=-turned.skin)


def highest(values: Float[Array, "rows cols slices c"], seen: Bool[Array, "rows cols slices"]) -> Float[Array, "rows cols c"]:
    """Take each column's value in its highest occupied slice."""
    top = seen.shape[-1] - 1 - jnp.argmax(seen[..., ::-1], axis=-1)
    return jnp.take_along_axis(values, top[..., None, None], axis=2)[:, :, 0]
