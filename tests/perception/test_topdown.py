"""The fused map against a slow loop over points, and the laws of cells: half a cell, any order."""

import collections
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lala_jax import types
from lala_jax.perception import camera, topdown

SPEC = types.MapSpec(x=(0.25, 0.45), y=(-0.1, 0.2), z=(0.0, 0.08), cell=0.025, slices=4)


def slow_fuse(points, features, valid, spec, floor_margin=0.01, surface_margin=0.001, skin=0.005):
    """Put one point after the other into dictionaries of cells."""
    grid = (spec.rows, spec.cols, spec.slices)
    total, within, count, height = np.zeros((*grid, features.shape[1])), np.zeros((*grid, 2)), np.zeros(grid), np.zeros(grid[:2])
    columns = collections.defaultdict(list)
    for (x, y, z), feature, ok in zip(points.astype(float), features.astype(float), valid, strict=True):
        at = np.array([(y - spec.y[0]) / spec.cell, (x - spec.x[0]) / spec.cell])
        row, col = np.floor(at).astype(int)
        inside = 0 <= row < spec.rows and 0 <= col < spec.cols and spec.z[0] - floor_margin <= z < spec.z[1]
        if not (ok and inside):
            continue
        layer = max(0, int(np.floor((z - surface_margin - spec.z[0]) / spec.slice_height)))
        total[row, col, layer] += feature
        within[row, col, layer] += at - (row + 0.5, col + 0.5)
        count[row, col, layer] += 1
        height[row, col] = max(height[row, col], z - spec.z[0])
        columns[row, col].append((z - spec.z[0], at - (row + 0.5, col + 0.5)))
    face = np.zeros((*grid[:2], 2))
    for cell, those in columns.items():
        high = [place for z, place in those if z > height[cell] - skin]
        face[cell] = np.mean(high, 0) if high else 0
    number = np.maximum(count, 1)[..., None]
    return types.TopDownMap(features=total / number, count=count, offset=within / number, height=height, skin=face)


def cloud(number=2000, channels=3, seed=0):
    """Points in and around the map, none of them within float32 rounding of a border."""
    rng = np.random.default_rng(seed)
    grid = np.array([SPEC.cell, SPEC.cell, SPEC.slice_height])
    corner = np.array([SPEC.x[0], SPEC.y[0], SPEC.z[0]])
    voxel = rng.integers([-2, -2, -2], [SPEC.cols + 2, SPEC.rows + 2, SPEC.slices + 1], (number, 3))
    points = corner + (voxel + rng.uniform(0.01, 0.99, (number, 3))) * grid
    return points.astype(np.float32), rng.random((number, channels), np.float32), rng.random(number) < 0.9


fuse = jax.jit(topdown.fuse, static_argnames=("spec", "floor_margin", "surface_margin"))
from_views = jax.jit(topdown.from_views, static_argnames=("spec", "floor_margin", "surface_margin"))
max_height = jax.jit(topdown.max_height)


@pytest.mark.parametrize("channels", [0, 1, 3, 7])
@pytest.mark.parametrize("margins", [{}, {"floor_margin": 0.025}, {"floor_margin": 0.0, "surface_margin": 0.004}])
def test_fuse_equals_a_slow_loop(channels, margins):
    points, features, valid = cloud(channels=channels)
    fused = fuse(*map(jnp.asarray, (points, features, valid)), spec=SPEC, **margins)
    slow = slow_fuse(points, features, valid, SPEC, **margins)
    assert slow.count.sum() > 300
    np.testing.assert_array_equal(fused.count, slow.count)
    np.testing.assert_allclose(fused.features, slow.features, atol=1e-6)
    np.testing.assert_allclose(fused.height, slow.height, atol=1e-7)
    np.testing.assert_allclose(fused.offset, slow.offset, atol=2e-5)
    np.testing.assert_allclose(fused.skin, slow.skin, atol=2e-5)
    assert np.abs(slow.skin).max() > 0.3 and np.abs(fused.offset).max() < 0.5


@pytest.mark.parametrize("skin", [0.0005, 0.02])
def test_the_skins_depth_is_an_option(skin):
    """From the highest point alone to all points of a column."""
    points, features, valid = cloud(seed=3)
    thin = jax.jit(functools.partial(topdown.fuse, spec=SPEC, skin=skin))(*map(jnp.asarray, (points, features, valid)))
    slow = slow_fuse(points, features, valid, SPEC, skin=skin)
    np.testing.assert_allclose(thin.skin, slow.skin, atol=2e-5)
    default = fuse(*map(jnp.asarray, (points, features, valid)), spec=SPEC)
    np.testing.assert_array_equal(thin.offset, default.offset)
    assert np.abs(thin.skin - default.skin).max() > 0.05


def box_points(low, high, height, step=0.0005):
    """Points on the top and the sides (but for their last 6 mm) of a box between `low` and `high` (x, y) and on the floor around it."""
    spots = [np.arange(a + step / 2, b, step) for a, b in (SPEC.x, SPEC.y)]
    every = np.stack(np.meshgrid(*spots, indexing="ij"), -1).reshape(-1, 2)
    inside = ((every > low) & (every < high)).all(-1)
    points = [np.column_stack([every, height * inside])]
    spots = [spot[(spot > a) & (spot < b)] for spot, a, b in zip(spots, low, high, strict=True)]
    for z in np.arange(0, height - 0.006, 4 * step):
        rim = [np.column_stack([np.full(len(spots[1]), x), spots[1]]) for x in (low[0] + 1e-5, high[0] - 1e-5)]
        rim += [np.column_stack([spots[0], np.full(len(spots[0]), y)]) for y in (low[1] + 1e-5, high[1] - 1e-5)]
        points.append(np.insert(np.concatenate(rim), 2, z, axis=1))
    return np.concatenate(points).astype(np.float32)


@pytest.mark.parametrize(("low", "high"), [((0.283, -0.041), (0.3605, 0.087)), ((0.3015, -0.0985), (0.4295, 0.1485))])
def test_skin_tells_how_far_a_top_face_fills_its_cells(low, high):
    """Along a row or column through a box, the shares `1 - 2 |skin|` of its cells add up to its side, though cells are 25 mm."""
    points = box_points(low, high, 0.06)
    fused = jax.device_get(fuse(jnp.asarray(points), jnp.zeros((len(points), 1)), jnp.ones(len(points), bool), spec=SPEC))
    on_top = fused.height > 0.05
    middle = np.floor(types.cell_from_world(SPEC, np.mean([low, high], 0))).astype(int)
    for axis, side in ((1, 0), (0, 1)):  # columns run along x
        lines = [np.take(leaf, middle[1 - axis], 1 - axis) for leaf in (fused.skin[..., axis], on_top)]
        share = (1 - 2 * np.abs(lines[0])) * lines[1]
        assert abs(share.sum() * SPEC.cell - (high[side] - low[side])) < 3e-4
        assert (share < 0.999).sum() > 0 and ((share > 0.98) | ~lines[1]).sum() >= len(share) - 2, "all cells but the ends are full"
        first, last = np.flatnonzero(lines[1])[[0, -1]]
        corner = (SPEC.x, SPEC.y)[side][0]
        assert abs(corner + (first + 1 - share[first]) * SPEC.cell - low[side]) < 2e-4
        assert abs(corner + (last + share[last]) * SPEC.cell - high[side]) < 2e-4
    covered = np.prod(1 - 2 * np.abs(fused.skin), -1)[on_top].sum() * SPEC.cell**2
    assert abs(covered / np.prod(np.subtract(high, low)) - 1) < 0.01


def test_jit_equals_eager_and_vmap_and_map_equal_a_loop():
    clouds = [tuple(map(jnp.asarray, cloud(200, seed=seed))) for seed in range(2)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *clouds)
    one = functools.partial(topdown.fuse, spec=SPEC)
    loop = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one(*example) for example in clouds))
    for batched in (jax.jit(jax.vmap(one))(*batch), jax.lax.map(lambda example: one(*example), batch)):
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), batched, loop)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31))
def test_the_order_of_points_does_not_matter(seed):
    points, features, valid = cloud(seed=seed % 5)
    order = np.random.default_rng(seed).permutation(len(points))
    first = fuse(*map(jnp.asarray, (points, features, valid)), spec=SPEC)
    second = fuse(*map(jnp.asarray, (points[order], features[order], valid[order])), spec=SPEC)
    np.testing.assert_array_equal(first.count, second.count)
    np.testing.assert_array_equal(first.height, second.height)
    for name in ("features", "offset", "skin"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), atol=1e-6)


def test_dropped_points_leave_no_trace_even_if_they_are_nan():
    points, features, valid = cloud()
    fused = fuse(*map(jnp.asarray, (points, features, valid)), spec=SPEC)
    features[~valid], points[~valid] = np.nan, np.nan
    again = fuse(*map(jnp.asarray, (points, features, valid)), spec=SPEC)
    jax.tree.map(np.testing.assert_array_equal, fused, again)


def test_no_points_give_an_empty_map():
    fused = fuse(jnp.ones((5, 3)), jnp.ones((5, 2)), jnp.zeros(5, bool), spec=SPEC)
    assert all(not leaf.any() for leaf in jax.tree.leaves(fused))
    assert not max_height(fused).any()


def test_sums_are_exact_for_features_of_few_bits():
    number = 3000
    points = jnp.broadcast_to(jnp.array([0.3, 0.0, 0.01]), (number, 3))
    fused = fuse(points, jnp.full((number, 1), 0.5, jnp.bfloat16), jnp.ones(number, bool), spec=SPEC)
    assert fused.count.max() == number
    assert fused.features.max() == 0.5


def test_a_face_on_a_border_goes_under_it_with_a_surface_margin():
    z = jnp.array([0.04, 0.0400001, 0.0399999], jnp.float32)
    points = jnp.stack([jnp.full(3, 0.3), jnp.full(3, 0.0), z], axis=-1)
    arguments = (points, jnp.ones((3, 1)), jnp.ones(3, bool))
    speckled, clean = fuse(*arguments, spec=SPEC, surface_margin=0.0), fuse(*arguments, spec=SPEC)
    assert (speckled.count > 0).sum() == 2
    assert float(clean.count[..., 1].sum()) == 3
    np.testing.assert_array_equal(speckled.height, clean.height)


@settings(max_examples=25, deadline=None)
@given(st.floats(0, 1), st.floats(0, 1))
def test_world_to_cell_to_world_is_the_identity_up_to_half_a_cell(a, b):
    spec = types.MapSpec()
    low, high = np.array([spec.x[0], spec.y[0]]), np.array([spec.x[1], spec.y[1]])
    xy = (low + np.array([a, b]) * (high - low)).astype(np.float32)
    index = types.index_from_world(spec, xy)
    back = types.world_from_index(spec, np.clip(index, 0, [spec.rows - 1, spec.cols - 1]))
    assert np.abs(back - xy).max() <= spec.cell / 2 + 1e-6


def test_every_cell_centre_falls_into_its_own_cell():
    spec = types.MapSpec()
    index = np.stack(np.meshgrid(np.arange(spec.rows), np.arange(spec.cols), indexing="ij"), axis=-1)
    centers = types.world_from_index(spec, index)
    np.testing.assert_array_equal(types.index_from_world(spec, centers), index)
    points = jnp.concatenate([centers, jnp.full(centers.shape[:2] + (1,), 0.01)], axis=-1).reshape(-1, 3)
    fused = fuse(points, points[:, :2], jnp.ones(len(points), bool), spec=spec)
    np.testing.assert_array_equal(fused.count[..., 0], 1)
    np.testing.assert_allclose(fused.features[..., 0, :], centers, atol=1e-6)


def table_views(order=(0, 1, 2, 3), size=(60, 80)):
    """Four views of a bare table with a wall of height 0.06 m at x < 0.35 seen from above, in closed form."""
    eyes = np.array([[0.91, 0.33, 0.7], [0.13, 0.51, 0.7], [0.347, 0.059, 0.9], [0.62, -0.59, 0.7]])[list(order)]
    cameras = camera.pinhole(camera.look_at(eyes, np.array([0.3517, 0.0493, 0.0])), height=size[0], width=size[1], focal=70.0)
    rays = np.asarray(jax.jit(jax.vmap(camera.directions))(cameras), float)
    hits = {}
    for level in (0.0, 0.06):
        depth = (level - eyes[:, None, None, 2]) / rays[..., 2]
        hits[level] = depth, eyes[:, None, None, 0] + depth * rays[..., 0]
    wall = hits[0.06][1] < 0.35
    depth = np.where(wall, hits[0.06][0], hits[0.0][0])
    depth = np.where((depth > 0) & (depth < 3), depth, 0)
    rgb = np.where(wall[..., None], [1.0, 0.2, 0.1], [0.2, 0.2, 0.2])
    return types.Views(rgb=jnp.asarray(rgb, jnp.float32), depth=jnp.asarray(depth, jnp.float32), camera=cameras)


def test_from_views_puts_colours_where_they_are_seen():
    fused = from_views(table_views(), spec=SPEC)
    seen = np.asarray(max_height(fused))
    np.testing.assert_allclose(seen[:, :3, 3], 0.06, atol=1e-5)  # x 0.25..0.325
    np.testing.assert_allclose(seen[:, :3, :3], np.broadcast_to([1.0, 0.2, 0.1], (12, 3, 3)), atol=1e-5)
    np.testing.assert_allclose(seen[:, 5:, 3], 0.0, atol=1e-5)  # x 0.375..0.45
    np.testing.assert_allclose(seen[:, 5:, :3], 0.2, atol=1e-5)


def test_from_views_equals_fuse_of_the_slow_points():
    views = table_views()
    fused = from_views(views, spec=SPEC)
    points = np.asarray(jax.jit(jax.vmap(camera.unproject))(views.depth, views.camera))
    slow = slow_fuse(points.reshape(-1, 3), np.asarray(views.rgb).reshape(-1, 3), np.asarray(views.depth > 0).reshape(-1), SPEC)
    assert np.abs(fused.count - slow.count).sum() <= 4, "a point on a cell's border may round either way"
    np.testing.assert_allclose(fused.height, slow.height, atol=1e-5)
    same = np.asarray(fused.count == slow.count)
    np.testing.assert_allclose(np.asarray(fused.features)[same], slow.features[same], atol=1e-5)
    np.testing.assert_allclose(np.asarray(fused.offset)[same], slow.offset[same], atol=1e-4)
    np.testing.assert_allclose(np.asarray(fused.skin)[same.all(-1)], slow.skin[same.all(-1)], atol=1e-4)


@pytest.mark.parametrize(("name", "dtype", "unit"), [("rgb", jnp.uint8, "in 0..1"), ("depth", jnp.uint16, "metres")])
def test_whole_numbers_of_real_cameras_are_refused(name, dtype, unit):
    """Colours of 0..255 and millimetres would be taken for colours in 0..1 and metres."""
    views = table_views()
    raw = views.replace(**{name: (255 * getattr(views, name)).astype(dtype)})
    with pytest.raises(ValueError, match=rf"views.{name} must be floating point, {unit}, got {jnp.dtype(dtype).name}"):
        topdown.from_views(raw, spec=SPEC)


def test_shapes_that_do_not_fit_are_named():
    views = table_views()
    count, (height, width) = len(views.depth), views.depth.shape[1:]
    wrong = {
        "rgb": jnp.moveaxis(views.rgb, -1, 1),
        "depth": views.depth[0],
        "camera.intrinsics": views.camera.replace(intrinsics=views.camera.intrinsics[0]),
        "camera.world_from_cam": views.camera.replace(world_from_cam=views.camera.world_from_cam[:1]),
    }
    for name, leaf in wrong.items():
        with pytest.raises(ValueError, match=rf"views\.{name} must be \["):
            topdown.from_views(views.replace(**{name.partition(".")[0]: leaf}), spec=SPEC)
    with pytest.raises(
        ValueError, match=rf"views\.depth must be \[{count}, {height}, {width}\] for {count} views.*got \[{count}, {height}, 7\]"
    ):
        topdown.from_views(views.replace(depth=views.depth[..., :7]), spec=SPEC)


def test_the_order_of_views_does_not_matter():
    first = from_views(table_views(), spec=SPEC)
    second = from_views(table_views((2, 0, 3, 1)), spec=SPEC)
    assert np.abs(first.count - second.count).sum() <= 4
    np.testing.assert_allclose(first.height, second.height, atol=1e-6)


def test_more_features_ride_along_and_any_number_of_views_works():
    views = table_views()
    extra = jnp.stack([views.depth, views.rgb[..., 0] * 2], axis=-1)
    plain, rich = from_views(views, spec=SPEC), from_views(views, spec=SPEC, features=extra)
    assert rich.features.shape == (12, 8, 4, 5)
    np.testing.assert_allclose(rich.features[..., :3], plain.features, atol=1e-6)
    np.testing.assert_allclose(rich.features[..., 4], 2 * plain.features[..., 0], atol=1e-6)
    single = from_views(jax.tree.map(lambda leaf: leaf[2:3], views), spec=SPEC)
    assert 0 < single.count.sum() < plain.count.sum()


def rough_views(seed=0):
    """Views of nothing in particular: every pixel at a depth of its own, some without."""
    views, rng = table_views(size=(24, 32)), np.random.default_rng(seed)
    depth = np.where(views.depth > 0, views.depth * rng.uniform(0.9, 1.0, views.depth.shape), 0.0)
    return views.replace(depth=jnp.asarray(depth * (rng.random(depth.shape) < 0.9), jnp.float32))


surface_features = jax.jit(topdown.surface_features, static_argnames="spec")


def slow_surface(views, features):
    """Look for every cell's highest point in every view, read the feature there, and average."""
    total, count = np.zeros((SPEC.rows, SPEC.cols, features.shape[-1])), np.zeros((SPEC.rows, SPEC.cols, 1))
    points = np.asarray(jax.jit(jax.vmap(camera.unproject))(views.depth, views.camera))
    for cloud_, depth, grid in zip(points, np.asarray(views.depth), features, strict=True):
        best = {}
        for i, j in np.argwhere(depth > 0):
            x, y, z = cloud_[i, j]
            cell = int(np.floor((y - SPEC.y[0]) / SPEC.cell)), int(np.floor((x - SPEC.x[0]) / SPEC.cell))
            inside = 0 <= cell[0] < SPEC.rows and 0 <= cell[1] < SPEC.cols and -0.01 <= z < SPEC.z[1]
            if inside and z >= best.get(cell, (-1,))[0]:
                best[cell] = z, i / depth.shape[0] * grid.shape[0], j / depth.shape[1] * grid.shape[1]
        for cell, (_, row, col) in best.items():
            row, col = (np.clip(at, 0, n - 1) for at, n in ((row, grid.shape[0]), (col, grid.shape[1])))
            i, j = (min(int(at), n - 2) for at, n in ((row, grid.shape[0]), (col, grid.shape[1])))
            a, b = row - i, col - j
            above, below = ((1 - b) * grid[k, j] + b * grid[k, j + 1] for k in (i, i + 1))
            total[cell] += (1 - a) * above + a * below
            count[cell] += 1
    return total / np.maximum(count, 1), count[..., 0]


def test_features_of_the_surface_equal_a_loop_and_any_order_of_views():
    views, features = rough_views(), np.random.default_rng(1).normal(size=(4, 5, 7, 3)).astype(np.float32)
    found = np.asarray(surface_features(views, features, spec=SPEC))
    slow, count = slow_surface(views, features)
    assert found.shape == (SPEC.rows, SPEC.cols, 3) and set(np.unique(count)) >= {1, 2, 3}
    same = np.isclose(found, slow, atol=1e-4).all(-1)
    assert same.mean() > 0.97, "a point on a cell's border may round either way"
    order = np.array([2, 0, 3, 1])
    mixed = surface_features(jax.tree.map(lambda leaf: leaf[order], views), features[order], spec=SPEC)
    np.testing.assert_allclose(mixed, found, atol=1e-5)
    blind = views.replace(depth=views.depth.at[1:].set(0.0))
    alone, seen = slow_surface(blind, features)
    found = np.asarray(surface_features(blind, features, spec=SPEC))
    assert (found[seen == 0] == 0).mean() > 0.97 and np.isclose(found, alone, atol=1e-4).all(-1).mean() > 0.97


def test_a_batch_is_the_same_by_map_and_by_vmap():
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), table_views(), table_views((3, 2, 1, 0)))
    loop = [from_views(jax.tree.map(lambda leaf: leaf[i], batch), spec=SPEC, floor_margin=0.02) for i in range(2)]  # noqa: B023
    loop = jax.tree.map(lambda *leaves: jnp.stack(leaves), *loop)
    for method in ("auto", "map", "vmap"):
        fused = topdown.from_views_batch(batch, spec=SPEC, method=method, floor_margin=0.02)
        assert np.abs(fused.count - loop.count).sum() <= 4
        np.testing.assert_allclose(fused.height, loop.height, atol=1e-6)
    with pytest.raises(ValueError, match="method must be one of .*got 'loop'"):
        topdown.from_views_batch(batch, spec=SPEC, method="loop")


def test_max_height_equals_a_loop():
    rng = np.random.default_rng(0)
    count = rng.integers(0, 2, (6, 5, 4)) * rng.integers(0, 2, (6, 5, 1))
    features = rng.random((6, 5, 4, 3)) * (count > 0)[..., None]
    height = rng.random((6, 5))
    fields = (jnp.asarray(a, jnp.float32) for a in (features, count, np.zeros((6, 5, 4, 2)), height, np.zeros((6, 5, 2))))
    seen = max_height(types.TopDownMap(*fields))
    alone = topdown.highest(jnp.asarray(features, jnp.float32), jnp.asarray(count > 0))
    np.testing.assert_array_equal(alone, seen[..., :3])
    for i in range(6):
        for j in range(5):
            layers = np.flatnonzero(count[i, j])
            expected = features[i, j, layers[-1]] if len(layers) else np.zeros(3)
            np.testing.assert_allclose(seen[i, j], [*expected, height[i, j]], atol=1e-6)


def test_keep_highest_equals_a_loop():
    fused = fuse(*map(jnp.asarray, cloud(seed=2)), spec=SPEC)
    kept = topdown.keep_highest(fused)
    for row, col in np.ndindex(SPEC.rows, SPEC.cols):
        layers = np.flatnonzero(np.asarray(fused.count[row, col]))
        for name in ("features", "count", "offset"):
            before, after = (np.asarray(getattr(one, name)[row, col]) for one in (fused, kept))
            expected = np.zeros_like(before)
            expected[layers[-1:]] = before[layers[-1:]]
            np.testing.assert_array_equal(after, expected)
    assert (kept.count > 0).sum() < (fused.count > 0).sum() - 50
    np.testing.assert_array_equal(max_height(kept), max_height(fused))
    np.testing.assert_array_equal(kept.skin, fused.skin)


def test_half_turn_is_the_map_of_turned_points():
    points, features, valid = cloud(seed=4)
    turned = points * np.array([-1, -1, 1]) + np.array([sum(SPEC.x), sum(SPEC.y), 0])
    there = fuse(jnp.asarray(turned, jnp.float32), jnp.asarray(features), jnp.asarray(valid), spec=SPEC)
    here = topdown.half_turn(fuse(*map(jnp.asarray, (points, features, valid)), spec=SPEC))
    np.testing.assert_array_equal(there.count, here.count)
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=2e-5), there, here)
    jax.tree.map(np.testing.assert_array_equal, topdown.half_turn(topdown.half_turn(here)), here)


def test_fused_features_are_differentiable():
    points, features, valid = map(jnp.asarray, cloud())
    weights = jnp.asarray(np.random.default_rng(3).random((SPEC.rows, SPEC.cols, SPEC.slices, 3)), jnp.float32)
    gradient = jax.grad(lambda f: (fuse(points, f, valid, spec=SPEC).features * weights).sum())(features)
    fused = fuse(points, features, valid, spec=SPEC)
    step = 0.5 * jnp.sign(gradient)
    change = (fuse(points, features + step, valid, spec=SPEC).features - fused.features) * weights
    np.testing.assert_allclose((gradient * step).sum(), change.sum(), rtol=1e-4)  # the mean is linear in the features
