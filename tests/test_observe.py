"""From poses to maps: what the fused map shows is what the scene is, also where the cameras are not where they should be."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train_step import tiny_config

from lala_jax import backbone, build, defaults, losses, observe, options, types
from lala_jax.perception import topdown
from lala_jax.sim import render, scene, tasks

SPEC = types.MapSpec(cell=0.0125)
TASK = tasks.get("pallet")


def observer(**options):
    return observe.Observer(TASK, SPEC, height=120, width=160, **options)


def scenes(seeds):
    drawn = [TASK.sample(seed) for seed in seeds]
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *drawn)


@pytest.fixture(scope="module")
def maps():
    batch = scenes([0, 1])
    return batch, jax.jit(observer().maps)(batch.size, batch.color, batch.base, batch.start)


def test_top_faces_have_their_height_and_colour(maps):
    """Well inside a box's top face, the map's height is the box's and its colour the box's, shaded as a level face is."""
    batch, seen = maps
    shade = scene.AMBIENT + scene.DIFFUSE * scene.LIGHT_DIR[2]
    for index in range(2):
        one = jax.tree.map(lambda leaf: leaf[index], seen)  # noqa: B023
        nothing = jnp.zeros(8, bool)
        state = types.State(
            batch.size[index], batch.color[index], batch.base[index], batch.goal[index], batch.symmetry[index], batch.start[index],
            nothing, ~nothing,
        )  # fmt: skip
        inside = np.asarray(losses.pick_valid(state, spec=SPEC, margin=0.012))
        top = np.asarray(topdown.max_height(one))
        for box in range(8):
            assert inside[box].any()
            np.testing.assert_allclose(top[inside[box], 3], float(batch.start[index, box, 2] + batch.size[index, box, 2] / 2), atol=1e-4)
            np.testing.assert_allclose(top[inside[box], :3], np.tile(batch.color[index, box] * shade, (inside[box].sum(), 1)), atol=2e-3)


def test_a_batch_is_its_scenes(maps):
    batch, seen = maps
    alone = observer().maps(*(leaf[1:] for leaf in (batch.size, batch.color, batch.base, batch.start)))
    np.testing.assert_allclose(seen.height[1], alone.height[0], atol=1e-6)
    np.testing.assert_array_equal(seen.count[1], alone.count[0])


def test_depth_noise_needs_a_key_and_stays_small(maps):
    batch, seen = maps
    noisy = observer(depth_noise=True)
    fields = batch.size[:1], batch.color[:1], batch.base[:1], batch.start[:1]
    with pytest.raises(ValueError, match="needs a key"):
        noisy.maps(*fields)
    heights = np.asarray(jax.jit(noisy.maps)(*fields, key=jax.random.key(0)).height[0])
    off = np.abs(heights - np.asarray(seen.height[0]))
    assert 1e-4 < np.median(off) < 0.02


def test_the_arm_at_home_is_in_the_background():
    """The parked arm is somewhere in the four views and nowhere over the workspace's map."""
    model, data = scene.geom_template(TASK)
    views = render.render(model, data, observer().camera, geoms=scene.static_geoms(model))
    table = min(scene.static_geoms(model))
    assert (np.asarray(views.segmentation) > table).any()
    assert float(topdown.from_views(views.replace(segmentation=None), spec=SPEC).height.max()) < 1e-3


def test_unknown_preset_names_the_choices():
    with pytest.raises(ValueError, match="paper, ring"):
        observer(preset="rnig").check()


def test_cameras_that_look_past_the_map_are_named(monkeypatch):
    """Of a table that goes on for ever each sees something."""
    eyes, target = scene.PRESETS["ring"]
    away = [*eyes[:3], (6.0, 0.0, 0.75)]
    monkeypatch.setitem(scene.PRESETS, "away", (eyes, (5.0, 0.0, 0.0)))
    monkeypatch.setitem(scene.PRESETS, "one", (away, target))
    area = r"sees the map's area, x \(0.25, 0.75\) and y \(-0.5, 0.5\), in [0-9.]+% of its pixels, not 1%"
    with pytest.raises(ValueError, match=f"camera 0 {area}"):
        observer(preset="away").check()
    with pytest.raises(ValueError, match=f"camera 3 {area}"):
        observer(preset="one").check()
    for preset in ("ring", "paper"):
        observer(preset=preset).check()
    with pytest.raises(options.OptionsError, match=f"camera.preset 'away': camera 0 {area}"):
        build.observer(tiny_config("camera.preset=away"))


TOWER = observe.Observer(tasks.get("tower", num_objects=2), SPEC, height=240, width=320)
MOVED = dataclasses.replace(TOWER, shift=0.03, turn=3.0, calibrate=True)
CUBE = 0.04
PLACES = np.array([[[0.4137, -0.2391], [0.5713, 0.1127]], [[0.3311, -0.3207], [0.6289, 0.2583]]])  # of two cubes in two scenes


@functools.cache
def cubes():
    """Two scenes of two cubes, their sides along the axes, and the stand far away: `size`, `color`, `base`, `poses`."""
    base = np.array([[0.3, 0.4, 0.0025, 1, 0, 0, 0]] * 2)
    poses = np.concatenate([PLACES, np.full((2, 2, 1), CUBE / 2), np.tile([1.0, 0, 0, 0], (2, 2, 1))], -1)
    color = np.tile([[0.9, 0.1, 0.1], [0.1, 0.2, 0.9]], (2, 1, 1))
    return tuple(jnp.asarray(leaf, jnp.float32) for leaf in (np.full((2, 2, 3), CUBE), color, base, poses))


@functools.cache
def plain_views():
    """What the preset's cameras see."""
    return jax.jit(TOWER.look)(*cubes())


fuse = jax.jit(topdown.from_views, static_argnames="spec")


def fused(views, index=0, spec=SPEC):
    return jax.device_get(fuse(jax.tree.map(lambda leaf: leaf[index], views), spec=spec))


def test_the_skin_tells_where_a_cubes_edges_are():
    """To about a millimetre with cells of 6.25: by how far the cells at either end of the lines through a cube are filled."""
    spec = types.MapSpec(cell=0.00625)
    errors = []
    for index in range(2):
        seen = fused(plain_views(), index, spec)
        on_top = np.abs(seen.height - CUBE) < 0.003
        share = 1 - 2 * np.abs(seen.skin)
        for middle in PLACES[index]:
            cell = np.asarray(types.index_from_world(spec, middle))
            for axis in (0, 1):
                lines = np.arange(-2, 3) + cell[1 - axis]
                high, part = (np.take(leaf, lines, 1 - axis) for leaf in (on_top, share[..., axis]))
                ends = []
                for number in range(len(lines)):
                    one, filled = (np.take(leaf, number, 1 - axis) for leaf in (high, part))
                    first, last = np.flatnonzero(one & (np.abs(np.arange(len(one)) - cell[axis]) < 6))[[0, -1]]
                    ends.append([first + 1 - filled[first], last + filled[last]])
                edges = (spec.y[0], spec.x[0])[axis] + np.mean(ends, 0) * spec.cell
                errors.append(edges - middle[1 - axis] - np.array([-CUBE / 2, CUBE / 2]))
    assert np.abs(errors).max() < 1.3e-3 and np.abs(errors).mean() < 8e-4


def test_a_camera_that_sees_nothing_adds_no_points():
    """The map is that of the other three; all four give more."""
    lost = jax.jit(dataclasses.replace(TOWER, missing=2).maps)(*cubes())
    others = jax.tree.map(lambda leaf: leaf[:, jnp.array([0, 1, 3])], plain_views())
    for index in range(2):
        three, one = fused(others, index), jax.tree.map(lambda leaf, index=index: leaf[index], lost)
        assert np.abs(three.count - one.count).sum() <= 4, "a point on a cell's border may round either way"
        np.testing.assert_allclose(three.height, one.height, atol=1e-5)
        assert three.count.sum() < 0.9 * fused(plain_views(), index).count.sum()


def test_moving_cameras_need_a_rig():
    for changes in ({"shift": 0.01}, {"turn": 1.0}, {"calibrate": True}):
        with pytest.raises(ValueError, match="needs the rig of Observer.mount"):
            observer(**changes).maps(*(leaf[:1] for leaf in cubes()))
    assert not observer().moves and not observer(missing=1, depth_noise=True).moves


@functools.cache
def mounted():
    """A rig, the maps through it, and those of one who does not know that the cameras have moved."""

    @jax.jit
    def everything(key, *scenes):
        rig = MOVED.mount(key, *scenes)
        nominal = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (2, *leaf.shape)), MOVED.camera)
        return rig, MOVED.maps(*scenes, rig=rig), MOVED.maps(*scenes, rig=rig.replace(believed=nominal))

    return jax.device_get(everything(jax.random.key(3), *cubes()))


def off(camera, true):
    """How far, in metres, points of the workspace's table land from where they are if unprojected with a camera's pose `[E, V]`."""
    corners = np.array([[x, y, 0.0, 1.0] for x in (0.25, 0.5, 0.75) for y in (-0.5, 0.0, 0.5)])
    wrong = np.asarray(camera.world_from_cam, float) @ np.linalg.inv(np.asarray(true.world_from_cam, float))
    return np.linalg.norm((corners @ np.swapaxes(wrong, -1, -2) - corners)[..., :3], axis=-1).max(-1)


def test_mounted_cameras_have_moved_and_are_found():
    rig, nominal = mounted()[0], MOVED.camera
    shift = np.linalg.norm(rig.background.camera.world_from_cam[..., :3, 3] - nominal.world_from_cam[..., :3, 3], axis=-1)
    assert (shift <= 0.03 + 1e-6).all() and shift.max() > 0.01 and len(np.unique(shift.round(6))) == 8, "every camera on its own"
    assert np.median(off(nominal, rig.background.camera)) > 0.01
    assert off(rig.believed, rig.background.camera).max() < 1e-3
    assert rig.background.depth.shape == (2, 4, 240, 320)


def tops(seen, index):
    """The middle `[2, 2]` of what is as high as a cube near each cube's place; NaN where there is nothing."""
    centres = np.asarray(losses.cell_centres(SPEC))
    middles = []
    for place in PLACES[index]:
        high = (np.abs(seen.height[index] - CUBE) < 0.004) & (np.abs(centres - place).max(-1) < 0.06)
        middles.append(centres[high].mean(0) if high.any() else np.full(2, np.nan))
    return np.array(middles)


def test_the_map_of_found_cameras_is_that_of_cameras_that_did_not_move():
    """A cube's top is within a fraction of a cell of where it is, nearly all heights are right; not so for one who was not told."""
    _, found, deceived = mounted()
    for index in range(2):
        still = fused(plain_views(), index)
        mine = jax.tree.map(lambda leaf, index=index: leaf[index], found)
        np.testing.assert_allclose(tops(found, index), PLACES[index], atol=0.4 * SPEC.cell)
        assert not np.allclose(tops(deceived, index), PLACES[index], atol=SPEC.cell)
        both = (still.count.sum(-1) > 3) & (mine.count.sum(-1) > 3)
        assert both.mean() > 0.9
        assert (np.abs(still.height - mine.height)[both] < 0.002).mean() > 0.98
        assert (np.abs(still.height - deceived.height[index])[both] < 0.002).mean() < 0.5


def test_pretrained_features_lie_where_they_were_seen():
    """The same as fusing by hand what the trunk says of the views, scaled; nothing where no camera looked."""
    plain, rich = (dataclasses.replace(TOWER, height=60, width=80, backbone=name, stage="stem") for name in ("", "resnet50_imagenet_v1"))
    views = jax.jit(plain.look)(*cubes())
    without, found = (jax.device_get(jax.jit(one.fuse)(views)) for one in (plain, rich))
    assert without.surface is None and found.surface.shape == (2, SPEC.rows, SPEC.cols, 64)
    np.testing.assert_array_equal(found.height, without.height)
    module, variables = backbone.load("resnet50_imagenet_v1", stage="stem")
    second = jax.tree.map(lambda leaf: leaf[1], views)
    features = np.asarray(jax.jit(module.apply)(variables, second.rgb))
    features = features / np.sqrt(np.square(features).mean(-1, keepdims=True) + 1e-6)
    by_hand = jax.jit(topdown.surface_features, static_argnames="spec")(second, features, spec=SPEC)
    np.testing.assert_allclose(found.surface[1], by_hand, atol=1e-3)
    seen = without.count[1].sum(-1) > 0
    assert np.array_equal(np.abs(found.surface[1]).sum(-1) > 0, seen) and 0.3 < seen.mean()


def test_features_in_bfloat16_are_those_of_float32():
    exact = dataclasses.replace(TOWER, height=60, width=80, backbone="resnet50_imagenet_v1", stage="stem")
    views = jax.jit(exact.look)(*cubes())
    want, got = (jax.jit(one.fuse)(views).surface for one in (exact, dataclasses.replace(exact, dtype="bfloat16")))
    assert (want.dtype, got.dtype) == (jnp.float32, jnp.bfloat16)
    assert 0 < np.linalg.norm(got.astype(jnp.float32) - want) < 0.02 * np.linalg.norm(want)
    config = options.override(defaults.get("", task="tower"), ["model.name=two_stream"])
    for dtype in build.DTYPES:
        assert build.observer(options.override(config, [f"model.dtype={dtype}"])).dtype == dtype


def test_only_transporters_take_a_backbone():
    config = options.override(defaults.get("", task="tower"), ["camera.backbone=resnet50_imagenet_v1"])
    with pytest.raises(options.OptionsError, match="model.name 'goal_aware' takes no camera.backbone; those that do are single, "):
        build.build_policy(config)
    config = options.override(config, ["model.name=two_stream", "model.width=4", "model.max_height=true"])
    for stage, channels in (("stem", 64), ("conv2", 256), ("conv3", 512)):
        agent = build.build_policy(options.override(config, [f"camera.stage={stage}"]))
        params = jax.eval_shape(agent.init, jax.random.key(0))
        assert params["pick_net"]["goal"]["stem"]["kernel"].shape[2] == 3 + channels + 1
    with pytest.raises(options.OptionsError, match="camera.stage must be one of 'stem', .*got 'conv6'"):
        build.build_policy(options.override(config, ["camera.stage=conv6"]))
    assert build.input_spec(config)["surface"] == "resnet50_imagenet_v1 conv2"
    assert "surface" not in build.input_spec(defaults.get("", task="tower"))


def test_a_backbone_in_a_file_is_told_by_what_it_holds(tmp_path):
    """Not by where it lies: the same file elsewhere is the same, other values or a deeper stage at the same place are not."""
    module, variables = backbone.load("resnet50_imagenet_v1", stage="conv2")

    def saved(place, scale=1.0):
        place.parent.mkdir(exist_ok=True)
        changed = jax.tree.map(lambda leaf: leaf * np.float32(scale), variables)
        backbone.save(place, module, changed)
        return place

    def told(file, stage="conv2"):
        fields = [f"camera.backbone={file}", f"camera.stage={stage}", "model.name=two_stream"]
        return build.input_spec(options.override(defaults.get("", task="tower"), fields))["surface"]

    first = told(saved(tmp_path / "a.npz"))
    assert first.endswith(" conv2") and first == told(saved(tmp_path / "there" / "b.npz"))
    assert told(tmp_path / "a.npz", "stem") != first
    assert told(saved(tmp_path / "a.npz", 1.001)) != first


def test_a_missing_camera_must_be_there():
    for missing in (4, -2):
        with pytest.raises(options.OptionsError, match=f"camera.missing must be one of -1, 0, 1, 2, 3, got {missing}"):
            build.observer(options.override(defaults.get("", task="tower"), [f"camera.missing={missing}"]))


def test_calibration_alone_leaves_still_cameras_where_they_are():
    still = dataclasses.replace(TOWER, calibrate=True)
    rig = jax.device_get(jax.jit(still.mount)(jax.random.key(0), *cubes()))
    assert rig.background is None
    assert off(rig.believed, still.camera).max() < 2e-4


def test_without_calibration_the_preset_is_believed():
    """Where the cameras are is drawn by the key alone, whatever the pictures' size."""
    naive = dataclasses.replace(MOVED, height=24, width=32, calibrate=False)
    rig = jax.device_get(jax.jit(naive.mount)(jax.random.key(3), *cubes()))
    np.testing.assert_allclose(rig.background.camera.world_from_cam, mounted()[0].background.camera.world_from_cam, atol=1e-6)
    np.testing.assert_allclose(rig.believed.world_from_cam, np.broadcast_to(naive.camera.world_from_cam, (2, 4, 4, 4)), atol=1e-7)
