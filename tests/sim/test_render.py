"""The renderer against MuJoCo's own rays, its own full cast, and loops."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from lala_jax import types
from lala_jax.sim import render, scene, tasks

SIZE = 60, 80
KINDS = ("box", "sphere", "capsule", "cylinder", "ellipsoid")


def look(eye, target, height, width, focal=1.0):
    """Build a camera by hand, not with the package's own look_at."""
    eye, target = np.asarray(eye, float), np.asarray(target, float)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    intrinsics = np.array([[focal * width, 0, width * 0.52], [0, focal * width, height * 0.47], [0, 0, 1]])
    return intrinsics, pose


def stack(cameras, height, width):
    intrinsics, poses = zip(*cameras, strict=True)
    return types.Camera(jnp.asarray(np.stack(intrinsics), jnp.float32), jnp.asarray(np.stack(poses), jnp.float32), height, width)


def ring(height=SIZE[0], width=SIZE[1]):
    eyes = [(1.1, 0.6, 0.7), (-0.4, 0.5, 0.8), (0.5, -0.9, 0.3)]
    return stack([look(eye, (0.4, 0.0, 0.05), height, width, 0.8) for eye in eyes], height, width)


def build(geoms, plane="0 0 1"):
    """Compile geoms [(type, size, position, quaternion, rgba)] over a plane; no contacts, no steps."""
    body = "".join(
        f'<geom type="{kind}" size="{" ".join(map(str, size))}" pos="{" ".join(map(str, pos))}" quat="{" ".join(map(str, quat))}"'
        f' rgba="{" ".join(map(str, rgba))}" contype="0" conaffinity="0"/>'
        for kind, size, pos, quat, rgba in geoms
    )
    table = f'<geom type="plane" size="{plane}" rgba=".2 .2 .2 1" contype="0" conaffinity="0"/>' if plane else ""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{table}{body}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def random_geoms(seed, kinds=KINDS * 3, spread=0.4):
    rng = np.random.default_rng(seed)
    return [
        (
            kind,
            rng.uniform(0.02, 0.12, 3).round(4),
            (rng.uniform(-1, 1, 3) * spread + [0.4, 0, spread / 2]).round(4),
            rng.normal(size=4).round(4),
            (*rng.uniform(0, 1, 3).round(3), 1),
        )
        for kind in kinds
    ]


def put(model, data):
    return mjx.put_model(model), mjx.put_data(model, data)


def rays(model, data, camera):
    """Give MuJoCo's own depth, geom id and normal of every pixel: mj_multiRay, in float64."""
    depth, ids, normals = [], [], []
    rows, cols = camera.height, camera.width
    for intrinsics, pose in zip(np.asarray(camera.intrinsics, float), np.asarray(camera.world_from_cam, float), strict=True):
        u, v = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
        pixels = np.stack([(u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1], np.ones_like(u)], -1)
        ray = np.ascontiguousarray(pixels.reshape(-1, 3) @ pose[:3, :3].T)
        geom, distance, normal = np.zeros(len(ray), np.int32), np.zeros(len(ray)), np.zeros(ray.size)
        mujoco.mj_multiRay(model, data, pose[:3, 3], ray.reshape(-1), None, True, -1, geom, distance, normal, len(ray), 1e10)
        depth.append(np.where(geom >= 0, distance, 0).reshape(rows, cols))
        ids.append(geom.reshape(rows, cols))
        normals.append(normal.reshape(rows, cols, 3))
    return np.stack(depth), np.stack(ids), np.stack(normals)


def assert_like_rays(views, model, data, edge=2e-3):
    """The same geom but on silhouettes, where one ulp decides; there the same depth to 1e-4 m, and the shade of the normal."""
    depth, ids, normals = rays(model, data, views.camera)
    same = np.asarray(views.segmentation) == ids
    assert (~same).mean() <= edge, f"{(~same).mean():.4%} of the pixels show another geom"
    seen = same & (ids >= 0)
    assert seen.mean() > 0.2
    np.testing.assert_allclose(np.asarray(views.depth)[seen], depth[seen], atol=1e-4, rtol=0)
    np.testing.assert_array_equal(np.asarray(views.depth)[same & (ids < 0)], 0)
    shade = scene.AMBIENT + scene.DIFFUSE * np.maximum(normals @ np.array(scene.LIGHT_DIR), 0)
    error = np.abs(np.asarray(views.rgb) - shade[..., None] * model.geom_rgba[ids][..., :3]).max(-1)
    assert (error[seen] > 2e-3).mean() <= edge, "colours"  # edges between two faces of a geom


@pytest.fixture(scope="module")
def mixed():
    return build(random_geoms(0))


@functools.cache
def program(method, window=render.TILE, geoms=None, segmentation=True):
    def run(model, data, camera):
        return render.render(model, data, camera, geoms=geoms, method=method, window=window, segmentation=segmentation)

    return jax.jit(run)


@pytest.mark.parametrize("method", ["tiles", "full"])
def test_random_scenes_agree_with_mujoco_rays(method):
    for seed in range(4):  # one compilation: same types, other numbers
        model, data = build(random_geoms(seed))
        assert_like_rays(program(method)(*put(model, data), ring()), model, data)


def test_a_bounded_plane_is_seen_within_its_sides_and_from_above_only():
    model, data = build([("sphere", (0.05,), (0.4, 0, 0.05), (1, 0, 0, 0), (1, 1, 1, 1))], plane="0.7 0.4 1")
    views = program("tiles")(*put(model, data), ring())
    assert_like_rays(views, model, data)
    below = stack([look((0.9, 0, -0.5), (0.4, 0.01, 0), *SIZE)], *SIZE)
    assert not (np.asarray(program("tiles")(*put(model, data), below).segmentation) == 0).any()


@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_task_scenes_with_the_arm_agree_with_mujoco_rays(name):
    task = tasks.get(name)
    sample = task.sample(3)
    model = scene.build_model(task, sample)
    camera = scene.cameras("ring", height=90, width=120)
    template = scene.geom_template(task)
    color, size = jnp.asarray(sample.color, jnp.float32), jnp.asarray(sample.size, jnp.float32)
    base = jnp.asarray(sample.base, jnp.float32)
    mixed = jax.jit(lambda m, d, poses: scene.place(m, d, size=size, color=color, poses=poses, base=base))
    for poses in (sample.start, sample.goal):
        mjx_model, mjx_data = mixed(*template, jnp.asarray(poses, jnp.float32))
        data = mujoco.MjData(model)
        data.geom_xpos[:], data.geom_xmat[:] = mjx_data.geom_xpos, np.asarray(mjx_data.geom_xmat).reshape(-1, 9)
        assert_like_rays(program("tiles")(mjx_model, mjx_data, camera), *frozen(model, data))


def frozen(model, data):
    """Compile the geoms of a scene where they stand, without bodies, so that mj_ray needs no kinematics of ours."""
    quat, geoms = np.zeros(4), []
    for geom in range(model.ngeom):
        mujoco.mju_mat2Quat(quat, data.geom_xmat[geom].copy())
        kind = mujoco.mjtGeom(model.geom_type[geom]).name.removeprefix("mjGEOM_").lower()
        size = model.geom_size[geom] if kind != "plane" else [*model.geom_size[geom][:2], 1]
        geoms.append((kind, size, data.geom_xpos[geom], quat.copy(), model.geom_rgba[geom]))
    return build(geoms, plane=None)


def awkward_geoms():
    """Boxes in the image's corners, across its edges, behind the camera, across the camera's plane, far, thin and huge."""
    box, one = "box", (1, 0, 0, 0)
    turned = (0.9, 0.1, -0.2, 0.3)
    places = [
        (0.4, 0, 0.1),
        (1.0, 0.5, 0.6),
        (1.2, 0.7, 0.8),
        (0.5, 0.9, 0.2),
        (0.9, -0.5, 0.02),
        (-3, 2, 0.3),
        (0.7, 0.35, 0.5),
        (0.3, -0.45, 0.3),
    ]
    small = [(box, (0.04, 0.03, 0.02 + 0.01 * i), place, turned if i % 2 else one, (1, 0.1 * i, 0, 1)) for i, place in enumerate(places)]
    return [*small, (box, (0.3, 0.001, 0.2), (0.2, 0.3, 0.2), turned, (0, 1, 0, 1)), (box, (2, 2, 0.05), (0, 0, -0.3), one, (0, 0, 1, 1))]


@pytest.mark.parametrize("window", [(8, 8), (32, 32), (500, 500)])
def test_nothing_is_clipped_whatever_the_tile(window):
    model, data = put(*build(awkward_geoms(), plane=None))
    full = program("full")(model, data, ring())
    tiles = program("tiles", window)(model, data, ring())
    assert len(np.unique(full.segmentation)) >= 8
    assert (np.asarray(full.segmentation) != np.asarray(tiles.segmentation)).mean() <= 1e-3
    np.testing.assert_array_equal(np.asarray(full.depth) > 0, np.asarray(tiles.depth) > 0)
    np.testing.assert_allclose(full.depth, tiles.depth, atol=1e-5)
    assert (np.abs(np.asarray(full.rgb) - np.asarray(tiles.rgb)).max(-1) > 1e-5).mean() <= 1e-3


def test_every_shape_is_whole_in_tiles_at_random_places():
    for seed in range(1, 4):
        model, data = put(*build(random_geoms(seed, spread=1.5)))
        data = data.replace(geom_xpos=data.geom_xpos.at[0, 2].set(-9.0))  # no table behind
        full, tiles = (program(method)(model, data, ring()) for method in ("full", "tiles"))
        np.testing.assert_array_equal(np.asarray(full.depth) > 0, np.asarray(tiles.depth) > 0)
        np.testing.assert_allclose(full.depth, tiles.depth, atol=1e-5)


def test_awkward_boxes_agree_with_mujoco_rays():
    model, data = build(awkward_geoms(), plane=None)
    assert_like_rays(program("tiles")(*put(model, data), ring()), model, data)


def test_a_layer_below_changes_nothing(mixed):
    model, data = put(*mixed)
    fixed, moving = (0, 1), (6, 4)  # a plane and a box; a box and a cylinder
    whole = program("tiles", geoms=(*fixed, *moving))(model, data, ring())
    layer = render.background(model, data, ring(), geoms=fixed)
    over = jax.jit(lambda layer: render.render_over(layer, model, data, ring(), geoms=moving))(layer)
    np.testing.assert_array_equal(whole.segmentation, over.segmentation)
    np.testing.assert_allclose(whole.depth, over.depth, atol=1e-5)
    np.testing.assert_allclose(whole.rgb, over.rgb, atol=1e-5)
    assert render.render_over(layer, model, data, ring(), geoms=()).depth is layer.depth


@pytest.mark.parametrize("method", ["tiles", "full"])
def test_vmap_and_render_batch_are_loops(method, mixed):
    model, data = put(*mixed)
    fixed, moving = (0,), (1, 6)
    rng = np.random.default_rng(0)
    pos = data.geom_xpos[None] + jnp.asarray(rng.uniform(-0.1, 0.1, (3, 1, 3)), jnp.float32)
    rgba = jnp.asarray(rng.uniform(0.1, 1, (3, model.ngeom, 4)), jnp.float32)
    layer = render.background(model, data, ring(), geoms=fixed)

    def one(layer, pos, rgba):
        return render.render_over(layer, model.replace(geom_rgba=rgba), data.replace(geom_xpos=pos), ring(), geoms=moving, method=method)

    loop = [jax.jit(one)(layer, pos[i], rgba[i]) for i in range(3)]
    loop = jax.tree.map(lambda *leaves: np.stack(leaves), *loop)
    many = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))(layer, pos, rgba)
    batch = jax.jit(
        lambda layer: render.render_batch(
            model.replace(geom_rgba=rgba), data.replace(geom_xpos=pos), ring(), geoms=moving, layer=layer, method=method
        )
    )(layer)
    for other in (many, batch):
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), loop, other)
    assert batch.depth.shape == (3, 3, *SIZE) and batch.camera.intrinsics.shape == (3, 3, 3, 3)


def test_render_batch_takes_cameras_and_layers_a_scene(mixed):
    model, data = put(*mixed)
    shift = jnp.zeros((2, 3, 4, 4)).at[1, :, 0, 3].set(0.1)
    camera = ring()
    cameras = camera.replace(world_from_cam=camera.world_from_cam[None] + shift)
    each = [camera.replace(world_from_cam=pose) for pose in cameras.world_from_cam]
    layers = [render.background(model, data, camera, geoms=(0,)) for camera in each]
    layer = jax.tree.map(lambda *leaves: jnp.stack(leaves), *layers)
    views = jax.jit(lambda layer: render.render_batch(model, data, cameras, geoms=(1, 6), layer=layer))(layer)
    for i in range(2):
        one = program("tiles", geoms=(0, 1, 6))(model, data, each[i])
        np.testing.assert_allclose(views.depth[i], one.depth, atol=1e-5)


def test_eager_is_jit_and_segmentation_is_optional(mixed):
    model, data = put(*mixed)
    eager = render.render(model, data, ring(), geoms=(1,), segmentation=False)
    jitted = program("tiles", geoms=(1,))(model, data, ring())
    assert eager.segmentation is None
    np.testing.assert_allclose(eager.depth, jitted.depth, atol=1e-5)
    assert (np.abs(np.asarray(eager.rgb) - np.asarray(jitted.rgb)).max(-1) > 1e-5).mean() <= 1e-3


def test_an_invisible_geom_is_not_drawn():
    geoms = random_geoms(2, ("box", "capsule"), spread=0.1)
    model, data = put(*build(geoms))
    hidden = model.replace(geom_rgba=model.geom_rgba.at[1:, 3].set(0.0))
    for method in ("tiles", "full"):
        assert set(np.unique(program(method)(model, data, ring()).segmentation)) == {-1, 0, 1, 2}
        assert set(np.unique(program(method)(hidden, data, ring()).segmentation)) == {-1, 0}


def test_window_for_holds_the_object_in_one_tile():
    camera, rng = ring(120, 160), np.random.default_rng(0)
    radius, nearest = 0.06, 0.5
    rows, cols = render.window_for(camera, radius, min_distance=nearest)
    half = radius / np.sqrt(3)
    model, data = put(*build([("box", (half, half, half), (0.4, 0, 0), (1, 0, 0, 0), (1, 1, 1, 1))], plane=None))
    seen = jax.jit(lambda data: render.render(model, data, ring(120, 160), geoms=(0,), method="full").segmentation == 0)
    widest = 0
    for _ in range(20):
        quat = rng.normal(size=4)
        mat = np.zeros(9)
        mujoco.mju_quat2Mat(mat, quat / np.linalg.norm(quat))
        place = data.replace(
            geom_xpos=jnp.asarray(rng.uniform([0, -0.4, 0], [0.8, 0.4, 0.2], (1, 3)), jnp.float32),
            geom_xmat=jnp.asarray(mat.reshape(1, 3, 3), jnp.float32),
        )
        far = np.linalg.norm(np.asarray(camera.world_from_cam)[:, :3, 3] - np.asarray(place.geom_xpos), axis=1)
        for image in np.asarray(seen(place))[far > nearest]:
            if image.any():
                extent = np.ptp(np.argwhere(image), axis=0) + 1
                assert extent[0] <= rows and extent[1] <= cols
                widest = max(widest, extent.max())
    assert widest > 10
    with pytest.raises(ValueError, match="radius=0.5"):
        render.window_for(camera, 0.5, min_distance=0.4)


def test_check_views_names_the_blind_camera(mixed):
    model, data = put(*mixed)
    good = program("tiles")(model, data, ring())
    render.check_views(good)
    render.check_views(jax.tree.map(lambda leaf: leaf[None], good))
    up = np.asarray(ring().world_from_cam).copy()
    up[1] = look((0, 0, 0.5), (0.001, 0, 2), *SIZE)[1]
    blind = program("tiles")(model, data, ring().replace(world_from_cam=jnp.asarray(up)))
    with pytest.raises(ValueError, match="camera 1 sees"):
        render.check_views(blind)
    with pytest.raises(ValueError, match="camera 2 has depths"):
        render.check_views(good.replace(depth=good.depth.at[2, 0, 0].set(jnp.nan)))


def test_errors_name_what_is_wrong(mixed):
    model, data = put(*mixed)
    with pytest.raises(ValueError, match="geom 99 is not in the model, which has 16"):
        render.render(model, data, ring(), geoms=(99,))
    with pytest.raises(ValueError, match="method 'fast'.*tiles"):
        render.render(model, data, ring(), method="fast")
    with pytest.raises(ValueError, match=r"\[V, 3, 3\]"):
        render.render(model, data, jax.tree.map(lambda leaf: leaf[0], ring()))
    with pytest.raises(ValueError, match="layer's depth"):
        render.render_over(render.blank(ring(30, 40)), model, data, ring(), geoms=(0,))
    kinds = np.array(model.geom_type)
    kinds[3] = int(mujoco.mjtGeom.mjGEOM_MESH)
    with pytest.raises(ValueError, match="geom 3 is of mjtGeom type 7.*capsule"):
        render.render(model.replace(geom_type=kinds), data, ring())


def test_depth_agrees_with_the_gl_renderer(mixed):
    model, data = mixed
    height, width = 60, 80
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:  # whatever a missing GL library raises
        pytest.skip(f"no GL library: {error}")
    view = mujoco.MjvCamera()
    view.lookat[:], view.distance, view.azimuth, view.elevation = (0.4, 0, 0.1), 1.2, 140, -35
    renderer.update_scene(data, view)
    renderer.enable_depth_rendering()
    depth = renderer.render().copy()
    gl = renderer.scene.camera
    eye = (np.array(gl[0].pos) + np.array(gl[1].pos)) / 2
    focal = 0.5 * height / np.tan(np.deg2rad(model.vis.global_.fovy) / 2)
    _, pose = look(eye, eye + np.array(gl[0].forward), height, width)
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    ours = np.asarray(program("tiles")(*put(model, data), stack([(intrinsics, pose)], height, width)).depth[0])
    both = (ours > 0) & (ours < 5)
    error = np.abs(ours - depth)[both]
    assert np.quantile(error, 0.9) < 1e-3 and both.mean() > 0.5
