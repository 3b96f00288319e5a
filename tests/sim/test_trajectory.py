import numpy as np
import pytest
from scipy import interpolate

from lala_jax.sim import kinematics, robot, trajectory

TICK = 0.008
SPEED, ACCELERATION = np.array([3.0, 2.0, 4.0]), np.array([10.0, 14.0, 20.0])


def knots(seed, count, joints=3):
    return np.random.default_rng(seed).normal(size=(count, joints)).cumsum(0)


def plan(points):
    return trajectory.plan(points, tick=TICK, max_speed=SPEED, max_acceleration=ACCELERATION)


@pytest.mark.parametrize("count", [2, 3, 7])
def test_plan_follows_the_natural_spline_from_end_to_end(count):
    points = knots(count, count)
    result = plan(points)
    np.testing.assert_allclose(result.position[-1], points[-1], atol=1e-9)
    np.testing.assert_allclose(result.velocity[-1], 0.0, atol=1e-9)
    if count > 2:
        reference = interpolate.CubicSpline(np.arange(count), points, bc_type="natural")(np.linspace(0, count - 1, 5001))
    else:
        reference = np.linspace(points[0], points[1], 5001)
    distance = np.abs(result.position[:, None] - reference[None]).max(-1).min(-1)
    assert distance.max() < 2e-3  # the reference is that coarse


@pytest.mark.parametrize("count", [2, 3, 7])
def test_plan_keeps_its_bounds_and_comes_close_to_one_of_them(count):
    points = knots(10 + count, count)
    result = plan(points)
    speed, acceleration = np.abs(result.velocity) / SPEED, np.abs(result.acceleration) / ACCELERATION
    assert max(speed.max(), acceleration.max()) <= 1.02  # bounds are checked at 65 samples of the path
    assert max(speed.max(), acceleration.max()) > 0.9


def test_velocity_and_acceleration_are_derivatives():
    result = plan(knots(3, 5))
    np.testing.assert_allclose(np.gradient(result.position, TICK, axis=0)[1:-1], result.velocity[1:-1], atol=0.02)
    np.testing.assert_allclose(np.gradient(result.velocity, TICK, axis=0)[1:-1], result.acceleration[1:-1], atol=0.4)


def test_creep_keeps_an_even_pace():
    result = trajectory.creep(np.array([[0.0, 1.0], [1.0, 0.0]]), tick=0.1, duration=1.0)
    assert len(result) == 10
    np.testing.assert_allclose(result.position[:, 0], np.arange(1, 11) / 10)
    np.testing.assert_allclose(result.velocity, np.tile([1.0, -1.0], (10, 1)))


def test_no_motion_takes_no_time_and_bad_knots_are_refused():
    assert len(plan(np.ones((4, 3)))) == 0
    with pytest.raises(ValueError, match="knots"):
        plan(np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match="K >= 2"):
        plan(np.ones((1, 3)))


def test_tip_path_swings_around_the_base():
    start, end = np.array([0.0, -0.5, 0.3, 0.0]), np.array([0.0, 0.5, 0.3, 1.0])
    path = trajectory.tip_path(start, end, spacing=0.05)
    np.testing.assert_allclose(path[[0, -1]], [start, end], atol=1e-12)
    np.testing.assert_allclose(np.hypot(path[:, 0], path[:, 1]), 0.5)
    assert path[len(path) // 2, 0] > 0.4


def test_joints_along_a_path_put_the_tip_on_it():
    start, end = np.array([0.45, -0.3, 0.3, 0.2]), np.array([0.6, 0.3, 0.35, -2.0])
    path = trajectory.tip_path(start, end, spacing=0.05)
    first = trajectory.joints_from_home(start)[1]
    joints = trajectory.joints_along(path, first)
    for pose, q in zip(path, joints, strict=True):
        np.testing.assert_allclose(kinematics.forward(q), robot.tip_pose_target(pose[:3], pose[3]), atol=1e-9)
    assert np.abs(np.diff(joints, axis=0)).max() < 0.8


def test_out_of_reach_is_none():
    far = np.array([2.0, 0.0, 0.1, 0.0])
    assert trajectory.joints_from_home(far) is None
    assert trajectory.joints_along(np.stack([far, far]), robot.HOME) is None
    assert trajectory.above(far[:3], 0.0, heights=(0.3, 0.1)) is None
    near = trajectory.above(np.array([0.5, 0.0, 0.1]), 0.5, heights=(3.0, 0.2))
    np.testing.assert_allclose(near, [0.5, 0.0, 0.3, 0.5])
