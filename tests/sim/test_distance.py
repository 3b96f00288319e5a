"""Signed distances against MuJoCo's own, against its rays, and against finite differences."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from lala_jax.sim import distance, scene, tasks

KINDS = ("box", "sphere", "capsule", "cylinder")
TINY = 1e-5  # radius of the sphere that MuJoCo measures from, metres


def build(kinds, seed, plane=True):
    """Compile one random geom of each kind, a plane under them, and a tiny free sphere, the last geom."""
    rng = np.random.default_rng(seed)
    text = " ".join
    lines = ['<geom type="plane" size="0 0 1" pos="0 0 -.1" quat="1 .1 -.05 0"/>'] if plane else []
    for kind in kinds:
        size, pos, quat = rng.uniform(0.03, 0.2, 3), rng.uniform(-0.4, 0.4, 3), rng.normal(size=4)
        lines.append(f'<geom type="{kind}" size="{text(map(str, size))}" pos="{text(map(str, pos))}" quat="{text(map(str, quat))}"/>')
    probe = f'<body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom type="sphere" size="{TINY}"/></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(lines)}{probe}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def measured(model, data, points, geoms):
    """Distance of each point to each geom by mj_geomDistance from a tiny sphere, `[P, G]`."""
    probe, out = model.ngeom - 1, np.zeros((len(points), len(geoms)))
    for i, point in enumerate(points):
        data.qpos[:3] = point
        mujoco.mj_kinematics(model, data)
        for j, geom in enumerate(geoms):
            out[i, j] = mujoco.mj_geomDistance(model, data, probe, geom, 10.0, None) + TINY
    return out


def ours(model, data, points, geoms):
    mjx_model, mjx_data = mjx.put_model(model), mjx.put_data(model, data)
    return np.asarray(distance.distance(mjx_model, mjx_data, jnp.asarray(points, jnp.float32), geoms=geoms))


@pytest.mark.parametrize("kind", ["plane", *KINDS])
def test_every_shape_agrees_with_mujoco_outside(kind):
    for seed in range(3):
        model, data = build(() if kind == "plane" else (kind,), seed, plane=kind == "plane")
        points = np.random.default_rng(seed).uniform(-0.8, 0.8, (300, 3))
        expected = measured(model, data, points, (0,))[:, 0]
        outside = expected > 0
        assert outside.sum() > 100
        got = ours(model, data, points, (0,))
        np.testing.assert_allclose(got[outside], expected[outside], atol=2e-5)
        assert (got[expected < -1e-4] < 0).all() and (got[outside] > -2e-5).all()


def corners(kind, size, rng, count):
    """Dense points on the surface of a shape in its own frame, drawn without a distance function."""
    if kind == "sphere":
        unit = rng.normal(size=(count, 3))
        return size[0] * unit / np.linalg.norm(unit, axis=1, keepdims=True)
    if kind == "box":
        points, face = rng.uniform(-1, 1, (count, 3)), rng.integers(0, 6, count)
        points[np.arange(count), face % 3] = np.where(face < 3, 1, -1)
        return points * size
    angle, along = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count) * size[1]
    wall = np.column_stack([size[0] * np.cos(angle), size[0] * np.sin(angle), along])
    if kind == "cylinder":
        radius = size[0] * np.sqrt(rng.uniform(0, 1, count))
        caps = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), size[1] * rng.choice([-1, 1], count)])
    else:
        unit = rng.normal(size=(count, 3))
        unit *= size[0] / np.linalg.norm(unit, axis=1, keepdims=True)
        caps = unit + np.array([0, 0, 1]) * (np.sign(unit[:, 2:]) * size[1])
    return np.concatenate([wall, caps])


@pytest.mark.parametrize("kind", KINDS)
def test_every_shape_agrees_with_a_sampled_surface_inside_and_outside(kind):
    model, data = build((kind,), 5, plane=False)
    rng = np.random.default_rng(0)
    rotation, size = data.geom_xmat[0].reshape(3, 3), model.geom_size[0]
    surface = corners(kind, size, rng, 40000)
    reach = 1.3 * np.abs(surface).max(0)
    local = rng.uniform(-reach, reach, (200, 3))
    nearest = np.array([np.linalg.norm(surface - point, axis=1).min() for point in local])
    got = ours(model, data, data.geom_xpos[0] + local @ rotation.T, (0,))
    assert (got < -0.005).sum() > 20 and (got > 0.005).sum() > 20
    np.testing.assert_allclose(np.abs(got), nearest, atol=3e-3)  # the samples are about 2 mm apart
    assert (np.abs(got) <= nearest + 1e-5).all(), "no sample is nearer than the surface"
    np.testing.assert_allclose(ours(model, data, data.geom_xpos[0] + surface @ rotation.T, (0,)), 0.0, atol=1e-6)


def test_the_nearest_of_several_geoms_and_only_of_those_asked_for():
    model, data = build(KINDS * 2, 1)
    points = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 3))
    geoms = (0, 3, 1, 8, 6)
    each = measured(model, data, points, geoms)
    outside = (each > 0).all(1)
    np.testing.assert_allclose(ours(model, data, points, geoms)[outside], each.min(1)[outside], atol=2e-5)
    loop = np.stack([ours(model, data, points, (geom,)) for geom in geoms])
    np.testing.assert_array_equal(ours(model, data, points, geoms), loop.min(0))


def test_gradient_is_a_unit_normal_and_finite_on_axes_and_centres():
    model, data = build(KINDS, 2)
    model, data = mjx.put_model(model), mjx.put_data(model, data)
    points = jnp.asarray(np.random.default_rng(2).uniform(-0.8, 0.8, (300, 3)), jnp.float32)

    def total(points):
        return distance.distance(model, data, points, geoms=tuple(range(5))).sum()

    normal = np.asarray(jax.grad(total)(points))
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-4)
    back = points - normal * distance.distance(model, data, points, geoms=tuple(range(5)))[:, None]
    gap = np.asarray(distance.distance(model, data, back, geoms=tuple(range(5))))
    assert np.median(np.abs(gap)) < 1e-6, "a step along the normal lands on the surface"
    assert np.isfinite(jax.grad(total)(data.geom_xpos[:5])).all()


@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_what_mujoco_rays_hit_of_the_table_and_the_arm_is_on_the_surface(name):
    task = tasks.get(name)
    model, data = scene.geom_template(task)
    fixed = scene.static_geoms(model)
    plain = scene.build_model(task, task.sample(0))
    state = mujoco.MjData(plain)
    state.geom_xpos[:], state.geom_xmat[:] = data.geom_xpos, np.asarray(data.geom_xmat).reshape(-1, 9)
    shapes = [(state.geom_xpos[g], state.geom_xmat[g], plain.geom_size[g], plain.geom_type[g]) for g in fixed]
    rng, hits = np.random.default_rng(3), []
    eye = np.array([0.3, -0.9, 0.8])
    for geom in fixed:
        for _ in range(20):
            ray = np.asarray(data.geom_xpos[geom], float) + rng.normal(size=3) * 0.05 - eye
            far = [mujoco.mju_rayGeom(*at, eye, ray, kind, None) for *at, kind in shapes]  # -1: missed
            far = min((value for value in far if value >= 0), default=None)
            if far is not None:
                hits.append(eye + far * ray)
    assert len(hits) > 100
    points = jnp.asarray(np.array(hits), jnp.float32)
    np.testing.assert_allclose(distance.distance(model, data, points, geoms=fixed), 0.0, atol=2e-6)


def test_jit_equals_eager_and_vmap_a_loop():
    model, data = build(KINDS, 4)
    model, data = mjx.put_model(model), mjx.put_data(model, data)
    clouds = jnp.asarray(np.random.default_rng(4).uniform(-0.8, 0.8, (3, 50, 3)), jnp.float32)

    def run(points):
        return distance.distance(model, data, points, geoms=(0, 1, 2, 3, 4))

    loop = np.stack([run(cloud) for cloud in clouds])
    np.testing.assert_allclose(np.stack([jax.jit(run)(cloud) for cloud in clouds]), loop, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(run)(clouds), loop, atol=1e-6)


def test_errors_name_what_is_wrong():
    model, data = build(("box", "ellipsoid"), 0)
    model, data = mjx.put_model(model), mjx.put_data(model, data)
    points = jnp.zeros((4, 3))
    with pytest.raises(ValueError, match="geom 2 is of mjtGeom type 4 .ellipsoid.*plane, sphere, capsule, cylinder, box"):
        distance.distance(model, data, points, geoms=(0, 1, 2))
    with pytest.raises(ValueError, match="geom 9 is not in the model"):
        distance.distance(model, data, points, geoms=(9,))
    with pytest.raises(ValueError, match="at least one geom"):
        distance.distance(model, data, points, geoms=())
    with pytest.raises(ValueError, match=r"\[P, 3\].*\(2, 4, 3\)"):
        distance.distance(model, data, jnp.zeros((2, 4, 3)), geoms=(0,))
