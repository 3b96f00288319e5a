"""Scenes: MuJoCo models rest where the tasks say, cameras see the workspace, and `place` equals MuJoCo's own kinematics."""

from __future__ import annotations

import jax
import mujoco
import numpy as np
import pytest

from lala_jax import types
from lala_jax.perception import camera as pinhole
from lala_jax.sim import oracle, robot, tasks
from lala_jax.sim import scene as scenes


@pytest.fixture(scope="module", params=tasks.names())
def task(request):
    return tasks.get(request.param)


def at_home(model):
    data = mujoco.MjData(model)
    robot.Arm(model).reset(data)
    return data


def stepped(model, data, seconds):
    mujoco.mj_step(model, data, nstep=round(seconds / model.opt.timestep))
    return np.concatenate([data.joint(f"object{i}").qpos[None] for i in range(len(scenes.object_geoms(model)))])


@pytest.mark.parametrize("seed", [0, 5])
def test_objects_rest_at_their_start_and_goal_poses(task, seed):
    scene = task.sample(seed)
    for poses in (scene.start, scene.goal):
        model = scenes.build_model(task, scene.replace(start=poses))
        settled = stepped(model, at_home(model), 1.0)
        assert np.abs(settled[:, :3] - poses[:, :3]).max() < 1e-4
        assert np.abs(np.abs((settled[:, 3:] * poses[:, 3:]).sum(-1)) - 1).max() < 1e-5
    assert oracle.score(task, scene, settled) == 100.0


def test_a_model_holds_the_scene(task):
    scene = task.sample(4)
    model = scenes.build_model(task, scene)
    objects = list(scenes.object_geoms(model))
    assert [model.geom(i).name for i in objects] == [f"object{i}" for i in range(task.num_objects)]
    np.testing.assert_allclose(model.geom_size[objects] * 2, scene.size, rtol=1e-6)
    np.testing.assert_allclose(model.geom_rgba[objects, :3], scene.color, rtol=1e-6)
    np.testing.assert_allclose([model.body(f"object{i}").mass[0] for i in range(len(objects))], task.object_mass(scene), rtol=1e-6)
    np.testing.assert_allclose(model.geom("base").size * 2, task.base_size)
    np.testing.assert_allclose(model.opt.gravity, [0, 0, -9.81])
    np.testing.assert_allclose(model.geom_friction[objects, 0], 1.0)
    assert not model.eq_active0.any() and model.neq == task.num_objects
    everything = {*objects, scenes.base_geom(model), *scenes.static_geoms(model)}
    assert everything == set(range(model.ngeom)) and len(scenes.static_geoms(model)) == model.ngeom - task.num_objects - 1
    np.testing.assert_allclose(model.light_dir[0], -np.array(scenes.LIGHT_DIR))
    assert np.linalg.norm(scenes.LIGHT_DIR) == pytest.approx(1.0) and scenes.AMBIENT + scenes.DIFFUSE == 1.0


def test_place_equals_a_fresh_model(task):
    canvas = scenes.geom_template(task)
    batch = [task.sample(seed) for seed in (1, 2, 3)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *batch)

    def look(scene):
        model, data = scenes.place(*canvas, size=scene.size, color=scene.color, poses=scene.goal, base=scene.base)
        return model.geom_size, model.geom_rgba, model.geom_rbound, data.geom_xpos, data.geom_xmat

    placed = jax.jit(jax.vmap(look))(stacked)
    for i, scene in enumerate(batch):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), look(scene), tuple(leaf[i] for leaf in placed))
        model = scenes.build_model(task, scene.replace(start=scene.goal))
        data = at_home(model)
        mujoco.mj_forward(model, data)
        fresh = (model.geom_size, model.geom_rgba, model.geom_rbound, data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3))
        for ours, mujocos in zip(placed, fresh, strict=True):
            np.testing.assert_allclose(ours[i], mujocos, atol=2e-6)


def test_place_refuses_a_batch(task):
    scene = jax.tree.map(lambda leaf: leaf[None], task.sample(0))
    with pytest.raises(ValueError, match="unbatched"):
        scenes.place(*scenes.geom_template(task), size=scene.size, color=scene.color, poses=scene.goal, base=scene.base)


def test_a_template_first_asked_for_inside_jit_keeps_no_tracers():
    task = tasks.get("tower", num_objects=2)

    def height(poses):
        scene = task.sample(0)
        _, data = scenes.place(*scenes.geom_template(task), size=scene.size, color=scene.color, poses=poses, base=scene.base)
        return data.geom_xpos[:, 2].sum()

    poses = task.sample(0).goal
    np.testing.assert_allclose(jax.jit(height)(poses), height(poses), rtol=1e-6)


@pytest.mark.parametrize(("preset", "target"), [("ring", [0.5, 0.0, 0.0]), ("paper", [0.25, 0.0, 0.0])])
def test_cameras_look_at_the_target_from_their_ring(preset, target):
    camera = scenes.cameras(preset)
    eye = np.asarray(camera.world_from_cam)[:, :3, 3] - target
    np.testing.assert_allclose(np.hypot(eye[:, 0], eye[:, 1]), 0.75, atol=1e-6)
    np.testing.assert_allclose(eye[:, 2], 0.75)
    uv, depth = jax.vmap(lambda c: pinhole.project(np.array(target, np.float32), c))(camera)
    np.testing.assert_allclose(uv, np.tile([320, 240], (4, 1)), atol=1e-3)
    np.testing.assert_allclose(depth, 0.75 * np.sqrt(2), rtol=1e-5)
    small = scenes.cameras(preset, height=120, width=160)
    np.testing.assert_allclose(small.intrinsics[0], [[112.5, 0, 80], [0, 112.5, 60], [0, 0, 1]])


def test_every_point_of_the_workspace_is_in_two_default_images():
    spec = types.MapSpec()
    grid = np.meshgrid(np.linspace(*spec.x, 9), np.linspace(*spec.y, 17), np.linspace(*spec.z, 5))
    points = np.stack(grid, -1).reshape(-1, 3).astype(np.float32)

    def seen(camera):
        return pinhole.in_image(*pinhole.project(points, camera), camera)

    assert np.asarray(jax.vmap(seen)(scenes.cameras())).sum(0).min() >= 2


def test_mujoco_has_the_same_cameras():
    task = tasks.get("tower")
    camera = scenes.cameras("ring", height=240, width=320)
    model = scenes.build_model(task, task.sample(0), cameras=camera)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.ncam == 4
    for i, world_from_cam in enumerate(np.asarray(camera.world_from_cam)):
        np.testing.assert_allclose(data.cam_xpos[i], world_from_cam[:3, 3], atol=1e-6)
        turned = data.cam_xmat[i].reshape(3, 3) @ np.diag([1, -1, -1])
        np.testing.assert_allclose(turned, world_from_cam[:3, :3], atol=1e-6)
        focal = 120 / np.tan(np.deg2rad(model.cam_fovy[i]) / 2)
        np.testing.assert_allclose(focal, camera.intrinsics[i, 1, 1], rtol=1e-5)


def test_an_unknown_preset_is_named():
    with pytest.raises(ValueError, match="unknown camera preset 'side', choose one of paper, ring"):
        scenes.cameras("side")
