"""Augmentation in the scene, before pixels exist: exact, and true to the labels. Unbatched; `key` first."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from lala_jax import types
from lala_jax.perception import transforms


def recolor(key: jax.Array, state: types.State, *, palette: jax.Array, jitter: float = 0.04, mix: float = 0.5) -> types.State:
    """Give the objects new colours, the same in scene and goal since both are drawn from `state.color`.

    Colours are drawn from `palette` `[P, 3]` without replacement (P >= N); with probability `mix` the palette is first mirrored and
    permuted over its channels (hues unseen in the palette, distances kept); every colour gets normal noise of `jitter`.
    """
    order, permute, flip, noise, coin = jax.random.split(key, 5)
    channels = jax.random.permutation(permute, 3)
    other = jnp.take(palette, channels, axis=1)
    low, high = other.min(), other.max()
    other = jnp.where(jax.random.bernoulli(flip, 0.5, (3,)), low + high - other, other)
    palette = jnp.where(jax.random.bernoulli(coin, mix), other, palette)
    chosen = jax.random.permutation(order, palette.shape[0])[: state.color.shape[0]]
    color = palette[chosen] + jitter * jax.random.normal(noise, state.color.shape)
    return state.replace(color=jnp.clip(color, 0.0, 1.0))


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
