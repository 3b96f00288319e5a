"""Bilinear reads against scipy, rotated crops against exact quarter turns and against the world's own rotation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from lala_jax import types
from lala_jax.perception import image, transforms

RNG = np.random.default_rng(0)
PICTURE = RNG.random((14, 11, 3)).astype(np.float32)


def test_sample_equals_scipy_inside_at_the_rim_and_outside():
    at = RNG.uniform([-3, -3], [17, 14], (500, 2)).astype(np.float32)
    expected = np.stack(
        [ndimage.map_coordinates(PICTURE[..., c].astype(float), at.T.astype(float) - 0.5, order=1, mode="grid-constant") for c in range(3)],
        -1,
    )
    np.testing.assert_allclose(image.sample(jnp.asarray(PICTURE), jnp.asarray(at)), expected, atol=3e-6)


def test_sample_of_a_short_type_is_rounded_once():
    at = jnp.asarray(RNG.uniform([-1, -1], [15, 12], (500, 2)), jnp.float32)
    short = jnp.asarray(PICTURE, jnp.bfloat16)
    got = image.sample(short, at)
    assert got.dtype == jnp.bfloat16
    np.testing.assert_array_equal(got, image.sample(short.astype(jnp.float32), at).astype(jnp.bfloat16))


def test_sample_at_cell_centres_is_the_image():
    index = np.stack(np.meshgrid(np.arange(14), np.arange(11), indexing="ij"), axis=-1)
    np.testing.assert_array_equal(image.sample(jnp.asarray(PICTURE), jnp.asarray(index + 0.5, jnp.float32)), PICTURE)


@pytest.mark.parametrize("size", [5, 6])
def test_quarter_turns_are_exact(size):
    crops = image.rotate_crop(jnp.asarray(PICTURE), (7.5, 5.5), 4, size)
    half = size // 2
    np.testing.assert_array_equal(crops[0], PICTURE[7 - half : 7 - half + size, 5 - half : 5 - half + size])
    # In map axes (row +y, col +x) a turn about +z takes +x (col) to +y (row): the transpose sense of rot90's default.
    odd = image.rotate_crop(jnp.asarray(PICTURE), (7.5, 5.5), 4, 5)
    for turns in range(4):
        np.testing.assert_allclose(odd[turns], np.rot90(odd[0], -turns), atol=1e-6)


rotate_crop = jax.jit(image.rotate_crop, static_argnums=(2, 3))


def bump(xy, spec):
    """Draw smooth spots at `xy` `[n, 2]` metres, each with its own brightness."""
    index = np.stack(np.meshgrid(np.arange(spec.rows), np.arange(spec.cols), indexing="ij"), axis=-1)
    centers = np.asarray(types.world_from_index(spec, index))
    squared = ((centers[:, :, None] - xy) ** 2).sum(-1)
    return (np.exp(-squared / (2 * 0.02**2)) * np.arange(1, len(xy) + 1)).sum(-1, keepdims=True).astype(np.float32)


@pytest.mark.parametrize("bins", [8, 36])
def test_crop_b_shows_the_object_after_a_world_turn_by_b_bins(bins):
    spec = types.MapSpec(x=(0.0, 0.4), y=(-0.2, 0.2), cell=0.005)
    spots = np.array([[0.25, 0.02], [0.19, 0.06], [0.2, -0.04]])
    cell = np.array([41, 42])
    about = np.asarray(types.world_from_index(spec, cell))
    crops = np.asarray(rotate_crop(jnp.asarray(bump(spots, spec)), cell + 0.5, bins, 32))
    for b in range(0, bins, max(1, bins // 8)):
        turned = transforms.apply_se2(transforms.se2_about(about, 2 * np.pi * b / bins), spots)
        after = bump(turned, spec)[41 - 16 : 41 + 16, 42 - 16 : 42 + 16]
        np.testing.assert_allclose(crops[b], after, atol=0.06)  # bilinear reading of spots with a radius of four cells
        assert np.abs(crops[b] - after).mean() < 0.01


@pytest.mark.parametrize(("size", "center"), [(5, (7.5, 5.5)), (8, (3.2, 9.9)), (8, (0.5, 0.5))])
def test_a_turned_crop_is_the_rotated_crop_of_its_angle(size, center):
    """At the bins' angles, and any number of turns more; in between it is neither neighbour."""
    crops = rotate_crop(jnp.asarray(PICTURE), center, 12, size)
    turned_crop = jax.jit(image.turned_crop, static_argnums=3)
    for b in (0, 1, 5, 9, 11):
        for turns in (0, -1):
            yaw = jnp.float32(2 * np.pi * (b / 12 + turns))
            np.testing.assert_allclose(turned_crop(jnp.asarray(PICTURE), center, yaw, size), crops[b], atol=2e-5)
    between = turned_crop(jnp.asarray(PICTURE), center, jnp.float32(2 * np.pi * 1.5 / 12), size)
    np.testing.assert_allclose(between, rotate_crop(jnp.asarray(PICTURE), center, 24, size)[3], atol=2e-5)
    assert all(np.abs(between - crops[b]).max() > 0.01 for b in (1, 2))
    eager = image.turned_crop(jnp.asarray(PICTURE), center, jnp.float32(2 * np.pi / 12), size)
    np.testing.assert_allclose(eager, crops[1], atol=2e-5)


def test_crops_at_the_rim_are_zero_outside():
    crops = rotate_crop(jnp.ones((10, 10, 1)), (0.5, 0.5), 4, 8)
    np.testing.assert_array_equal(crops[0, :4], 0)
    np.testing.assert_array_equal(crops[0, 4:, 4:], 1)
    far = rotate_crop(jnp.ones((10, 10, 1)), (-100.0, 500.0), 4, 8)
    assert not far.any()


def test_jit_equals_eager_vmap_equals_loop_and_fractions_shift():
    pictures = jnp.asarray(RNG.random((3, 14, 11, 2)), jnp.float32)
    centers = jnp.asarray(RNG.uniform(2, 9, (3, 2)), jnp.float32)
    loop = np.stack([image.rotate_crop(p, c, 6, 5) for p, c in zip(pictures, centers, strict=True)])
    batched = jax.jit(jax.vmap(lambda p, c: image.rotate_crop(p, c, 6, 5)))(pictures, centers)
    np.testing.assert_allclose(batched, loop, atol=2e-5)
    between = rotate_crop(pictures[0], (7.5, 6.0), 1, 3)[0]
    sides = [rotate_crop(pictures[0], (7.5, col), 1, 3)[0] for col in (5.5, 6.5)]
    np.testing.assert_allclose(between, (sides[0] + sides[1]) / 2, atol=1e-6)


def test_gradient_reaches_the_image_and_the_centre():
    weights = jnp.asarray(RNG.random((6, 5, 5, 3)), jnp.float32)

    def loss(picture, center):
        return (image.rotate_crop(picture, center, 6, 5) * weights).sum()

    center = jnp.array([7.3, 5.4])
    picture_gradient, center_gradient = jax.grad(loss, argnums=(0, 1))(jnp.asarray(PICTURE), center)
    np.testing.assert_allclose((picture_gradient * PICTURE).sum(), loss(jnp.asarray(PICTURE), center), rtol=1e-4)  # linear in the image
    assert bool(jnp.isfinite(center_gradient).all()) and bool((center_gradient != 0).all())
