"""The residual hourglass of Transporter Networks and CLIPort, at the paper's width or a smaller one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from lala_jax.models import convolution

MIN_HEAD = 4  # channels: with fewer, narrow networks start with all of them below zero too often


class ResidualBlock(nn.Module):
    """Add a 1x1 - 3x3 - 1x1 branch to the input, or to its strided 1x1 projection where `project` is set.

    Nothing normalises and nothing has a bias. The stride is taken by the 3x3, as in CLIPort.
    """

    mid: int  # channels of the first two convolutions
    out: int  # channels of the last
    stride: int = 1
    project: bool = False
    last_relu: bool = True
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map `[..., H, W, C]` to `[..., H / stride, W / stride, out]`."""
        conv = self._conv
        y = convolution.relu(conv(self.mid, 1, "reduce")(x))
        y = convolution.relu(conv(self.mid, 3, "middle", self.stride)(y))
        y = conv(self.out, 1, "expand")(y)
        shortcut = conv(self.out, 1, "shortcut", self.stride)(x) if self.project else x
        return convolution.relu(y + shortcut) if self.last_relu else y + shortcut

    def _conv(self, features: int, size: int, name: str, stride: int = 1) -> nn.Conv:
        how = {"use_bias": False, "dtype": self.dtype, "name": name} | _gradient(size == 1)
        return nn.Conv(features, (size, size), (stride, stride), padding=size // 2, **how)


class ResNet43_8s(nn.Module):
    """Predict `out` values a cell with an hourglass of residual pairs: the paper's network by default.

    `stages` pairs of `width`, `2 * width`, ... channels, all but the first halving the image; then as many pairs less
    one with falling width, each followed by a doubling of the image; then a pair of `width / 4` channels that ends in
    `out`. The default has 9.82 M parameters (Transporter Networks, appendix; CLIPort's `ResNet43_8s`).

    One thing differs from CLIPort: its doubling stretches corner to corner, this one keeps cells over the cells that the
    strides took.

    Raises ValueError for an image whose sides the strides do not divide.
    """

    out: int
    width: int = 64
    stages: int = 4
    dtype: jnp.dtype = jnp.float32
    head_dtype: jnp.dtype | None = None  # of the last pair, `dtype` unless given

    @nn.compact
    def __call__(self, x: jax.Array, laterals: Sequence[jax.Array] | None = None) -> tuple[jax.Array, list[jax.Array]]:
        """Map `[..., H, W, C]` to `[..., H, W, out]`, and give the decoder's features, coarse to fine, besides.

        `laterals`, another network's decoder features, are concatenated to this one's, and a 1x1 convolution restores
        the width.
        """
        check_sides(x.shape, self.stages)
        many = x.shape[-1] > 4 * self.width  # as with features of pictures
        x = convolution.relu(nn.Conv(self.width, (3, 3), padding=1, dtype=self.dtype, name="stem", **_gradient(many))(x))
        for stage in range(self.stages):
            x = residual_pair(x, self.width << stage, f"down{stage}", stride=2 if stage else 1, dtype=self.dtype)
        decoded = []
        for level, stage in enumerate(reversed(range(self.stages - 1))):
            x = upsample(residual_pair(x, self.width << stage, f"up{stage}", dtype=self.dtype))
            if laterals is not None:
                x = jnp.concatenate([x, laterals[level].astype(x.dtype)], -1)
                x = nn.Conv(self.width << stage, (1, 1), dtype=self.dtype, name=f"lateral{stage}")(x)
            decoded.append(x)
        x = residual_pair(x, max(self.width // 4, MIN_HEAD), "head", self.out, last_relu=False, dtype=self.head_dtype or self.dtype)
        return x, decoded


def _gradient(product: bool) -> dict[str, Any]:
    """Give the argument of a convolution whose kernel's gradient is a `product`: faster on a CPU than XLA's."""
    return {"conv_general_dilated": convolution.product_gradient} if product and jax.default_backend() == "cpu" else {}


def residual_pair(
    x: jax.Array,
    width: int,
    name: str,
    out: int | None = None,
    *,
    stride: int = 1,
    last_relu: bool = True,
    dtype: jnp.dtype = jnp.float32,
) -> jax.Array:
    """Pass `[..., H, W, C]` through a projecting and an identity block of the module that calls, to `out` (or `width`) channels.

    Without `last_relu` neither ends in one.
    """
    out = width if out is None else out
    x = ResidualBlock(width, out, stride, True, last_relu, dtype, name=f"{name}_project")(x)
    return ResidualBlock(width, out, 1, False, last_relu, dtype, name=f"{name}_identity")(x)


def check_sides(shape: Sequence[int], stages: int) -> None:
    """Raise ValueError unless an image `[..., H, W, C]` of this shape survives `stages - 1` halvings."""
    step = 2 ** (stages - 1)
    if len(shape) < 3 or shape[-3] % step or shape[-2] % step:
        raise ValueError(f"an hourglass of {stages} stages needs [..., H, W, C] with sides divisible by {step}, got {tuple(shape)}")


def upsample(x: jax.Array) -> jax.Array:
    """Double the sides of `[..., H, W, C]` bilinearly: even cells copy, odd cells average their neighbours, the last repeats.

    A convolution of stride 2 centres its output on even cells, so this puts every value back over the cell it is about.
    """
    for axis in (-3, -2):
        axis = x.ndim + axis
        last = jax.lax.slice_in_dim(x, x.shape[axis] - 1, None, axis=axis)
        after = jnp.concatenate([jax.lax.slice_in_dim(x, 1, None, axis=axis), last], axis)
        pairs = jnp.stack([x, (x + after) / 2], axis + 1)
        x = pairs.reshape(*x.shape[:axis], 2 * x.shape[axis], *x.shape[axis + 1 :])
    return x
