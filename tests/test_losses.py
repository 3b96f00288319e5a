"""Labels and losses against slow numpy loops and the poses they come from."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax import losses, types
from lala_jax.perception import transforms
from lala_jax.sim import tasks

SPEC = types.MapSpec(cell=0.0125)


def state_of(name="pallet", seed=3):
    """A scene at its start as a training state, nothing placed."""
    scene = tasks.get(name).sample(seed)
    nothing = np.zeros(len(scene.size), bool)
    fields = {field: getattr(scene, field) for field in ("size", "color", "base", "goal", "symmetry")}
    return types.State(**fields, poses=scene.start, placed=nothing, ready=~nothing)


def on_device(state):
    """The same state with JAX leaves, as training has it."""
    return jax.tree.map(jnp.asarray, state)


def top_owner(state, xy):
    """The object whose top face is highest over a point, and how far inside the face the point is; slow and obvious."""
    best = (-np.inf, -1, 0.0)
    for index, (pose, size) in enumerate(zip(state.poses, state.size, strict=True)):
        local = transforms.apply_pose(transforms.pose_inverse(np.asarray(pose, float)), np.array([*xy, pose[2]]))
        inside = float((np.asarray(size[:2]) / 2 - np.abs(local[:2])).min())
        if inside > 0:
            best = max(best, (float(pose[2] + size[2] / 2), index, inside))
    return best[1:]


@pytest.mark.parametrize("name", ["tower", "pallet"])
@pytest.mark.parametrize("built", [False, True])
def test_pick_valid_equals_loop(name, built):
    """Beside each other, and one upon the other: what lies below is no pick."""
    state = state_of(name)
    state = state.replace(poses=state.goal) if built else state
    valid = np.asarray(losses.pick_valid(on_device(state), spec=SPEC))
    assert valid.any((1, 2)).all() == (not built)
    centres = np.asarray(losses.cell_centres(SPEC))
    for row in range(0, SPEC.rows):
        for col in range(row % 3, SPEC.cols, 3):  # every third cell, all columns in turn
            xy = centres[row, col]
            index, inside = top_owner(state, xy)
            expected = np.zeros(len(state.size), bool)
            if index >= 0 and inside > losses.PICK_MARGIN:
                expected[index] = True
            if abs(inside - losses.PICK_MARGIN) > 1e-5:
                assert (valid[:, row, col] == expected).all(), (row, col)


@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_place_label_brings_the_object_to_its_goal(name):
    """Turning by the label's yaw about the pick and moving it to the label's xy ends at the goal pose, or its symmetric twin."""
    state = state_of(name, seed=5)
    for index in range(len(state.size)):
        pick = state.poses[index, :2] + np.array([0.007, -0.004], np.float32)
        label = losses.place_label(on_device(state), jnp.int32(index), jnp.asarray(pick))
        assert int(label.valid.sum()) == round(2 * math.pi / float(state.symmetry[index]))
        for xy, yaw, valid in zip(*map(np.asarray, (label.xy, label.yaw, label.valid)), strict=True):
            if not valid:
                continue
            cos, sin = np.cos(yaw), np.sin(yaw)
            moved = xy + np.array([[cos, -sin], [sin, cos]]) @ (state.poses[index, :2] - pick)
            np.testing.assert_allclose(moved, state.goal[index, :2], atol=1e-5)
            off = transforms.yaw_from_quat(state.poses[index, 3:]) + yaw - transforms.yaw_from_quat(state.goal[index, 3:])
            assert abs(float(transforms.wrap_angle(off, float(state.symmetry[index])))) < 1e-4


pick_valid = jax.jit(losses.pick_valid, static_argnames=("spec", "share"))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.9])
@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_a_share_of_the_face_is_part_of_it_and_about_its_middle(name, share):
    """Never empty for a face that is seen whole, whatever its yaw; a cell is in it exactly where a slow look finds it near the middle."""
    centres = np.asarray(losses.cell_centres(SPEC))
    for seed in range(4):
        state = on_device(state_of(name, seed))
        middle, whole = np.asarray(pick_valid(state, spec=SPEC, share=share)), np.asarray(pick_valid(state, spec=SPEC))
        assert middle.any((1, 2)).all()
        for index, (pose, size) in enumerate(zip(np.asarray(state.poses, float), np.asarray(state.size, float), strict=True)):
            cells = np.argwhere(whole[index] | middle[index])
            points = np.column_stack([centres[tuple(cells.T)], np.full(len(cells), pose[2])])
            local = np.abs(transforms.apply_pose(transforms.pose_inverse(pose), points)[:, :2])
            most = np.maximum(share * (size[:2] / 2 - losses.PICK_MARGIN), 0.71 * SPEC.cell)
            clear = (np.abs(local - most) > 1e-5).all(-1)
            np.testing.assert_array_equal(middle[index][tuple(cells.T)][clear], (local < most).all(-1)[clear])
            if share * (size[:2] / 2 - losses.PICK_MARGIN).min() > 0.71 * SPEC.cell:
                assert not (middle[index] & ~whole[index]).any()


def test_a_share_is_part_of_the_whole_where_cells_are_small():
    """At the cells that agents use, the middle half of a face lies in its right picks, on every object; and shares are nested."""
    spec = types.MapSpec(cell=0.00625)
    state = on_device(state_of("pallet"))
    masks = [np.asarray(pick_valid(state, spec=spec, share=share)) for share in (0.2, 0.5, 0.8, 1.0)]
    for inner, outer in zip(masks, masks[1:], strict=False):
        assert not (inner & ~outer).any() and (inner.sum((1, 2)) <= outer.sum((1, 2))).all()
    assert masks[0].any((1, 2)).all() and masks[1].sum() < 0.5 * masks[3].sum()


@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_quarter_label_equals_place_label_for_the_turns_that_look_alike(name):
    state = on_device(state_of(name, seed=5))
    squares = 0
    for index in range(len(state.size)):
        pick = state.poses[index, :2] + jnp.array([0.007, -0.004])
        quarter, label = losses.quarter_label(state, jnp.int32(index), pick), losses.place_label(state, jnp.int32(index), pick)
        count = round(2 * math.pi / float(state.symmetry[index]))
        squares += count == 4
        assert np.asarray(quarter.valid).tolist() == [True, count == 4, True, count == 4]
        for field in ("xy", "yaw"):
            alike, given = np.asarray(getattr(quarter, field))[:: 4 // count], np.asarray(getattr(label, field))[:count]
            off = transforms.wrap_angle(alike - given) if field == "yaw" else alike - given
            np.testing.assert_allclose(off, 0, atol=1e-5)
    assert squares == (len(state.size) if name == "tower" else 0)


def test_quarter_label_brings_the_object_to_its_goal_turned_by_quarters():
    """The box's corners land on those of its goal, turned by the quarter about the goal's middle."""
    state = state_of("pallet", seed=5)
    corners = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) / 2
    for index in range(len(state.size)):
        pose, goal, size = (np.asarray(leaf[index], float) for leaf in (state.poses, state.goal, state.size))
        pick = pose[:2] + np.array([-0.006, 0.011])
        label = losses.quarter_label(on_device(state), jnp.int32(index), jnp.asarray(pick, jnp.float32))
        frame = [np.append(p[:2], transforms.yaw_from_quat(p[3:])) for p in (pose, goal)]
        now = transforms.apply_se2(frame[0], corners * size[:2])
        for quarter, (xy, yaw) in enumerate(zip(np.asarray(label.xy), np.asarray(label.yaw), strict=True)):
            moved = transforms.apply_se2(np.array([*xy, yaw]), now - pick)  # the picked point lands at xy, all turned about it
            wanted = transforms.apply_se2(frame[1] + np.array([0, 0, quarter * np.pi / 2]), corners * size[:2])
            np.testing.assert_allclose(moved, wanted, atol=2e-5)
    lone = on_device(state).replace(symmetry=jnp.full(8, 2 * math.pi))
    assert np.asarray(losses.quarter_label(lone, jnp.int32(0), lone.poses[0, :2]).valid).tolist() == [True, False, False, False]


def test_place_index_masks_what_leaves_the_map():
    state = state_of()
    label = losses.place_label(on_device(state), jnp.int32(0), jnp.asarray(state.poses[0, :2]))
    bins, cells, valid = losses.place_index(label, spec=SPEC, rotations=36)
    assert (np.asarray(valid) == np.asarray(label.valid)).all()
    assert (np.abs(np.asarray(types.world_from_index(SPEC, cells)) - np.asarray(label.xy)) <= SPEC.cell / 2 + 1e-6).all()
    off = np.asarray(label.yaw) - np.asarray(bins) * 2 * math.pi / 36
    assert (np.abs(transforms.wrap_angle(off)) <= math.pi / 36 + 1e-5).all()
    outside = label.replace(xy=label.xy + 2.0)
    assert not np.asarray(losses.place_index(outside, spec=SPEC, rotations=36)[2]).any()


@pytest.mark.parametrize("how", [lambda f: f, jax.jit])
def test_masked_cross_entropy_equals_numpy(how):
    rng = np.random.default_rng(0)
    logits, valid = rng.normal(size=(7, 5)).astype(np.float32) * 4, rng.random((7, 5)) < 0.3
    probability = np.exp(logits.astype(float)) / np.exp(logits.astype(float)).sum()
    loss = how(losses.masked_cross_entropy)(jnp.asarray(logits), jnp.asarray(valid))
    np.testing.assert_allclose(loss, -np.log(probability[valid].sum()), rtol=1e-5)
    assert how(losses.masked_cross_entropy)(jnp.asarray(logits), jnp.zeros_like(valid)) == 0


def test_place_cross_entropy_equals_masked():
    rng = np.random.default_rng(1)
    logits = rng.normal(size=(6, 9, 8)).astype(np.float32)
    bins, cells = np.array([1, 4, 2, 0]), np.array([[3, 2], [8, 7], [0, 0], [5, 5]])
    valid = np.array([True, True, False, False])
    mask = np.zeros(logits.shape, bool)
    mask[1, 3, 2] = mask[4, 8, 7] = True
    loss = losses.place_cross_entropy(jnp.asarray(logits), jnp.asarray(bins), jnp.asarray(cells), jnp.asarray(valid))
    np.testing.assert_allclose(loss, losses.masked_cross_entropy(jnp.asarray(logits), jnp.asarray(mask)), rtol=1e-5)


@pytest.mark.parametrize("where", ["goal", "start"])
def test_owner_finds_the_box_a_point_is_in(where):
    """In boxes that stand close to each other, and in boxes turned anyhow; just outside a face there is none."""
    scene = tasks.get("pallet").sample(2)
    poses = getattr(scene, where)
    rng = np.random.default_rng(0)
    local = rng.uniform(-0.45, 0.45, (8, 20, 3)) * scene.size[:, None]

    def whose(local, tolerance):
        points = transforms.apply_pose(poses[:, None].astype(float), local).reshape(-1, 3)
        found = losses.owner(jnp.asarray(points, jnp.float32), poses=poses, size=scene.size, tolerance=tolerance)
        return np.asarray(found).reshape(8, -1)

    assert (whose(local, 0.005) == np.arange(8)[:, None]).all()
    if where == "start":  # each by itself
        beside = np.array([[1, 0.9, 0], [-1, -0.9, 0], [0.9, 1, 0], [-0.9, -1, 0]]) * scene.size[:, None] / 2
        outwards = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
        assert (whose(beside + 0.004 * outwards, 0.005) == np.arange(8)[:, None]).all()
        assert (whose(beside + 0.006 * outwards, 0.005) == -1).all()


def test_huber_is_quadratic_then_linear():
    error = np.linspace(-3, 3, 61).astype(np.float32)
    expected = np.where(np.abs(error) < 1, error**2 / 2, np.abs(error) - 0.5)
    np.testing.assert_allclose(losses.huber(jnp.asarray(error)), expected, atol=1e-6)
