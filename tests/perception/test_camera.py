"""Pixels to points and back, against a plain matrix computation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax.perception import camera

EYES = np.array([[1.0, 0.0, 0.75], [0.25, 0.75, 0.75], [-0.5, 0.0, 0.75], [0.25, -0.75, 0.75]])
TARGET = np.array([0.25, 0.0, 0.0])


def ring(height=48, width=64, focal=45.0):
    return camera.pinhole(camera.look_at(EYES, TARGET), height=height, width=width, focal=focal)


def one(cameras, index):
    return jax.tree.map(lambda leaf: leaf[index], cameras)


def random_depth(height=48, width=64):
    return np.random.default_rng(0).uniform(0.3, 2.0, (height, width)).astype(np.float32)


@pytest.mark.parametrize("index", range(4))
def test_unproject_equals_the_inverse_of_the_matrices(index):
    view, depth = one(ring(), index), random_depth()
    points = jax.jit(camera.unproject)(depth, view)
    for i, j in ((0, 0), (0, 63), (47, 0), (47, 63), (20, 31)):
        ray = np.linalg.inv(np.asarray(view.intrinsics, float)) @ [j + 0.5, i + 0.5, 1.0]
        expected = np.asarray(view.world_from_cam, float) @ [*(ray * depth[i, j]), 1.0]
        np.testing.assert_allclose(points[i, j], expected[:3], atol=2e-6)


@pytest.mark.parametrize("index", range(4))
def test_projecting_what_was_unprojected_is_the_identity(index):
    view, depth = one(ring(480, 640, 450.0), index), random_depth(480, 640)
    uv, back = camera.project(camera.unproject(jnp.asarray(depth), view), view)
    np.testing.assert_allclose(uv, camera.pixel_centers(480, 640), atol=1e-3)
    np.testing.assert_allclose(back, depth, atol=2e-6)
    assert bool(camera.in_image(uv, back, view).all())


def test_skewed_and_off_centre_intrinsics_make_the_round_trip():
    view = one(ring(), 0)
    view = view.replace(intrinsics=jnp.array([[45.0, 3.0, 20.0], [0.0, 50.0, 30.0], [0.0, 0.0, 1.0]]))
    depth = random_depth()
    uv, back = camera.project(camera.unproject(jnp.asarray(depth), view), view)
    np.testing.assert_allclose(uv, camera.pixel_centers(48, 64), atol=1e-4)
    np.testing.assert_allclose(back, depth, atol=1e-6)


def test_look_at_aims_and_keeps_up_up():
    for eye, matrix in zip(EYES, camera.look_at(EYES, TARGET), strict=True):
        rotation = matrix[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        np.testing.assert_allclose(rotation[:, 2], (TARGET - eye) / np.linalg.norm(TARGET - eye))
        assert abs(rotation[2, 0]) < 1e-12 and rotation[2, 1] < 0, "the image's x axis is level, its y axis points down"
    view = one(ring(), 0)
    uv, depth = camera.project(TARGET, view)
    np.testing.assert_allclose(uv, [32, 24], atol=1e-4)
    np.testing.assert_allclose(depth, np.linalg.norm(TARGET - EYES[0]), atol=1e-6)


@pytest.mark.parametrize(("up", "image_up"), [((0, 0, 1), (0, 1, 0)), ((0, 1, 0), (1, 0, 0))])
def test_looking_along_up_falls_back_to_a_fixed_roll(up, image_up):
    forward = np.array(up, float)
    matrix = camera.look_at(-forward, (0, 0, 0), up)
    np.testing.assert_allclose(matrix[:3, 2], forward)
    np.testing.assert_allclose(-matrix[:3, 1], image_up)


def test_look_at_is_the_same_on_numpy_jax_and_under_vmap():
    expected = camera.look_at(EYES, TARGET)
    assert isinstance(expected, np.ndarray) and expected.dtype == np.float64
    batched = jax.jit(jax.vmap(lambda eye: camera.look_at(eye, TARGET)))(jnp.asarray(EYES, jnp.float32))
    np.testing.assert_allclose(batched, expected, atol=1e-6)


def test_scaling_scales_projections_and_keeps_the_field_of_view():
    small = ring()
    large = camera.scale(small, 480, 640)
    assert (large.height, large.width) == (480, 640)
    points = np.random.default_rng(1).uniform([0, -0.4, 0], [0.6, 0.4, 0.3], (20, 3))
    for index in range(4):
        uv, _ = camera.project(points, one(small, index))
        uv_large, _ = camera.project(points, one(large, index))
        np.testing.assert_allclose(uv_large, 10 * uv, atol=1e-3)
    np.testing.assert_allclose(large.intrinsics, ring(480, 640, 450.0).intrinsics)


def test_points_behind_the_camera_are_finite_and_outside():
    view = one(ring(), 0)
    behind = EYES[0] + np.array([[1.0, 0.0, 0.75], [0.0, 0.0, 0.0]])
    uv, depth = camera.project(behind, view)
    assert bool(jnp.isfinite(uv).all())
    assert not bool(camera.in_image(uv, depth, view).any())


def test_vmap_over_views_equals_a_loop_and_depth_zero_is_the_eye():
    cameras, depth = ring(), np.stack([random_depth()] * 4)
    depth[:, 3, 5] = 0
    batched = jax.vmap(camera.unproject)(jnp.asarray(depth), cameras)
    for index in range(4):
        np.testing.assert_allclose(batched[index], camera.unproject(depth[index], one(cameras, index)), atol=1e-6)
        np.testing.assert_allclose(batched[index, 3, 5], EYES[index], atol=1e-6)


def test_unproject_names_the_shapes_of_a_batch():
    with pytest.raises(ValueError, match=r"\(48, 64\).*\(4, 48, 64\).*vmap"):
        camera.unproject(jnp.ones((4, 48, 64)), ring())
