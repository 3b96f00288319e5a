"""Augmentation: of the scene before pixels exist, exact and true to the labels; and of what the cameras report. Unbatched; `key` first."""

from __future__ import annotations

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp

from lala_jax import types
from lala_jax.perception import batches, noise, transforms

CANDIDATES = 64  # colours drawn uniformly, out of which those of the objects are chosen


@dataclasses.dataclass(frozen=True)
class Sensors:
    """How the cameras of a training example err; static."""

    depth_noise: float = 0.0  # probability that all images have the noise of `perception.noise.depth_noise`
    shift: float = 0.0  # metres a camera is off where it is thought to be, at most
    turn: float = 0.0  # degrees a camera is turned off, at most
    missing: float = 0.0  # probability that one camera sees nothing

    def __bool__(self):
        return any(dataclasses.astuple(self))


def sensors(key: jax.Array, key_noise: jax.Array, views: types.Views, errors: Sensors, *, disparity: float) -> types.Views:
    """Let the cameras of one scene (leaves `[V, ...]`) err.

    `key` decides where they are thought to be and which one is missing, the same for all pictures of an episode; `key_noise` the
    noise of this one. The pictures are those of the cameras where they are: it is the poses they are unprojected from that change.
    """
    key_move, key_missing, key_which, key_coin = jax.random.split(key, 4)
    depth = views.depth
    if errors.depth_noise:
        disturb = functools.partial(noise.depth_noise, key_noise, depth, disparity=disparity)
        depth = jax.lax.cond(jax.random.bernoulli(key_coin, errors.depth_noise), disturb, lambda: depth)
    if errors.missing:
        which = jax.random.randint(key_which, (), 0, depth.shape[0])
        lost = (jnp.arange(depth.shape[0]) == which) & jax.random.bernoulli(key_missing, errors.missing)
        depth = jnp.where(lost[:, None, None], 0.0, depth)
    believed = noise.move_cameras(key_move, views.camera, shift=errors.shift, turn=math.radians(errors.turn))
    return views.replace(depth=depth, camera=believed)


def sensors_batch(key: jax.Array, key_noise: jax.Array, views: types.Views, errors: Sensors, *, disparity: float) -> types.Views:
    """Let the cameras of B scenes (leaves `[B, V, ...]`, keys `[B]`) err, as `sensors` says.

    On a CPU noise that is not wanted is not drawn (`batches.each`).
    """

    def one(scene):
        key, key_noise, views = scene
        return sensors(key, key_noise, views, errors, disparity=disparity)

    scenes = (key, key_noise, views.replace(rgb=None))  # which would be copied for nothing
    return batches.each(one, scenes).replace(rgb=views.rgb)


def recolor(
    key: jax.Array,
    state: types.State,
    *,
    palette: jax.Array,
    apart: float,
    jitter: float = 0.04,
    mix: float = 0.5,
) -> types.State:
    """Give the objects new colours, the same in scene and goal since both are drawn from `state.color`.

    Colours are drawn from `palette` `[P, 3]` without replacement (P >= N); with probability `mix` uniformly in RGB instead, each
    `apart` from the others; every colour gets normal noise of `jitter`.
    """
    count = state.color.shape[0]
    if count > palette.shape[0]:
        raise ValueError(f"{count} objects cannot be recoloured from a palette of {palette.shape[0]} colours")
    key_order, key_any, key_jitter, key_coin = jax.random.split(key, 4)
    known = jax.random.permutation(key_order, palette)[:count]
    unseen = spread(jax.random.uniform(key_any, (CANDIDATES, 3)), count, apart=apart)
    color = jnp.where(jax.random.bernoulli(key_coin, mix), unseen, known)
    color += jitter * jax.random.normal(key_jitter, color.shape)
    return state.replace(color=jnp.clip(color, 0.0, 1.0))


def spread(points: jax.Array, count: int, *, apart: float | jax.Array) -> jax.Array:
    """Choose `count` of `points` `[P, C]` one after another: the first that is `apart` from all chosen, or the farthest if none is."""

    def choose(nearest, _):
        far = nearest >= apart
        index = jnp.where(far.any(), far.argmax(), nearest.argmax())
        return jnp.minimum(nearest, jnp.linalg.norm(points - points[index], axis=-1)), points[index]

    return jax.lax.scan(choose, jnp.full(len(points), jnp.inf), length=count)[1]


def rigid(key: jax.Array, state: types.State, *, spec: types.MapSpec, base_radius: float, tries: int = 16) -> types.State:
    """Turn and shift scene and goal together about the workspace centre.

    Rotation N(0, 60 deg) and translation N(0, 1/6 of the map), as in Ravens, redrawn up to `tries` times until every object, now and
    at its goal, and the base (a circle of `base_radius` metres) stay on the map; unchanged where no draw does.
    """
    turn, shift = jax.random.split(key)
    yaws = jnp.append(jax.random.normal(turn, (tries,)) * math.radians(60.0), 0.0)
    low = jnp.array([spec.x[0], spec.y[0]])
    high = jnp.array([spec.x[1], spec.y[1]])
    shifts = jnp.concatenate([jax.random.normal(shift, (tries, 2)) * (high - low) / 6, jnp.zeros((1, 2))])
    centre = (low + high) / 2
    radius = jnp.linalg.norm(state.size[:, :2], axis=-1) / 2
    points = jnp.concatenate([state.poses[:, :2], state.goal[:, :2], state.base[None, :2]])
    reach = jnp.concatenate([radius, radius, jnp.array([base_radius])])[:, None]

    motions = transforms.se2_about(centre, yaws, shifts)

    def fits(motion):
        moved = transforms.apply_se2(motion, points)
        return ((moved - reach >= low) & (moved + reach <= high)).all()

    good = jax.vmap(fits)(motions).at[-1].set(True)
    world_from_old = transforms.pose_from_se2(motions[jnp.argmax(good)])

    def move(poses):
        return transforms.pose_multiply(world_from_old, poses)

    return state.replace(poses=move(state.poses), goal=move(state.goal), base=move(state.base))
