"""Cross-correlation of a key map with rotated query kernels: no parameters, two methods, one choice."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

METHODS = ("auto", "fft", "conv")

# What the platform decides, here and in `_correlate_fft`; anything not named here convolves. In the spectrum the cost hardly grows with
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
    on_cpu = jax.default_backend() == "cpu"
    return _spectral(key, kernels, _CHUNK if on_cpu else len(kernels), on_cpu)


# A CPU takes a few kernels at a time, whose spectra then stay in its caches.
_CHUNK = 6


@functools.partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _spectral(key: jax.Array, kernels: jax.Array, chunk: int, products: bool) -> jax.Array:
    """Correlate `[d, rows, cols]` with `[k, d, c, c]`, `chunk` kernels at a time, each transformed by an FFT or by `products`.

    The derivative is written out, since it too needs one inverse a kernel only. In a jitted function that takes none, XLA drops the
    spectra kept for it.
    """
    return _spectral_fwd(key, kernels, chunk, products)[0]


def _spectral_fwd(key, kernels, chunk, products):
    rows, cols = key.shape[1:]
    spectrum, (height, width), _ = _key_spectrum(key, kernels.shape[-1])
    transform = _rfft2_by_products if products else _rfft2

    def some(part):
        kernel = transform(part, height, width)
        return _irfft2((spectrum * jnp.conj(kernel)).sum(1), width, rows, cols), kernel

    out, spectra = jax.lax.map(some, _chunks(kernels, chunk))
    return _joined(out, len(kernels)), (key, kernels, spectra)


def _spectral_bwd(chunk, products, kept, slopes):
    key, kernels, spectra = kept
    rows, cols, size = *key.shape[1:], kernels.shape[-1]
    spectrum, (height, width), before = _key_spectrum(key, size)
    back = _irfft2_by_products if products else _irfft2

    def some(total, part):
        kernel, slope = part
        slope = _rfft2(slope, height, width)[:, None]
        return total + (slope * kernel).sum(0), back(spectrum * jnp.conj(slope), width, size, size)

    total, by_kernel = jax.lax.scan(some, jnp.zeros_like(spectrum), (spectra, _chunks(slopes, chunk)))
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


# A kernel padded to the map is mostly zeros. Products with the few rows of the Fourier matrix that meet the others take a CPU less time
# than a transform of it all. Complex numbers are pairs there, real and imaginary part.


def _rfft2_by_products(values: jax.Array, height: int, width: int) -> jax.Array:
    """Do what `_rfft2` does."""
    rows, cols = values.shape[-2:]
    along_rows = jnp.einsum("...rc,cpw->...wpr", values, _waves(cols, width)[..., : width // 2 + 1])
    pairs = jnp.einsum("...wpr,prqh->...wqh", along_rows, _turns(rows, height))
    return jax.lax.complex(pairs[..., 0, :], pairs[..., 1, :])


def _irfft2_by_products(spectrum: jax.Array, width: int, rows: int, cols: int) -> jax.Array:
    """Do what `_irfft2` does: the transposed products, where what stands for two frequencies counts twice."""
    half, height = spectrum.shape[-2:]
    pairs = jnp.stack([spectrum.real, spectrum.imag], axis=-2)
    along_cols = jnp.einsum("...wqh,prqh->...wpr", pairs, _turns(rows, height) / height)
    twice = np.where(2 * np.arange(half) % width, 2, 1).astype(np.float32)
    return jnp.einsum("...wpr,cpw->...rc", along_cols, _waves(cols, width)[..., :half] * twice / width)


def _waves(count: int, length: int) -> np.ndarray:
    """Give `exp(-2 pi i n f / length)` for the first `count` of the places `n`: pairs `[count, 2, length]`."""
    angle = -2 * np.pi / length * (np.outer(np.arange(count), np.arange(length)) % length)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


def _turns(count: int, length: int) -> np.ndarray:
    """Give the same as products of pairs, `[2, count, 2, length]`."""
    real, imag = np.moveaxis(_waves(count, length), 1, 0)
    return np.stack([np.stack([real, imag], axis=1), np.stack([-imag, real], axis=1)])


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
