"""Convolutions, for `flax.linen.Conv(conv_general_dilated=...)`, and what follows them, written as what a machine does faster.

The numbers are the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp


def blocked(lhs: jax.Array, rhs: jax.Array, window_strides: Sequence[int], padding: str, **kwargs: Any) -> jax.Array:
    """Take a strided convolution as an unstrided one over blocks of cells.

    Maps `lhs` `[B, H, W, C]` and `rhs` `[kh, kw, C, O]` to `[B, H / sh, W / sw, O]`. Every block of the strides' size becomes one cell
    with its inputs as channels (space to depth), and the kernel, filled up with zeros to whole blocks, goes over these. That is up to 44%
    more work forward (5x5 with stride 2), and backward it spares XLA's convolution with a dilated input, several times slower on a CPU.

    Raises ValueError unless the padding is "SAME", the strides divide the sides and nothing is dilated or grouped.
    """
    batch, *sides, channels = lhs.shape
    kwargs, odd = _plain(kwargs)
    if padding != "SAME" or odd:
        raise ValueError(f"needs padding SAME without dilation or groups, got padding {padding!r} and {odd or 'neither'}")
    if any(side % step for side, step in zip(sides, window_strides, strict=True)):
        raise ValueError(f"strides {tuple(window_strides)} must divide the sides {tuple(sides)}")
    pads, room, blocks = [], [], []
    for size, step in zip(rhs.shape[:2], window_strides, strict=True):
        low = max(size - step, 0) // 2  # cells before the first output's block that its window covers
        before = -(-low // step)
        front = before * step - low
        count = -(-(front + size) // step)
        blocks.append(count)
        room.append((front, count * step - front - size))
        pads.append((before, count - 1 - before))
    (rows, cols), (down, right) = sides, window_strides
    kernel = jnp.pad(rhs, (*room, (0, 0), (0, 0))).reshape(blocks[0], down, blocks[1], right, channels, -1)
    kernel = kernel.transpose(0, 2, 1, 3, 4, 5).reshape(*blocks, down * right * channels, -1)
    cells = lhs.reshape(batch, rows // down, down, cols // right, right, channels).transpose(0, 1, 3, 2, 4, 5)
    cells = cells.reshape(batch, rows // down, cols // right, -1)
    return jax.lax.conv_general_dilated(cells, kernel, (1, 1), pads, **kwargs)


def product_gradient(
    lhs: jax.Array, rhs: jax.Array, window_strides: Sequence[int], padding: Sequence[tuple[int, int]], **kwargs: Any
) -> jax.Array:
    """Take a convolution with its kernel's gradient as one matrix product: one of many channels into few, or of 1x1.

    Maps `lhs` `[B, H, W, C]` and `rhs` `[kh, kw, C, O]` to `[B, H', W', O]`. XLA's gradient is a convolution over `lhs` with channels in
    the place of the batch, and a CPU brings `lhs` into that order first, entry by entry, with whatever made it. The product reads it as it
    lies, and for each entry of the kernel the slope: `kh kw O` values a cell, so `C` should not be much smaller than that. It is taken
    before the gradient of `lhs`, which is not finite where the kernel's is not.

    Raises ValueError for dilation or groups, and for strides unless the kernel is 1x1 and nothing is padded. There is no derivative in
    forward mode.
    """
    kwargs, odd = _plain(kwargs)
    (down, right, *_), strides = rhs.shape, tuple(window_strides)
    if odd or (strides != (1, 1) and (down, right, *padding) != (1, 1, (0, 0), (0, 0))):
        raise ValueError(f"needs strides of 1, or a 1x1 kernel without padding, and no dilation or groups, got {odd or strides}")

    def plain(lhs: jax.Array, rhs: jax.Array) -> jax.Array:
        return jax.lax.conv_general_dilated(lhs, rhs, strides, padding, **kwargs)

    def backward(kept: tuple[jax.Array, jax.Array], slope: jax.Array) -> tuple[jax.Array, jax.Array]:
        lhs, rhs = kept
        read = lhs[:, :: strides[0], :: strides[1]]
        _, rows, cols, _ = read.shape
        room = [(size - 1 - low, size - 1 - high, 0) for size, (low, high) in zip((down, right), padding, strict=True)]
        wide = jax.lax.pad(slope, jnp.zeros((), slope.dtype), [(0, 0, 0), *room, (0, 0, 0)])
        moved = [wide[:, i : i + rows, j : j + cols] for i in reversed(range(down)) for j in reversed(range(right))]
        product = jnp.einsum("bhwc,bhwo->co", read, jnp.concatenate(moved, -1), precision=kwargs.get("precision"))
        kernel = product.reshape(rhs.shape[2], down, right, -1).transpose(1, 2, 0, 3)
        waiting = rhs + 0 * kernel  # XLA would put the kernel's gradient off, and keep what it needs of every layer until the end
        return jax.vjp(lambda lhs: plain(lhs, waiting), lhs)[1](slope)[0], kernel

    convolve = jax.custom_vjp(plain)
    convolve.defvjp(lambda lhs, rhs: (plain(lhs, rhs), (lhs, rhs)), backward)
    return convolve(lhs, rhs)


@jax.custom_jvp
def relu(x: jax.Array) -> jax.Array:
    """Take the larger of every entry and 0, as `flax.linen.relu`, whose derivative looks at `x`, while this one looks at the result.

    The layer after needs the result anyway, and then nothing needs `x`: on a GPU, XLA keeps one array instead of two and lets one kernel
    of cuDNN take the convolution before, its bias, what is added to it and this.
    """
    return jnp.maximum(x, 0)


@relu.defjvp
def _relu_jvp(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
    y = relu(*primals)
    # Not y > 0: XLA knows that for x > 0.
    return y, jax.lax.select(y != 0, *tangents, jnp.zeros_like(*tangents))


def _plain(kwargs: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Give a convolution's arguments without those of dilation and groups, and what these ask for, "" for neither."""
    rest = dict(kwargs)
    odd = [name for name in ("lhs_dilation", "rhs_dilation") if any(step != 1 for step in rest.pop(name, None) or ())]
    if (groups := rest.pop("feature_group_count", 1)) != 1:
        odd.append(f"{groups} groups")
    return rest, ", ".join(odd)
