"""Both correlations against a loop over cells."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax.models import correlation

BOTH = ("fft", "conv")


def _loop(key, kernels):
    """Slide every kernel over the zero-padded map, one cell at a time, in float64."""
    rows, cols, _ = key.shape
    size = kernels.shape[1]
    before, after = size // 2, size - 1 - size // 2
    padded = np.pad(key.astype(np.float64), ((before, after), (before, after), (0, 0)))
    out = np.zeros((len(kernels), rows, cols))
    for n, i, j in np.ndindex(out.shape):
        out[n, i, j] = (padded[i : i + size, j : j + size] * kernels[n]).sum()
    return out


def _inputs(seed, rows=9, cols=6, d=3, k=2, size=4):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, cols, d)).astype(np.float32), rng.normal(size=(k, size, size, d)).astype(np.float32)


@pytest.mark.parametrize("method", BOTH)
@pytest.mark.parametrize(
    "shape",
    [
        {"size": 1},
        {"size": 4},
        {"size": 5, "d": 1},
        {"size": 12, "k": 1},  # larger than the map
        {"rows": 16, "cols": 24, "size": 8},  # sums of sides and reach that are fast lengths already
    ],
    ids=str,
)
def test_equals_the_loop(method, shape):
    key, kernels = _inputs(0, **shape)
    np.testing.assert_allclose(correlation.correlate(key, kernels, method=method), _loop(key, kernels), atol=3e-5)


@pytest.mark.parametrize("method", ("auto", *BOTH))
@pytest.mark.parametrize("size", (4, 5))
def test_a_spike_at_the_kernel_centre_returns_the_map(method, size):
    key, kernels = _inputs(1, size=size, d=2, k=1)
    kernels = np.zeros_like(kernels)
    kernels[0, size // 2, size // 2, 1] = 1
    np.testing.assert_allclose(correlation.correlate(key, kernels, method=method)[0], key[..., 1], atol=1e-6)


@pytest.mark.parametrize("method", BOTH)
def test_jit_equals_eager_and_vmap_equals_a_loop(method):
    batch = [_inputs(seed) for seed in range(3)]
    keys, kernels = (jnp.stack(leaf) for leaf in zip(*batch, strict=True))

    def correlate(key, kernels):
        return correlation.correlate(key, kernels, method=method)

    eager = jnp.stack([correlate(*pair) for pair in batch])
    np.testing.assert_allclose(jax.vmap(correlate)(keys, kernels), eager, atol=1e-5)
    np.testing.assert_allclose(jax.jit(correlate)(*batch[0]), eager[0], atol=1e-5)


@pytest.mark.parametrize("method", BOTH)
def test_gradients_are_those_of_a_bilinear_form(method):
    """`<w, key * kernels>` is linear in each argument, so its gradient is read off the loop on unit inputs."""
    key, kernels = _inputs(2, rows=4, cols=5, d=2, k=1, size=3)
    weight = np.random.default_rng(3).normal(size=(1, 4, 5)).astype(np.float32)

    def form(key, kernels):
        return (weight * correlation.correlate(key, kernels, method=method)).sum()

    of_key, of_kernels = jax.jit(jax.grad(form, (0, 1)))(key, kernels)

    def units(shape):
        return np.eye(np.prod(shape), dtype=np.float32).reshape(-1, *shape)

    want_key = [(weight * _loop(unit, kernels)).sum() for unit in units(key.shape)]
    want_kernels = [(weight * _loop(key, unit)).sum() for unit in units(kernels.shape)]
    np.testing.assert_allclose(of_key.ravel(), want_key, atol=2e-5)
    np.testing.assert_allclose(of_kernels.ravel(), want_kernels, atol=2e-5)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("size", [4, 5])
@pytest.mark.parametrize(("platform", "chunk"), [("cpu", 1), ("cpu", 2), ("cpu", 4), ("cpu", 9), ("gpu", 1)])
def test_the_spectrum_has_the_values_and_gradients_of_a_convolution(monkeypatch, platform, chunk, size, dtype):
    """In a batch; kernels all at once, and some at a time by products, also where their number does not come out even."""
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    monkeypatch.setattr(correlation, "_CHUNK", chunk)
    batch = [jnp.stack(leaf).astype(dtype) for leaf in zip(*[_inputs(seed, cols=7, k=5, size=size) for seed in range(2)], strict=True)]
    weight = np.random.default_rng(6).normal(size=(2, 5, 9, 7)).astype(np.float32)

    def form(key, kernels, method):
        out = jax.vmap(lambda *one: correlation.correlate(*one, method=method))(key, kernels)
        return (weight * out).sum(), out

    found, want = (jax.jit(jax.grad(form, (0, 1), has_aux=True), static_argnums=2)(*batch, method) for method in BOTH)
    assert jax.tree.map(lambda leaf: leaf.dtype, found[0]) == (dtype, dtype)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        one, other = (np.asarray(leaf, np.float32) for leaf in (one, other))
        np.testing.assert_allclose(one, other, atol=(1e-5 if dtype == jnp.float32 else 0.02) * np.abs(other).max())


@pytest.mark.parametrize("method", BOTH)
def test_bfloat16_goes_in_and_float32_comes_out(method):
    key, kernels = (x.astype(jnp.bfloat16) for x in map(jnp.asarray, _inputs(4)))
    out = correlation.correlate(key, kernels, method=method)
    assert out.dtype == jnp.float32
    want = _loop(np.asarray(key, np.float32), np.asarray(kernels, np.float32))
    np.testing.assert_allclose(out, want, atol=0.02 * np.abs(want).max())


@pytest.mark.parametrize("method", BOTH)
def test_types_may_differ(method):
    key, kernels = map(jnp.asarray, _inputs(4))
    mixed = correlation.correlate(key.astype(jnp.bfloat16), kernels, method=method)
    np.testing.assert_allclose(
        mixed, correlation.correlate(key.astype(jnp.bfloat16).astype(jnp.float32), kernels, method=method), atol=1e-4
    )


def test_refuses_what_it_cannot_do():
    key, kernels = _inputs(5)
    with pytest.raises(ValueError, match=r"method must be one of \('auto', 'fft', 'conv'\), got 'direct'"):
        correlation.correlate(key, kernels, method="direct")
    with pytest.raises(ValueError, match=r"got \(9, 6, 3\) and \(2, 4, 4, 2\)"):
        correlation.correlate(key, kernels[..., :2])
    with pytest.raises(ValueError, match=r"at least a cell, a kernel and a channel, got \(9, 6, 3\) and \(0, 4, 4, 3\)"):
        correlation.correlate(key, kernels[:0])
    with pytest.raises(ValueError, match="correlate needs key"):
        correlation.correlate(key, kernels[:, :3])
