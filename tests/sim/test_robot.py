"""The arm's MuJoCo model: inertia, limits, reach, collisions and how well the joints follow a path."""

import math

import mujoco
import numpy as np
import pytest

from lala_jax import types
from lala_jax.sim import kinematics, robot

FRONT = np.append(0.0, robot.HOME[1:])


def _spec(timestep: float = 0.002) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    robot.add_ur5e(spec)
    return spec


def _posed(model: mujoco.MjModel, q: np.ndarray) -> mujoco.MjData:
    data = mujoco.MjData(model)
    robot.Arm(model).reset(data, q)
    mujoco.mj_forward(model, data)
    return data


def _workspace(z: float, step: float = 0.05) -> np.ndarray:
    spec = types.MapSpec()
    x = np.arange(spec.x[0], spec.x[1] + 1e-9, step)
    y = np.arange(spec.y[0], spec.y[1] + 1e-9, step)
    return np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), z)], -1).reshape(-1, 3)


@pytest.fixture(scope="module")
def model():
    return _spec().compile()


def test_names_limits_and_masses(model):
    assert tuple(model.joint(i).name for i in range(model.njnt)) == robot.JOINTS
    assert tuple(model.actuator(i).name for i in range(model.nu)) == robot.ACTUATORS
    assert tuple(model.geom(i).name for i in range(model.ngeom)) == robot.GEOMS
    np.testing.assert_allclose(model.jnt_range, np.stack([-kinematics.LIMITS, kinematics.LIMITS], -1))
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], [150, 150, 150, 28, 28, 28])
    links = [model.body(name).id for name in robot.LINKS]
    np.testing.assert_allclose(model.body_mass[links], [3.761, 8.058, 2.846, 1.37, 1.3, 0.365])


def test_limits_do_not_depend_on_the_unit_of_angles(model):
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    robot.add_ur5e(spec)
    np.testing.assert_allclose(spec.compile().jnt_range, model.jnt_range)


def test_inertia_is_the_published_tensor_turned_into_the_link(model):
    """Principal moments do not change when a tensor is turned; the upper arm is slim along its x axis."""
    for index, link in enumerate(robot.LINKS):
        xx, yy, zz, xy, xz, yz = robot._INERTIA[index]
        expected = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(np.sort(model.body(link).inertia), expected, rtol=1e-6)
    data = _posed(model, np.zeros(6))
    arm = model.body("upper_arm").id
    axes = data.ximat[arm].reshape(3, 3)
    assert abs(axes[0, np.argmin(model.body_inertia[arm])]) > 0.999


def test_home_is_behind_the_base(model):
    data = _posed(model, robot.HOME)
    assert data.site(robot.TIP_SITE).xpos[0] < -0.4
    np.testing.assert_allclose(data.site(robot.TIP_SITE).xmat.reshape(3, 3)[:, 2], [0, 0, -1], atol=1e-12)


def test_tip_pose_and_yaw(model):
    for xyz, yaw in [((0.5, 0.1, 0.05), 0.0), ((0.3, -0.4, 0.3), 1.0), ((0.7, 0.4, 0.0), -2.5)]:
        q = robot.tip_joints(xyz, yaw, FRONT)
        data = _posed(model, q)
        np.testing.assert_allclose(data.site(robot.TIP_SITE).xpos, xyz, atol=1e-9)
        x_axis = data.site(robot.TIP_SITE).xmat.reshape(3, 3)[:, 0]
        np.testing.assert_allclose(x_axis, [math.cos(yaw), math.sin(yaw), 0], atol=1e-9)
        assert robot.tip_yaw(q) == pytest.approx(yaw)


@pytest.mark.parametrize("z", [0.0, 0.04, 0.12])
def test_whole_workspace_is_reachable_low(z):
    assert robot.reachable(_workspace(z)).all()


@pytest.mark.parametrize("z", [0.0, 0.2, 0.32, 0.6])
def test_reachable_is_what_the_inverse_kinematics_solve(z):
    """`reachable` may only stop short of what can be solved: by the stretch it keeps in reserve."""
    for xyz in _workspace(z, step=0.1):
        q = kinematics.nearest(robot.tip_pose_target(xyz, 0.3), FRONT, branch=robot.HOME_BRANCH)
        if q is None:
            assert not robot.reachable(xyz)
            continue
        upper, fore = kinematics.A2, kinematics.A3
        stretch = math.sqrt(upper**2 + fore**2 + 2 * upper * fore * math.cos(q[2]))
        assert robot.reachable(xyz) == (stretch <= robot.MAX_STRETCH * abs(upper + fore))


def test_unreachable_arguments():
    assert robot.reachable((0.5, 0.0, 0.1)) is True
    assert robot.reachable((1.5, 0.0, 0.1)) is False
    assert robot.reachable((0.05, 0.0, 0.1)) is False
    assert not robot.reachable((math.nan, 0.0, 0.1))
    assert not robot.reachable((0.5, 0.0, 0.1), math.nan)
    assert robot.tip_joints((1.5, 0.0, 0.1), 0.0, FRONT) is None


def test_links_stay_above_the_table(model):
    """Everything but the tool keeps clear of the table at the lowest poses (bounding each link by its end spheres)."""
    moving = [i for i in range(model.ngeom) if model.geom(i).name not in (robot.TIP_GEOM, "robot_rod", "robot_mount", "robot_base")]
    for xyz in _workspace(0.0, step=0.125):
        data = _posed(model, robot.tip_joints(xyz, 0.0, FRONT))
        axis = np.abs(data.geom_xmat[moving].reshape(-1, 3, 3)[:, 2, 2])
        low = data.geom_xpos[moving, 2] - axis * model.geom_size[moving, 1] - model.geom_size[moving, 0]
        assert low.min() > 0.02, xyz


def test_links_touch_objects_and_only_the_cup_touches_the_rest():
    spec = _spec()
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=(1, 1, 0.3), pos=(0, 0, 0))
    box = spec.worldbody.add_body(name="box", pos=(0, 0, 0.5))
    box.add_freejoint()
    box.add_geom(name="box", type=mujoco.mjtGeom.mjGEOM_BOX, size=(1, 1, 0.3), mass=1, conaffinity=robot.OBJECT_CONAFFINITY)
    model = spec.compile()
    data = _posed(model, np.append(0.0, [-2.2, 1.3, -0.5, -1.5, 0.0]))
    pairs = {frozenset(model.geom(g).name for g in pair) for pair in data.contact.geom}
    assert {name for pair in pairs if "table" in pair for name in pair} <= {"table", "box", robot.TIP_GEOM}
    assert any("box" in pair and (pair & {"robot_upper_arm", "robot_elbow", "robot_forearm"}) for pair in pairs)
    assert not any(pair <= set(robot.GEOMS) for pair in pairs)


def _follow(timestep: float, targets: int) -> tuple[float, float, np.ndarray]:
    """Swing at full acceleration and speed through random targets; give the worst tip error under way and at the end, and the torques."""
    model = _spec(timestep).compile()
    data = _posed(model, robot.HOME)
    arm, tip = robot.Arm(model), data.site(robot.TIP_SITE)
    rng = np.random.default_rng(0)
    q, moving, resting, torque = robot.HOME, 0.0, 0.0, np.zeros(6)
    for _ in range(targets):
        xyz = rng.uniform((0.3, -0.4, 0.0), (0.6, 0.4, 0.3))
        goal = robot.tip_joints(xyz, rng.uniform(-3, 3), q)
        way = goal - q
        top = min((robot.MAX_SPEED / np.maximum(abs(way), 1e-9)).min(), 1e9)
        rise = (robot.MAX_ACCELERATION / np.maximum(abs(way), 1e-9)).min()
        top = min(top, math.sqrt(rise))
        ramp, end = top / rise, 1 / top + top / rise
        for step in range(math.ceil((end + 0.1) / timestep)):
            early, late = np.clip([step * timestep, end - step * timestep], 0, ramp)
            cruise = np.clip(step * timestep - ramp, 0, end - 2 * ramp)
            s = rise * early**2 / 2 + top * cruise + rise * (ramp**2 - late**2) / 2
            ds = rise * min(early, late)
            dds = rise * (float(0 <= step * timestep < ramp) - float(0 < end - step * timestep <= ramp))
            arm.command(data, q + s * way, ds * way, dds * way)
            mujoco.mj_kinematics(model, data)
            expected = kinematics.forward(q + s * way) @ [0, 0, robot.TOOL_LENGTH, 1]
            error = np.linalg.norm(tip.xpos - expected[:3])
            moving = max(moving, error)
            if step * timestep > end + 0.05:
                resting = max(resting, error)
            mujoco.mj_step(model, data)
            torque = np.maximum(torque, abs(data.qfrc_actuator[arm.dof]))
        q = goal
    return moving, resting, torque


@pytest.mark.parametrize("timestep", [0.002, 0.004])
def test_tip_follows_within_a_millimetre(timestep):
    moving, resting, torque = _follow(timestep, targets=6)
    assert moving < 1e-3
    assert resting < 2e-4
    assert (torque < robot.MAX_TORQUE - 1).all()


def test_arm_holds_still_under_its_own_weight():
    model = _spec(0.004).compile()
    q = robot.tip_joints((0.75, 0.3, 0.1), 0.0, FRONT)
    data = _posed(model, q)
    mujoco.mj_step(model, data, 500)
    np.testing.assert_allclose(data.qpos, q, atol=1e-6)
    assert abs(data.qfrc_actuator[1]) > 40  # the shoulder joint carries the arm: weights are not simply switched off


def test_arm_recovers_from_a_push():
    model = _spec(0.004).compile()
    for xyz in ((0.25, 0.0, 0.0), (0.75, 0.45, 0.1), (0.4, -0.3, 0.5)):
        q = robot.tip_joints(xyz, 0.0, FRONT)
        data = _posed(model, q)
        data.qvel[:] = (0.5, -0.5, 0.5, 1, -1, 1)
        mujoco.mj_step(model, data, 250)
        np.testing.assert_allclose(data.qpos, q, atol=1e-4)
        assert np.abs(data.qvel).max() < 1e-3
