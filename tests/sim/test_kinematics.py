"""The closed-form kinematics against an independent solver, against MuJoCo, and against themselves."""

import itertools
import math

import mujoco
import numpy as np
import pytest
import ur_analytic_ik

from lala_jax.sim import kinematics, robot

SAMPLES = 100


def _joints(seed: int, count: int = SAMPLES) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-kinematics.LIMITS, kinematics.LIMITS, (count, 6))


def _turned_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Give the angles between `a` and `b`, whole turns left out."""
    return np.abs(np.angle(np.exp(1j * (a - b))))


def test_forward_matches_independent_solver():
    for q in _joints(0):
        expected = kinematics.WORLD_FROM_BASE @ ur_analytic_ik.ur5e.forward_kinematics(*q)
        np.testing.assert_allclose(kinematics.forward(q), expected, atol=1e-9)


def test_forward_matches_mujoco():
    spec = mujoco.MjSpec()
    robot.add_ur5e(spec)
    model = spec.compile()
    data = mujoco.MjData(model)
    for q in _joints(1):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        flange = kinematics.forward(q)
        np.testing.assert_allclose(data.body("wrist_3").xpos, flange[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.body("wrist_3").xmat.reshape(3, 3), flange[:3, :3], atol=1e-9)


def test_forward_by_hand():
    """Stretched out at q = 0 the arm points along +x, the flange sideways along +y."""
    flange = kinematics.forward(np.zeros(6))
    np.testing.assert_allclose(flange[:3, 3], [0.425 + 0.3922, 0.1333 + 0.0996, 0.1625 - 0.0997], atol=1e-12)
    np.testing.assert_allclose(flange[:3, 2], [0, 1, 0], atol=1e-12)


def test_inverse_has_the_eight_branches_of_the_independent_solver():
    counts = set()
    for q in _joints(2):
        pose = kinematics.forward(q)
        ours = kinematics.inverse(pose, np.zeros(6))
        ours = ours[~np.isnan(ours).any(-1)]
        theirs = np.array(ur_analytic_ik.ur5e.inverse_kinematics(np.ascontiguousarray(kinematics.WORLD_FROM_BASE.T @ pose)))
        counts.add(len(ours))
        assert len(ours) == len(theirs)
        distance = _turned_apart(ours[:, None], theirs[None]).max(-1)
        assert distance.min(0).max() < 1e-6 and distance.min(1).max() < 1e-6
    assert 8 in counts


def test_inverse_reaches_the_pose_and_finds_the_joints():
    for q in _joints(3):
        pose = kinematics.forward(q)
        solutions = kinematics.inverse(pose, q)
        found = ~np.isnan(solutions).any(-1)
        assert (np.isnan(solutions).all(-1) == ~found).all()
        for solution in solutions[found]:
            np.testing.assert_allclose(kinematics.forward(solution), pose, atol=1e-7)
        np.testing.assert_allclose(solutions[kinematics.branch_of(q)], q, atol=1e-6)
        np.testing.assert_allclose(kinematics.nearest(pose, q), q, atol=1e-6)


def test_branches_keep_their_order():
    """The index tells the signs of wrist 2 and of the elbow."""
    for q in _joints(4):
        index = kinematics.branch_of(q)
        assert index // 2 % 2 == (math.sin(q[4]) < 0)
        assert index % 2 == (math.sin(q[2]) < 0)


def test_angles_are_the_nearest_within_the_limits():
    turns = 2 * math.pi * np.array([-2, -1, 0, 1, 2])
    for q, near in zip(_joints(5, 30), _joints(6, 30), strict=True):
        solutions = kinematics.inverse(kinematics.forward(q), near)
        for solution in solutions[~np.isnan(solutions).any(-1)]:
            assert (np.abs(solution) <= kinematics.LIMITS + 1e-8).all()
            for joint, angle in enumerate(solution):
                allowed = [angle + turn for turn in turns if abs(angle + turn) <= kinematics.LIMITS[joint]]
                assert min(abs(other - near[joint]) for other in allowed) >= abs(angle - near[joint]) - 1e-9


def test_nearest_moves_the_slowest_joint_least():
    for q, near in zip(_joints(7, 30), _joints(8, 30), strict=True):
        pose = kinematics.forward(q)
        chosen = np.abs(kinematics.nearest(pose, near) - near).max()
        for index in range(kinematics.BRANCHES):
            solution = kinematics.nearest(pose, near, branch=index)
            if solution is not None:
                assert np.abs(solution - near).max() >= chosen - 1e-9


def test_nearest_follows_a_straight_line_without_jumps():
    start, end = np.array([0.3, -0.4, 0.05]), np.array([0.7, 0.4, 0.2])
    q = robot.tip_joints(start, 0.0, np.append(0.0, robot.HOME[1:]))
    for share in np.linspace(0, 1, 200):
        step = robot.tip_joints(start + share * (end - start), share, q)
        assert np.abs(step - q).max() < 0.05
        q = step


def test_wrist_singularity_keeps_the_last_joint():
    q = np.array([0.3, -1.2, 1.1, 0.4, 0.0, 0.7])
    pose = kinematics.forward(q)
    np.testing.assert_allclose(kinematics.forward(kinematics.nearest(pose, q)), pose, atol=1e-6)


@pytest.mark.parametrize("xyz", [(2.0, 0.0, 0.3), (0.05, 0.05, 0.3)], ids=["too far", "too close to the pan axis"])
def test_out_of_reach_is_none(xyz):
    pose = robot.tip_pose_target(xyz, 0.0)
    assert np.isnan(kinematics.inverse(pose, robot.HOME)).all()
    assert kinematics.nearest(pose, robot.HOME) is None
    assert kinematics.nearest(pose, robot.HOME, branch=robot.HOME_BRANCH) is None


def test_wrong_arguments_are_named():
    pose = kinematics.forward(robot.HOME)
    with pytest.raises(ValueError, match="world_from_flange"):
        kinematics.inverse(pose * np.nan, robot.HOME)
    with pytest.raises(ValueError, match="q_near"):
        kinematics.nearest(pose, robot.HOME[:5])
    for branch in (-1, 8):
        with pytest.raises(ValueError, match=r"0\.\.7"):
            kinematics.nearest(pose, robot.HOME, branch=branch)


def test_singular_and_extreme_poses_never_raise():
    """Corners of the joint box and multiples of a quarter turn: every solution given reaches its pose."""
    angles = (-math.pi, -math.pi / 2, 0.0, math.pi / 2, math.pi)
    for q in itertools.islice(itertools.product(angles, repeat=6), 0, None, 97):
        pose = kinematics.forward(q)
        solutions = kinematics.inverse(pose, np.array(q))
        for solution in solutions[~np.isnan(solutions).any(-1)]:
            np.testing.assert_allclose(kinematics.forward(solution), pose, atol=1e-5)
