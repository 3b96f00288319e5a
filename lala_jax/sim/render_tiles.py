"""Draw prepared geoms into images: tile by tile on a CPU, every pixel at once on a GPU.

An image is a dict of `depth` `[N, H, W]` (0 where nothing was hit) and, each optional, `rgb` `[N, H, W, 3]` and
`segmentation` `[N, H, W]`. The jobs are a list, one entry a geom type, of dicts with leaves `[N, G, ...]`: what
`render_shapes.prepare` gives under `geom`, `rgb`, `id`, and the pixels `box` that the geom may touch.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from lala_jax.sim import render_shapes, scene

CHUNK = 64  # tiles that are cast at once
SAME = 2e-5  # relative: depths of one surface in the two passes differ by rounding only


@functools.lru_cache
def drawing(kinds, tile, method):
    """Build the function that draws jobs into images, with leading axis N on all; vmap adds its axis to N instead of the loop's body."""
    body = functools.partial(_draw_tiles if method == "tiles" else _draw_full, kinds, tile)

    @jax.custom_batching.custom_vmap
    def draw(image, lens, jobs):
        return body(image, lens, jobs)

    @draw.def_vmap
    def rule(size, batched, *args):
        flat = jax.tree.map(lambda leaf, has: leaf if has else jnp.broadcast_to(leaf, (size, *leaf.shape)), args, tuple(batched))
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), flat)
        out = draw(*flat)
        out = jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    return draw


def _draw_full(kinds, _, image, lens, jobs):
    return jax.vmap(functools.partial(_draw_image, kinds))(image, lens, jobs)


def _draw_image(kinds, image, lens, jobs):
    """Cast every geom on every pixel of one image: elementwise all through, one kernel on a GPU."""
    height, width = image["depth"].shape
    x, y = _rays(lens, 0, 0, (height, width))
    depth = jnp.where(image["depth"] > 0, image["depth"], jnp.inf)
    paint = {name: leaf for name, leaf in image.items() if name != "depth"}
    for kind, group in zip(kinds, jobs, strict=True):
        step = functools.partial(_draw_geom, kind, x, y)
        count = group["id"].shape[0]  # boxes are what moves: one kernel for all of them
        (depth, paint), _ = jax.lax.scan(step, (depth, paint), group, unroll=count if kind == render_shapes.BOX else 1)
    return {"depth": jnp.where(jnp.isfinite(depth), depth, 0.0), **paint}


def _draw_geom(kind, x, y, carry, job):
    depth, paint = carry
    new, cosine = render_shapes.cast(kind, job["geom"], x, y)
    wins = (new < depth) & (job["box"][2:] > job["box"][:2]).all()
    paint = {name: _paint(name, wins, _shade(cosine), job["rgb"], job["id"], leaf) for name, leaf in paint.items()}
    return (jnp.where(wins, new, depth), paint), None


def _rays(lens, top, left, shape):
    x = (jnp.arange(shape[1]) + left + 0.5 - lens[2]) * lens[0]
    y = (jnp.arange(shape[0]) + top + 0.5 - lens[3]) * lens[1]
    return x, y


def _shade(cosine):
    return scene.AMBIENT + scene.DIFFUSE * cosine


def _paint(name, wins, shade, rgb, index, old):
    if name == "segmentation":
        return jnp.where(wins, index, old)
    return jnp.where(wins[..., None], shade[..., None] * rgb, old)


def _draw_tiles(kinds, tile, image, lens, jobs):
    """Cast every geom on the tiles it projects to: first the depths, then the paint wherever a geom's depth is the final one.

    Two passes because XLA updates a buffer in place only while no other update in the loop's body reads it. Tiles are cast CHUNK at a time,
    which vectorises and takes all cores, and put one by one.
    """
    image = dict(image)
    tile = tuple(min(side, limit) for side, limit in zip(tile, image["depth"].shape[1:], strict=True))
    tables = [_table(kind, tile, lens, group) for kind, group in zip(kinds, jobs, strict=True)]
    depth = {"depth": image.pop("depth")}
    for table in tables:
        depth = _over_tiles(table, tile, depth, _nearer)
    for table in tables:
        image = _over_tiles(table, tile, image, functools.partial(_paint_visible, depth["depth"]))
    return depth | image


def _table(kind, tile, lens, group):
    """Flatten the jobs of one type, all images together, to one row of numbers and one of integers a job."""
    count, geoms = group["id"].shape
    lenses = jnp.broadcast_to(lens[:, None], (count, geoms, 4))
    flat = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), (group["geom"], group["rgb"], lenses))
    _, restore = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], flat))
    numbers = jax.vmap(lambda job: ravel_pytree(job)[0])(flat)
    top, left, bottom, right = jnp.moveaxis(group["box"].reshape(-1, 4), -1, 0)
    across, down = (right - left + tile[1] - 1) // tile[1], (bottom - top + tile[0] - 1) // tile[0]
    images = jnp.repeat(jnp.arange(count), geoms)
    last = jnp.cumsum(jnp.maximum(across, 0) * jnp.maximum(down, 0))  # number of the tile after a job's last
    integers = [images, group["id"].reshape(-1), top, left, jnp.maximum(across, 1), last]
    return kind, restore, numbers, jnp.stack([leaf.astype(jnp.int32) for leaf in integers], axis=1)


def _nearer(start, cast, old):
    del start
    new = cast["depth"]
    return {"depth": jnp.where((new < old["depth"]) | ((old["depth"] == 0) & jnp.isfinite(new)), new, old["depth"])}


def _paint_visible(final, start, cast, old):
    wins = cast["depth"] <= jax.lax.dynamic_slice(final, start, (1, *cast["depth"].shape))[0] * (1 + SAME)
    return {name: _paint(name, wins, cast["shade"], cast["rgb"], cast["id"], leaf) for name, leaf in old.items()}


def _over_tiles(table, tile, buffers, update):
    """Update a dict of images in place, tile by tile, geom by geom."""
    kind, restore, numbers, integers = table
    if not buffers:
        return buffers
    height, width = next(iter(buffers.values())).shape[1:3]
    last = integers[:, 5]

    def cast_tile(number):
        """Cast the tile of this number among all jobs' tiles; it hits nothing where there are not so many."""
        job = jnp.minimum((last <= number).sum(), len(last) - 1)
        (geom, rgb, lens), (image, index, top, left, across, end) = restore(numbers[job]), integers[job]
        at = number - jnp.where(job > 0, last[job - 1], 0)
        down = jnp.minimum(top + at // across * tile[0], height - tile[0])
        right = jnp.minimum(left + at % across * tile[1], width - tile[1])
        depth, cosine = render_shapes.cast(kind, geom, *_rays(lens, down, right, tile))
        start = jnp.where(number < end, jnp.stack([image, down, right]), 0)
        return {"depth": jnp.where(number < end, depth, jnp.inf), "shade": _shade(cosine), "rgb": rgb, "id": index, "start": start}

    def draw_chunk(chunk, buffers):
        cast = jax.vmap(cast_tile)(chunk * CHUNK + jnp.arange(CHUNK))

        def put(number, buffers):
            one = {name: leaf[number] for name, leaf in cast.items()}
            start = tuple(one["start"])
            starts = {name: start + (0,) * (leaf.ndim - 3) for name, leaf in buffers.items()}
            old = {name: jax.lax.dynamic_slice(leaf, starts[name], (1, *tile, *leaf.shape[3:]))[0] for name, leaf in buffers.items()}
            new = update(start, one, old)
            return {name: jax.lax.dynamic_update_slice(leaf, new[name][None], starts[name]) for name, leaf in buffers.items()}

        return jax.lax.fori_loop(0, jnp.minimum(CHUNK, last[-1] - chunk * CHUNK), put, buffers)

    return jax.lax.fori_loop(0, (last[-1] + CHUNK - 1) // CHUNK, draw_chunk, buffers)
