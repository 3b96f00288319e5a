"""Depth noise: its size, its steps, its holes, and that the key alone decides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax.perception import noise

KEY = jax.random.key(0)
CLEAN = {"sigma": 0.0, "sigma_per_square": 0.0, "disparity_step": 0.0, "edge_dropout": 0.0, "dropout": 0.0}


@pytest.mark.parametrize("z", [0.5, 1.0, 1.5])
def test_noise_has_the_stated_spread_and_no_bias(z):
    depth = jnp.full((200, 200), z)
    noisy = np.asarray(noise.depth_noise(KEY, depth, disparity_step=0.0, dropout=0.0), float)
    sigma = 0.001 + 0.002 * z * z
    assert abs(noisy.std() / sigma - 1) < 0.02  # 40 000 samples: four standard errors
    assert abs(noisy.mean() - z) < 5 * sigma / 200


def test_everything_off_is_the_identity():
    depth = jnp.asarray(np.random.default_rng(0).uniform(0.1, 2, (20, 30)), jnp.float32).at[3, 4].set(0.0)
    np.testing.assert_allclose(noise.depth_noise(KEY, depth, **CLEAN), depth, rtol=1e-6)


def test_depth_comes_in_whole_steps_of_disparity():
    depth = jnp.asarray(np.random.default_rng(0).uniform(0.3, 2, (40, 40)), jnp.float32)
    noisy = np.asarray(noise.depth_noise(KEY, depth, **CLEAN | {"disparity_step": 1 / 32}), float)
    steps = 450 * 0.055 / noisy * 32
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    step = np.asarray(depth, float) ** 2 / (450 * 0.055 * 32)
    assert (np.abs(noisy - depth) <= 0.52 * step + 1e-6).all()


def test_holes_stay_holes_and_new_ones_come_at_the_stated_rates():
    depth = jnp.ones((4, 100, 100)).at[:, :, 50:].set(1.5).at[:, :10, :10].set(0.0)
    noisy = np.asarray(noise.depth_noise(KEY, depth, edge_dropout=0.5, dropout=0.01))
    assert (noisy[:, :10, :10] == 0).all()
    assert abs((noisy[:, 20:, 49:51] == 0).mean() - 0.505) < 0.08
    assert abs((noisy[:, 20:, 60:] == 0).mean() - 0.01) < 0.005
    assert (noisy >= 0).all() and np.isfinite(noisy).all()


def test_edges_equal_a_loop_over_neighbours():
    depth = np.random.default_rng(1).choice([0.5, 0.51, 0.6], (9, 7), p=[0.6, 0.3, 0.1]).astype(np.float32)
    expected = np.zeros(depth.shape, bool)
    for i in range(9):
        for j in range(7):
            for di, dj in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                if 0 <= i + di < 9 and 0 <= j + dj < 7:
                    expected[i, j] |= abs(depth[i, j] - depth[i + di, j + dj]) > 0.02
    assert 0 < expected.sum() < expected.size
    np.testing.assert_array_equal(noise.edges(jnp.asarray(depth), jump=0.02), expected)


def test_the_key_decides_and_jit_and_vmap_change_nothing():
    depth = jnp.asarray(np.random.default_rng(2).uniform(0.5, 1.5, (3, 12, 16)), jnp.float32)
    keys = jax.random.split(KEY, 3)
    loop = np.stack([noise.depth_noise(key, one) for key, one in zip(keys, depth, strict=True)])
    np.testing.assert_allclose(jax.jit(jax.vmap(noise.depth_noise))(keys, depth), loop, atol=2e-3)  # rounding may move a disparity step
    np.testing.assert_array_equal(noise.depth_noise(keys[0], depth[0]), loop[0])
    assert (noise.depth_noise(keys[1], depth[0]) != loop[0]).any()
