"""Cameras that were moved without a word, found again from rendered views of both tasks; MuJoCo's scenes, SciPy's rotations."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lala_jax import types
from lala_jax.perception import calibration, noise
from lala_jax.sim import distance, render, scene, tasks

HEIGHT, WIDTH = 240, 320
FAR, WIDE = 0.03, 3.0  # a camera is moved by metres, turned by degrees
CORNERS = np.array([[x, y, 0.0, 1.0] for x in (0.25, 0.5, 0.75) for y in (-0.5, 0.0, 0.5)])  # of the workspace's table, and between


def nominal():
    return scene.cameras("ring", height=HEIGHT, width=WIDTH)


def surfaces(points):
    model, data = scene.geom_template(tasks.get("tower"))  # table and arm are the same in both tasks
    return distance.distance(model, data, points, geoms=scene.static_geoms(model))


calibrate = jax.jit(lambda depth, camera: calibration.calibrate(depth, camera, surfaces))


@functools.cache
def renderer(name):
    template = scene.geom_template(tasks.get(name))
    return jax.jit(lambda scene_, camera: render.render(*scene.place(*template, **scene_), camera, segmentation=False).depth)


def look(name, seed, when, camera):
    """Render the depth of a task's scene at its start or its goal, objects, stand and arm."""
    drawn = tasks.get(name).sample(seed)
    leaves = {"size": drawn.size, "color": drawn.color, "base": drawn.base, "poses": getattr(drawn, when)}
    return renderer(name)({key: jnp.asarray(leaf, jnp.float32) for key, leaf in leaves.items()}, camera)


def moved(camera, seed):
    """Move each camera by `FAR` metres and turn it about its eye by `WIDE` degrees, in random directions."""
    rng, poses = np.random.default_rng(seed), np.array(camera.world_from_cam, float)
    for pose in poses:
        direction, axis = rng.normal(size=(2, 3))
        pose[:3, 3] += FAR * direction / np.linalg.norm(direction)
        pose[:3, :3] = Rotation.from_rotvec(np.deg2rad(WIDE) * axis / np.linalg.norm(axis)).as_matrix() @ pose[:3, :3]
    return camera.replace(world_from_cam=jnp.asarray(poses, jnp.float32))


def errors(found, true):
    """How far, in metres, the table's points land from where they are if unprojected with the found poses: worst per view `[V]`."""
    off = np.asarray(found.world_from_cam, float) @ np.linalg.inv(np.asarray(true.world_from_cam, float))
    return np.linalg.norm((CORNERS @ np.swapaxes(off, -1, -2) - CORNERS)[..., :3], axis=-1).max(-1)


CASES = [(name, seed, when) for name in ("tower", "pallet") for seed in (11, 12, 13) for when in ("start", "goal")]


@functools.cache
def cases():
    """True cameras and what they see, the largest move in every case."""
    true = [moved(nominal(), index) for index in range(len(CASES))]
    return [(camera, look(*case, camera)) for case, camera in zip(CASES, true, strict=True)]


def test_moved_cameras_are_found_again():
    start = np.stack([errors(nominal(), true) for true, _ in cases()])
    found = np.stack([errors(calibrate(depth, nominal()), true) for true, depth in cases()])
    assert start.max() > 0.08 and np.median(start) > 0.05
    assert found.max() < 5e-4, f"{found.max() * 1e3:.2f} mm"
    assert np.median(found) < 1e-4


def test_moved_cameras_are_found_again_through_noise():
    found = []
    for index, (true, depth) in enumerate(cases()):
        noisy = noise.depth_noise(jax.random.key(index), depth, disparity=0.055 * 225)
        found.append(errors(calibrate(noisy, nominal()), true))
    found = np.stack(found)
    assert np.median(found) < 1.5e-3, f"{np.median(found) * 1e3:.2f} mm"
    assert np.quantile(found, 0.9) < 3e-3
    assert found.max() < 6e-3, f"{found.max() * 1e3:.2f} mm"  # the view that sees least of the arm


@pytest.mark.parametrize("name, seed, when", CASES[::3])
def test_a_camera_that_was_not_moved_stays(name, seed, when):
    found = calibrate(look(name, seed, when, nominal()), nominal())
    assert errors(found, nominal()).max() < 2e-4


def test_poses_stay_rigid_and_lenses_stay():
    true, depth = cases()[0]
    found = calibrate(depth, nominal())
    rotation = np.asarray(found.world_from_cam)[:, :3, :3]
    np.testing.assert_allclose(rotation @ np.swapaxes(rotation, -1, -2), np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-6)
    np.testing.assert_array_equal(np.asarray(found.world_from_cam)[:, 3], np.asarray(nominal().world_from_cam)[:, 3])
    np.testing.assert_array_equal(found.intrinsics, nominal().intrinsics)
    assert isinstance(found, types.Camera) and (found.height, found.width) == (HEIGHT, WIDTH)


def test_a_view_of_the_table_alone_keeps_x_y_and_yaw():
    model, data = scene.geom_template(tasks.get("tower"))
    true = moved(nominal(), 3)
    bare = render.background(model, data, true, geoms=(0,)).depth
    found = calibrate(bare, nominal())
    before, after = np.asarray(nominal().world_from_cam, float), np.asarray(found.world_from_cam, float)
    np.testing.assert_allclose(after[:, :2, 3], before[:, :2, 3], atol=1e-6)
    turn = Rotation.from_matrix(after[:, :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2)).as_rotvec()
    np.testing.assert_allclose(turn[:, 2], 0.0, atol=1e-5)
    assert np.abs(turn[:, :2]).max() > 0.01, "roll and pitch did move"
    off = after @ np.linalg.inv(np.asarray(true.world_from_cam, float))
    heights = (CORNERS @ np.swapaxes(off, -1, -2))[..., 2]
    np.testing.assert_allclose(heights, 0.0, atol=3e-4)


def test_a_blind_view_and_one_moved_too_far_keep_the_nominal_pose():
    true, depth = cases()[1]
    depth = depth.at[2].set(0.0)
    found = calibrate(depth, nominal())
    np.testing.assert_array_equal(found.world_from_cam[2], nominal().world_from_cam[2])
    assert errors(found, true)[[0, 1, 3]].max() < 5e-4
    timid = jax.jit(lambda depth: calibration.calibrate(depth, nominal(), surfaces, limit=(0.01, 0.01)))(depth)
    np.testing.assert_array_equal(timid.world_from_cam, nominal().world_from_cam)


def test_pixels_that_were_not_measured_do_not_count():
    """Not a number, infinite and below 0 are 0, as in the map; millimetres are refused."""
    true, depth = cases()[1]
    blank = depth.at[:, :9].set(0.0)
    for hole in (jnp.nan, jnp.inf, -1.0):
        found = calibrate(depth.at[:, :9].set(hole), nominal())
        np.testing.assert_array_equal(found.world_from_cam, calibrate(blank, nominal()).world_from_cam)
    assert errors(found, true).max() < 1e-3
    with pytest.raises(ValueError, match="depth must be floating point, metres, got uint16"):
        calibration.calibrate((1000 * depth).astype(jnp.uint16), nominal(), surfaces)


def test_jit_equals_eager_and_vmap_equals_a_loop():
    pairs = cases()[:2]
    loop = [calibrate(depth, nominal()).world_from_cam for _, depth in pairs]
    eager = calibration.calibrate(pairs[0][1], nominal(), surfaces).world_from_cam
    np.testing.assert_allclose(eager, loop[0], atol=2e-5)
    many = jax.jit(jax.vmap(lambda depth: calibration.calibrate(depth, nominal(), surfaces)))(jnp.stack([depth for _, depth in pairs]))
    np.testing.assert_allclose(many.world_from_cam, jnp.stack(loop), atol=2e-5)
    for view in range(4):
        camera = jax.tree.map(lambda leaf, view=view: leaf[view : view + 1], nominal())
        alone = calibrate(pairs[0][1][view : view + 1], camera).world_from_cam
        np.testing.assert_allclose(alone[0], loop[0][view], atol=2e-5)


def test_shapes_are_named():
    with pytest.raises(ValueError, match=r"\(4, 240, 320\).*\(4, 240, 319\)"):
        calibration.calibrate(jnp.ones((4, 240, 319)), nominal(), surfaces)
