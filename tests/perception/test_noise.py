"""Depth noise: its size, its steps, its holes; cameras moved within bounds; and that the key alone decides."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lala_jax.perception import camera, noise

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


SHIFT, TURN = 0.03, 0.05


@functools.cache
def moves(count=400):
    """Cameras, and how `count` draws moved each: eyes' shifts `[count, V, 3]` and turn vectors in world axes `[count, V, 3]`."""
    eyes = jnp.array([[0.9, 0.3, 0.7], [0.1, 0.5, 0.7], [0.3, 0.05, 0.9]])
    cameras = camera.pinhole(camera.look_at(eyes, jnp.array([0.5, 0.0, 0.0])), height=12, width=16, focal=20.0)
    move = jax.jit(jax.vmap(lambda key: noise.move_cameras(key, cameras, shift=SHIFT, turn=TURN)))
    moved = move(jax.random.split(KEY, count))
    before, after = np.asarray(cameras.world_from_cam, float), np.asarray(moved.world_from_cam, float)
    turns = after[..., :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2)
    turns = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec().reshape(count, 3, 3)
    return cameras, moved, after[..., :3, 3] - before[:, :3, 3], turns


def test_moved_cameras_stay_rigid_and_within_bounds():
    cameras, moved, shift, turn = moves()
    rotation = np.asarray(moved.world_from_cam)[..., :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, -1, -2), np.broadcast_to(np.eye(3), rotation.shape), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-6)
    np.testing.assert_array_equal(moved.world_from_cam[..., 3, :], np.broadcast_to([0, 0, 0, 1], (400, 3, 4)))
    np.testing.assert_array_equal(moved.intrinsics, np.broadcast_to(cameras.intrinsics, (400, 3, 3, 3)))
    assert (moved.height, moved.width) == (12, 16)
    assert np.linalg.norm(shift, axis=-1).max() <= SHIFT + 1e-6 and np.linalg.norm(turn, axis=-1).max() <= TURN + 1e-6


@pytest.mark.parametrize("which", [0, 1])
def test_moves_are_uniform_in_length_and_direction(which):
    """Lengths by their quantiles (1200 draws: three standard errors), directions by each axis's mean and second moment."""
    vectors = (moves()[2] / SHIFT, moves()[3] / TURN)[which]
    length = np.linalg.norm(vectors, axis=-1).ravel()
    np.testing.assert_allclose(np.quantile(length, (0.1, 0.25, 0.5, 0.75, 0.9)), (0.1, 0.25, 0.5, 0.75, 0.9), atol=0.045)
    direction = (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).reshape(-1, 3)
    np.testing.assert_allclose(direction.mean(0), 0, atol=0.05)
    np.testing.assert_allclose(direction.T @ direction / len(direction), np.eye(3) / 3, atol=0.035)
    # lengths, and the draws of different cameras, have nothing to do with each other
    shift, turn = (np.linalg.norm(moves()[i], axis=-1) for i in (2, 3))
    table = np.corrcoef(np.concatenate([shift, turn], 1).T)
    assert np.abs(table - np.eye(6)).max() < 0.16


def test_no_move_is_the_identity_and_the_key_decides():
    cameras, moved, *_ = moves()
    still = noise.move_cameras(KEY, cameras, shift=0.0, turn=0.0)
    np.testing.assert_allclose(still.world_from_cam, cameras.world_from_cam, atol=1e-7)
    first = jax.random.split(KEY, 400)[0]
    again = noise.move_cameras(first, cameras, shift=SHIFT, turn=TURN)
    np.testing.assert_allclose(again.world_from_cam, moved.world_from_cam[0], atol=1e-6)
    only = noise.move_cameras(first, cameras, shift=SHIFT, turn=0.0)
    np.testing.assert_allclose(only.world_from_cam[:, :3, 3], moved.world_from_cam[0, :, :3, 3], atol=1e-6)
    np.testing.assert_allclose(only.world_from_cam[:, :3, :3], cameras.world_from_cam[:, :3, :3], atol=1e-6)
