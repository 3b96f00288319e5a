"""Rotations and poses against scipy and homogeneous matrices; every function jitted, vmapped and on plain numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import transform as scipy_transform

from lala_jax.perception import transforms

RNG = np.random.default_rng(0)
QUATS = transforms.quat_normalize(RNG.normal(size=(6, 4)))
OTHER = transforms.quat_normalize(RNG.normal(size=(6, 4)))
POINTS = RNG.normal(size=(6, 3))
POSES = np.concatenate([RNG.normal(size=(6, 3)), QUATS], axis=-1)
OTHER_POSES = np.concatenate([RNG.normal(size=(6, 3)), OTHER], axis=-1)
PLANAR = RNG.uniform(-3, 3, (6, 3))
OTHER_PLANAR = RNG.uniform(-3, 3, (6, 3))


def rotation(quat):
    return scipy_transform.Rotation.from_quat(np.roll(quat, -1, axis=-1))


def planar_matrix(motion):
    x, y, yaw = motion
    return np.array([[np.cos(yaw), -np.sin(yaw), x], [np.sin(yaw), np.cos(yaw), y], [0, 0, 1]])


CASES = {
    "wrap_angle": (PLANAR[:, 0] * 5, np.full(6, np.pi / 2)),
    "quat_normalize": (QUATS * 3,),
    "quat_multiply": (QUATS, OTHER),
    "quat_inverse": (QUATS,),
    "quat_from_yaw": (PLANAR[:, 2],),
    "yaw_from_quat": (QUATS,),
    "matrix_from_quat": (QUATS,),
    "quat_from_matrix": (rotation(QUATS).as_matrix(),),
    "rotate": (QUATS, POINTS),
    "pose_from": (POINTS, QUATS),
    "pose_from_yaw": (POINTS, PLANAR[:, 2]),
    "pose_multiply": (POSES, OTHER_POSES),
    "pose_inverse": (POSES,),
    "apply_pose": (POSES, POINTS),
    "matrix_from_pose": (POSES,),
    "pose_from_matrix": (transforms.matrix_from_pose(POSES),),
    "matrix_inverse": (transforms.matrix_from_pose(POSES),),
    "apply_matrix": (transforms.matrix_from_pose(POSES), POINTS),
    "se2_multiply": (PLANAR, OTHER_PLANAR),
    "se2_inverse": (PLANAR,),
    "apply_se2": (PLANAR, POINTS[:, :2]),
    "pose_from_se2": (PLANAR,),
    "se2_about": (PLANAR[:, :2], PLANAR[:, 2], OTHER_PLANAR[:, :2]),
}


@pytest.mark.parametrize("name", CASES)
def test_numpy_loop_equals_jit_of_vmap(name):
    function, arguments = getattr(transforms, name), CASES[name]
    loop = np.stack([function(*(a[i] for a in arguments)) for i in range(6)])
    assert loop.dtype == np.float64, "numpy in float64 must stay there"
    batched = jax.jit(jax.vmap(function))(*(jnp.asarray(a, jnp.float32) for a in arguments))
    assert isinstance(batched, jax.Array) and batched.dtype == jnp.float32
    np.testing.assert_allclose(batched, loop, atol=2e-5)


@pytest.mark.parametrize("name", [name for name in CASES if name != "apply_matrix"])
def test_leading_dimensions_equal_a_loop_and_gradients_are_finite(name):
    function, arguments = getattr(transforms, name), CASES[name]
    loop = np.stack([function(*(a[i] for a in arguments)) for i in range(6)])
    np.testing.assert_allclose(function(*arguments), loop, atol=1e-12)
    arrays = tuple(jnp.asarray(a, jnp.float32) for a in arguments)
    gradient = jax.grad(lambda args: function(*args).sum())(arrays)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))


def test_public_functions_all_have_a_case():
    helpers = {"to_arrays", "same_batch"}
    public = {
        name
        for name, value in vars(transforms).items()
        if callable(value) and getattr(value, "__module__", "") == transforms.__name__ and name[0] != "_"
    }
    assert public - helpers == set(CASES)


def test_quaternions_agree_with_scipy():
    np.testing.assert_allclose(transforms.matrix_from_quat(QUATS), rotation(QUATS).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(transforms.rotate(QUATS, POINTS), rotation(QUATS).apply(POINTS), atol=1e-12)
    product = (rotation(QUATS) * rotation(OTHER)).as_matrix()
    np.testing.assert_allclose(transforms.matrix_from_quat(transforms.quat_multiply(QUATS, OTHER)), product, atol=1e-12)
    np.testing.assert_allclose(transforms.yaw_from_quat(QUATS), rotation(QUATS).as_euler("ZYX")[:, 0], atol=1e-12)
    np.testing.assert_allclose(transforms.matrix_from_quat(3 * QUATS), rotation(QUATS).as_matrix(), atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_quat_from_matrix_inverts_matrix_from_quat(quat):
    quat = transforms.quat_normalize(np.array(quat))
    back = transforms.quat_from_matrix(transforms.matrix_from_quat(quat))
    assert back[0] >= 0
    np.testing.assert_allclose(back * np.sign(back @ quat), quat, atol=1e-7)


@pytest.mark.parametrize("axis", range(3))
def test_quat_from_matrix_holds_at_half_turns(axis):
    quat = np.eye(4)[axis + 1]
    back = transforms.quat_from_matrix(transforms.matrix_from_quat(quat))
    np.testing.assert_allclose(abs(back), quat, atol=1e-12)


def test_normalising_zero_gives_the_identity_with_a_finite_gradient():
    zero = jnp.zeros(4)
    np.testing.assert_array_equal(transforms.quat_normalize(zero), [1, 0, 0, 0])
    assert bool(jnp.isfinite(jax.grad(lambda q: transforms.quat_normalize(q).sum())(zero)).all())


def test_poses_agree_with_homogeneous_matrices():
    matrix, other = transforms.matrix_from_pose(POSES), transforms.matrix_from_pose(OTHER_POSES)
    np.testing.assert_allclose(transforms.matrix_from_pose(transforms.pose_multiply(POSES, OTHER_POSES)), matrix @ other, atol=1e-12)
    np.testing.assert_allclose(transforms.matrix_from_pose(transforms.pose_inverse(POSES)), np.linalg.inv(matrix), atol=1e-12)
    np.testing.assert_allclose(transforms.matrix_inverse(matrix), np.linalg.inv(matrix), atol=1e-12)
    homogeneous = np.concatenate([POINTS, np.ones((6, 1))], axis=-1)
    np.testing.assert_allclose(transforms.apply_pose(POSES, POINTS), (matrix @ homogeneous[..., None])[:, :3, 0], atol=1e-12)
    np.testing.assert_allclose(transforms.apply_matrix(matrix[0], POINTS), (homogeneous @ matrix[0].T)[:, :3], atol=1e-12)


def test_planar_motions_agree_with_matrices_and_with_poses():
    for a, b, point in zip(PLANAR, OTHER_PLANAR, POINTS, strict=True):
        np.testing.assert_allclose(planar_matrix(transforms.se2_multiply(a, b)), planar_matrix(a) @ planar_matrix(b), atol=1e-12)
        np.testing.assert_allclose(planar_matrix(transforms.se2_inverse(a)), np.linalg.inv(planar_matrix(a)), atol=1e-12)
        moved = transforms.apply_pose(transforms.pose_from_se2(a), point)
        np.testing.assert_allclose(moved, [*(planar_matrix(a) @ [*point[:2], 1])[:2], point[2]], atol=1e-12)


def test_turning_about_a_centre_moves_the_centre_by_the_shift_only():
    motion = transforms.se2_about(PLANAR[:, :2], PLANAR[:, 2], OTHER_PLANAR[:, :2])
    np.testing.assert_allclose(transforms.apply_se2(motion, PLANAR[:, :2]), PLANAR[:, :2] + OTHER_PLANAR[:, :2], atol=1e-12)
    np.testing.assert_allclose(motion[:, 2], PLANAR[:, 2])


@settings(max_examples=30, deadline=None)
@given(st.floats(-50, 50), st.sampled_from([np.pi / 2, np.pi, 2 * np.pi]))
def test_wrapped_angles_are_small_and_equivalent(angle, period):
    wrapped = transforms.wrap_angle(angle, period)
    assert abs(wrapped) <= period / 2 + 1e-9
    assert abs((angle - wrapped) / period - round((angle - wrapped) / period)) < 1e-9


def test_batch_dimensions_broadcast_and_sequences_are_taken():
    pose = transforms.pose_from_yaw([0.5, 0.0, 0.1], 0.0)
    assert pose.tolist() == [0.5, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0]
    cloud = transforms.apply_pose(POSES[:, None], POINTS[None])
    assert cloud.shape == (6, 6, 3)
    np.testing.assert_allclose(cloud[2, 3], transforms.apply_pose(POSES[2], POINTS[3]))
