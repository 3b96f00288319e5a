"""Cross-correlation of a key map with rotated query kernels: no parameters, two methods, one choice."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

METHODS = ("auto", "fft", "conv")

# What the platform decides, here and with _CHUNK; anything not named here convolves. In the spectrum the cost hardly grows with
# the crop, where a direct convolution pays for every pixel of it and its gradient is a convolution with a map-sized kernel.
_METHOD_OF_PLATFORM = {"cpu": "fft", "gpu": "fft"}


def correlate(key: jax.Array, kernels: jax.Array, *, method: str = "auto") -> jax.Array:
    """Cross-correlate a key map `[rows, cols, d]` with `kernels` `[k, c, c, d]`, giving float32 `[k, rows, cols]`; unbatched.

    `out[n, i, j] = sum_abd key[i + a - c // 2, j + b - c // 2, d] * kernels[n, a, b, d]` with zeros outside the map, so
    the score of a cell is that of the kernel with its index `c // 2` on it (Transporter Networks, equation 3).

    Differentiable in reverse mode; forward mode (`jax.jvp`) knows "conv" only.

    `method` is "fft", "conv" or "auto", the one that suits the platform. Raises ValueError for another method and for
    shapes that do not fit.
    """
    if not key.size or not kernels.size:
        raise ValueError(f"correlate needs at least a cell, a kernel and a channel, got {key.shape} and {kernels.shape}")
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
    if key.ndim != 3 or kernels.ndim != 4 or kernels.shape[1] != kernels.shape[2] or key.shape[-1] != kernels.shape[-1]:
        raise ValueError(f"correlate needs key [rows, cols, d] and kernels [k, c, c, d], got {key.shape} and {kernels.shape}")
    if method == "auto":
        method = _METHOD_OF_PLATFORM.get(jax.default_backend(), "conv")
    return _correlate_fft(key, kernels) if method == "fft" else _correlate_conv(key, kernels)


def _correlate_conv(key: jax.Array, kernels: jax.Array) -> jax.Array:
    before, after = _reach(kernels.shape[1])
    key, kernels = (one.astype(jnp.result_type(key, kernels)) for one in (key, kernels))
    out = jax.lax.conv_general_dilated(
        key[None],
        jnp.transpose(kernels, (1, 2, 3, 0)),
        window_strides=(1, 1),
        padding=((before, after), (before, after)),
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    return jnp.transpose(out[0], (2, 0, 1)).astype(jnp.float32)


def _correlate_fft(key: jax.Array, kernels: jax.Array) -> jax.Array:
    """Correlate in the spectrum, the channels summed before the inverse so that there is one inverse a kernel."""
    key, kernels = jnp.moveaxis(key.astype(jnp.float32), -1, 0), jnp.moveaxis(kernels.astype(jnp.float32), -1, 1)
    return _spectral(key, kernels, _CHUNK if jax.default_backend() == "cpu" else len(kernels))


# A CPU takes a few kernels at a time, whose spectra then stay in its caches. Taken in turn by hand: two thirds of the time of all at once.
_CHUNK = 2


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _spectral(key: jax.Array, kernels: jax.Array, chunk: int) -> jax.Array:
    """Correlate `[d, rows, cols]` with `[k, d, c, c]`, `chunk` kernels at a time.

    The derivative is written out, since it too needs one inverse a kernel only, and no spectrum of a kernel is kept for it.
    """
    rows, cols = key.shape[1:]
    spectrum, (height, width), _ = _key_spectrum(key, kernels.shape[-1])

    def some(part):
        return _irfft2((spectrum * jnp.conj(_rfft2(part, height, width))).sum(1), width, rows, cols)

    return _joined(jax.lax.map(some, _chunks(kernels, chunk)), len(kernels))


def _spectral_fwd(key, kernels, chunk):
    return _spectral(key, kernels, chunk), (key, kernels)


def _spectral_bwd(chunk, kept, slopes):
    key, kernels = kept
    rows, cols, size = *key.shape[1:], kernels.shape[-1]
    spectrum, (height, width), before = _key_spectrum(key, size)

    def some(total, part):
        kernel, slope = (_rfft2(one, height, width) for one in part)
        slope = slope[:, None]
        return total + (slope * kernel).sum(0), _irfft2(spectrum * jnp.conj(slope), width, size, size)

    parts = _chunks(kernels, chunk), _chunks(slopes, chunk)
    total, by_kernel = jax.lax.scan(some, jnp.zeros_like(spectrum), parts)
    by_key = _irfft2(total, width, before + rows, before + cols)[:, before:, before:]
    return by_key, _joined(by_kernel, len(kernels))


_spectral.defvjp(_spectral_fwd, _spectral_bwd)


def _key_spectrum(key, size):
    """Transform the map `[d, rows, cols]`: its spectrum, the lengths of the transform, and where the map begins in what is transformed.

    The map is shifted by the kernel's reach, which puts the answer at the origin; the longer reach, not the whole kernel, is all the
    zeros needed against wrapping around.
    """
    before, after = _reach(size)
    lengths = tuple(_fast_length(side + max(before, after)) for side in key.shape[1:])
    return _rfft2(jnp.pad(key, ((0, 0), (before, 0), (before, 0))), *lengths), lengths, before


def _chunks(values, chunk):
    """Split `[k, ...]` into `[n, chunk, ...]`, zeros added where it does not come out even."""
    chunk = min(chunk, len(values))
    more = -len(values) % chunk
    return jnp.pad(values, ((0, more), *[(0, 0)] * (values.ndim - 1))).reshape(-1, chunk, *values.shape[1:])


def _joined(parts, count):
    return parts.reshape(-1, *parts.shape[2:])[:count]


# Spectra lie `[..., width // 2 + 1, height]`, columns along the rows of memory, as their transform leaves them: XLA transforms along
# the last axis only. Taken in turn by hand, the correlation and its gradient take 0.87 of what they do with spectra turned back each time.


def _rfft2(values: jax.Array, height: int, width: int) -> jax.Array:
    """Transform `[..., rows, cols]` zero-padded to `[..., height, width]`; rows of zeros are added after their transform."""
    return jnp.fft.fft(jnp.swapaxes(jnp.fft.rfft(values, n=width), -1, -2), n=height)


def _irfft2(spectrum: jax.Array, width: int, rows: int, cols: int) -> jax.Array:
    """Give the first `rows` and `cols` of the inverse transform, without transforming the other rows back."""
    return jnp.fft.irfft(jnp.swapaxes(jnp.fft.ifft(spectrum)[..., :rows], -1, -2), n=width)[..., :cols]


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
