"""Cross-correlation of a key map with rotated query kernels: no parameters, two methods, one choice."""

from __future__ import annotations

import jax
import jax.numpy as jnp

METHODS = ("auto", "fft", "conv")

# The one place where the platform decides; anything not named here convolves. In the spectrum the cost hardly grows with
# the crop, where a direct convolution pays for every pixel of it and its gradient is a convolution with a map-sized kernel.
_METHOD_OF_PLATFORM = {"cpu": "fft", "gpu": "fft"}


def correlate(key: jax.Array, kernels: jax.Array, *, method: str = "auto") -> jax.Array:
    """Cross-correlate a key map `[rows, cols, d]` with `kernels` `[k, c, c, d]`, giving float32 `[k, rows, cols]`; unbatched.

    `out[n, i, j] = sum_abd key[i + a - c // 2, j + b - c // 2, d] * kernels[n, a, b, d]` with zeros outside the map, so
    the score of a cell is that of the kernel with its index `c // 2` on it (Transporter Networks, equation 3).

    `method` is "fft", "conv" or "auto", the one that suits the platform. Raises ValueError for another method and for
    shapes that do not fit.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
    if key.ndim != 3 or kernels.ndim != 4 or kernels.shape[1] != kernels.shape[2] or key.shape[-1] != kernels.shape[-1]:
        raise ValueError(f"correlate needs key [rows, cols, d] and kernels [k, c, c, d], got {key.shape} and {kernels.shape}")
    if method == "auto":
        method = _METHOD_OF_PLATFORM.get(jax.default_backend(), "conv")
    return _correlate_fft(key, kernels) if method == "fft" else _correlate_conv(key, kernels)


def _correlate_conv(key: jax.Array, kernels: jax.Array) -> jax.Array:
    before, after = _reach(kernels.shape[1])
    out = jax.lax.conv_general_dilated(
        key[None],
        jnp.transpose(kernels, (1, 2, 3, 0)),
        window_strides=(1, 1),
        padding=((before, after), (before, after)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return jnp.transpose(out[0], (2, 0, 1)).astype(jnp.float32)


def _correlate_fft(key: jax.Array, kernels: jax.Array) -> jax.Array:
    """Correlate in the spectrum, the channels summed before the inverse so that there is one inverse a kernel.

    The map is shifted by the kernel's reach, which puts the answer at the origin; the longer reach, not the whole
    kernel, is all the zeros needed against wrapping around.
    """
    rows, cols, _ = key.shape
    before, after = _reach(kernels.shape[1])
    height, width = _fast_length(rows + max(before, after)), _fast_length(cols + max(before, after))
    key = jnp.moveaxis(key.astype(jnp.float32), -1, 0)
    key = jnp.pad(key, ((0, 0), (before, height - before - rows), (before, width - before - cols)))
    kernels = jnp.moveaxis(kernels.astype(jnp.float32), -1, 1)
    spectrum = (jnp.fft.rfft2(key)[None] * jnp.conj(_rfft2(kernels, height, width))).sum(1)
    return jnp.fft.irfft2(spectrum, s=(height, width))[:, :rows, :cols]


def _rfft2(kernels: jax.Array, height: int, width: int) -> jax.Array:
    """Transform `[..., c, c]` zero-padded to `[..., height, width]`; rows of zeros are added after their transform."""
    return jnp.fft.fft(jnp.fft.rfft(kernels, n=width, axis=-1), n=height, axis=-2)


def _reach(size: int) -> tuple[int, int]:
    """Say how far a kernel reaches before and after the cell that its index `size // 2` is on."""
    return size // 2, size - 1 - size // 2


def _fast_length(length: int) -> int:
    """Give the smallest length from `length` on whose only prime factors are 2, 3, 5 and 7."""
    while True:
        rest = length
        for factor in (2, 3, 5, 7):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return length
        length += 1
