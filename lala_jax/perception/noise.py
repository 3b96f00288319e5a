"""What real cameras do wrong: noisy depth with holes, cameras that are not where they are thought to be. Pure; the key comes first."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lala_jax import types
from lala_jax.perception import camera as pinhole


def depth_noise(
    key: jax.Array,
    depth: Float[Array, "... height width"],
    *,
    sigma: float = 0.001,
    sigma_per_square: float = 0.002,
    disparity: float = 450.0 * 0.055,
    disparity_step: float = 1 / 32,
    edge_jump: float = 0.02,
    edge_dropout: float = 0.5,
    dropout: float = 0.001,
) -> Float[Array, "... height width"]:
    """Disturb a depth image in metres as a RealSense D415-like stereo camera would; holes (depth 0) stay holes.

    Gaussian noise along z of `sigma + sigma_per_square * z^2` metres (the shape of Nguyen, Izadi and Lovell, 3DIMPVT 2012,
    eq. 3), rounding of `disparity / z` (focal length in pixels times baseline in metres) to multiples of `disparity_step`
    pixels (0: off), holes with probability `edge_dropout` at pixels whose depth differs from a neighbour's by more than
    `edge_jump` metres, and with probability `dropout` anywhere. Independent over leading dimensions.
    """
    key_normal, key_edge, key_hole = jax.random.split(key, 3)
    hit = depth > 0
    safe = jnp.where(hit, depth, 1.0)
    noisy = safe + (sigma + sigma_per_square * safe * safe) * jax.random.normal(key_normal, depth.shape, depth.dtype)
    noisy = jnp.maximum(noisy, 1e-3)
    if disparity_step > 0:
        steps = jnp.maximum(jnp.round(disparity / (noisy * disparity_step)), 1.0)
        noisy = disparity / (steps * disparity_step)
    lost = edges(depth, jump=edge_jump) & jax.random.bernoulli(key_edge, edge_dropout, depth.shape)
    lost |= jax.random.bernoulli(key_hole, dropout, depth.shape)
    return jnp.where(hit & ~lost, noisy, 0.0)


def move_cameras(key: jax.Array, camera: types.Camera, *, shift: float, turn: float) -> types.Camera:
    """Move each camera (leaves `[V, ...]`) by up to `shift` metres and turn it about itself by up to `turn` radians.

    Directions and axes are uniform, lengths and angles uniform from zero; one draw a camera.
    """
    key_shift, key_axis, key_length = jax.random.split(key, 3)
    count = camera.world_from_cam.shape[0]
    length = jax.random.uniform(key_length, (2, count, 1))
    step = _directions(key_shift, count) * length[0] * shift
    half = length[1] * turn / 2
    quat = jnp.concatenate([jnp.cos(half), jnp.sin(half) * _directions(key_axis, count)], axis=-1)
    return pinhole.moved(camera, step, quat)


def _directions(key, count):
    vectors = jax.random.normal(key, (count, 3))
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def edges(depth: Float[Array, "... height width"], *, jump: float) -> Bool[Array, "... height width"]:
    """Mark the pixels `[..., H, W]` whose depth differs from one of the four neighbours' by more than `jump` metres."""
    far = jnp.zeros(depth.shape, bool)
    down = jnp.abs(jnp.diff(depth, axis=-2)) > jump
    right = jnp.abs(jnp.diff(depth, axis=-1)) > jump
    far = far.at[..., 1:, :].max(down).at[..., :-1, :].max(down)
    return far.at[..., :, 1:].max(right).at[..., :, :-1].max(right)
