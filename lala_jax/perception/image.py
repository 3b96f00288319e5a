"""Resampling of maps and images: bilinear reads and rotated crops. Pure and unbatched."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from lala_jax.perception import transforms


def sample(image: Float[Array, "rows cols c"], at: Float[Array, "... 2"]) -> Float[Array, "... c"]:
    """Read an image bilinearly at continuous `(row, col)` `[..., 2]` (the centre of `[i, j]` is `(i + 0.5, j + 0.5)`), zero outside.

    What is read has the image's type; sums are at least float32.
    """
    rows, cols, channels = image.shape
    low = jnp.floor(at - 0.5)
    frac = at - 0.5 - low
    row, col = low[..., 0].astype(jnp.int32), low[..., 1].astype(jnp.int32)
    flat = image.reshape(rows * cols, channels)
    wide = jnp.promote_types(image.dtype, jnp.float32)
    out = jnp.zeros(at.shape[:-1] + (channels,), wide)
    for down in (0, 1):
        for right in (0, 1):
            i, j = row + down, col + right
            weight = jnp.abs(1 - down - frac[..., 0]) * jnp.abs(1 - right - frac[..., 1])
            inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
            weight = jnp.where(inside, weight, 0.0).astype(wide)
            index = jnp.clip(i, 0, rows - 1) * cols + jnp.clip(j, 0, cols - 1)
            out += flat.at[index].get(mode="promise_in_bounds") * weight[..., None]
    return out.astype(image.dtype)


def rotation_offsets(yaw, size: int):
    """Give `[..., size, size, 2]` offsets `(row, col)` in cells at which a crop turned by each `yaw` `[...]` reads, relative to its centre.

    The crop shows the content turned by `yaw` radians about world z (row runs along +y, col along +x), so it reads at the
    inverse turn of its own offset; the turning point is the centre of crop cell `[size // 2, size // 2]`. NumPy in, NumPy out.
    """
    xp, yaw = transforms.to_arrays(yaw)
    y, x = np.meshgrid(np.arange(size) - size // 2, np.arange(size) - size // 2, indexing="ij")
    cos, sin = xp.cos(yaw)[..., None, None], xp.sin(yaw)[..., None, None]
    return xp.stack([cos * y - sin * x, cos * x + sin * y], axis=-1)


def whole_turn_offsets(yaw_bins: int, size: int) -> Float[Array, "k size size 2"]:
    """Give the `rotation_offsets` of `k = yaw_bins` crops, crop `b` turned by `+2 pi b / k`."""
    return jnp.asarray(rotation_offsets(2 * math.pi / yaw_bins * np.arange(yaw_bins), size), jnp.float32)


def turned_crop(
    image: Float[Array, "rows cols c"], center: Num[Array | np.ndarray, " 2"] | Sequence, yaw: Float[Array, ""], size: int
) -> Float[Array, "size size c"]:
    """Give one crop of `rotate_crop`, for any `yaw` in radians."""
    return sample(image, rotation_offsets(yaw, size) + jnp.asarray(center, jnp.float32))


def rotate_crop(
    image: Float[Array, "rows cols c"], center: Num[Array | np.ndarray, " 2"] | Sequence, yaw_bins: int, size: int
) -> Float[Array, "k size size c"]:
    """Give `k = yaw_bins` crops `[k, size, size, C]` of an image about a continuous `(row, col)`, crop `b` turned by `+2 pi b / k`.

    Crop `b` is what the picture of an object held at `center` looks like after a right-handed turn of `2 pi b / k` about world z.
    The centre lands on the centre of crop cell `[size // 2, size // 2]`: give `(i + 0.5, j + 0.5)` to turn about
    cell `[i, j]`. Bilinear, zero outside the image. Reads all crops at once: of the default agent's few channels that is a tenth of a
    training step faster on a CPU than one after the other, which `transporter.pick_crops` is for.
    """
    offsets = whole_turn_offsets(yaw_bins, size)
    center = jnp.broadcast_to(jnp.asarray(center, jnp.float32), offsets.shape)
    return sample(image, center + offsets)
