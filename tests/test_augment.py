"""Augmentation keeps what it must: colours' identity, relative poses, the map; sensors err as often and as far as told."""

import functools
import types as python_types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_losses import SPEC, on_device, state_of

from lala_jax import augment, losses, train_step, types
from lala_jax.perception import camera, noise, transforms
from lala_jax.sim import tasks
from lala_jax.sim.tasks import base

PALETTE = jnp.asarray(train_step.palette(tasks.get("pallet")))
recolor = jax.jit(augment.recolor, static_argnames=("jitter", "mix"))


def closest(colors):
    """The distance of the closest two colours, by a loop."""
    return min(float(np.linalg.norm(a - b)) for i, a in enumerate(np.asarray(colors)) for b in np.asarray(colors)[:i])


def test_recolor_without_noise_deals_the_palette():
    state = state_of("pallet")
    for seed in range(5):
        new = augment.recolor(jax.random.key(seed), on_device(state), palette=PALETTE, apart=base.APART, jitter=0.0, mix=0.0)
        distance = np.linalg.norm(np.asarray(new.color)[:, None] - np.asarray(PALETTE)[None], axis=-1)
        assert (distance.min(1) < 1e-6).all()
        assert len(set(distance.argmin(1))) == len(state.color)


def test_recolor_keeps_colours_apart_and_in_range():
    """Colours drawn anywhere are as far apart as the closest two of the palette, or as told."""
    state = state_of("pallet")
    assert base.APART == pytest.approx(closest(PALETTE))
    colors = []
    for seed in range(40):
        for apart in (base.APART, 0.3):
            color = np.asarray(recolor(jax.random.key(seed), on_device(state), palette=PALETTE, jitter=0.0, mix=1.0, apart=apart).color)
            assert closest(color) > apart - 1e-5
            assert color.min() >= 0 and color.max() <= 1
        colors.append(color)
    assert np.abs(np.mean(colors, (0, 1)) - 0.5).max() < 0.08
    assert np.min(colors, (0, 1)).max() < 0.05 and np.max(colors, (0, 1)).min() > 0.95


def test_recolor_mixes_palette_and_other_colours():
    state = state_of("pallet")
    known = 0
    for seed in range(40):
        color = np.asarray(recolor(jax.random.key(seed), on_device(state), palette=PALETTE, apart=base.APART, jitter=0.0, mix=0.5).color)
        near = np.linalg.norm(color[:, None] - np.asarray(PALETTE), axis=-1).min(-1) < 1e-6
        assert near.all() or not near.any()
        known += int(near.all())
    assert 8 < known < 32


@pytest.mark.parametrize("apart", [0.2, 0.5, 5.0])
def test_spread_equals_a_loop(apart):
    points = np.random.default_rng(0).random((20, 3)).astype(np.float32)
    chosen = []
    for _ in range(8):
        distance = [min((np.linalg.norm(point - other) for other in chosen), default=np.inf) for point in points]
        chosen.append(next((point for point, far in zip(points, distance, strict=True) if far >= apart), points[np.argmax(distance)]))
    np.testing.assert_array_equal(augment.spread(jnp.asarray(points), 8, apart=apart), chosen)


def test_recolor_refuses_more_objects_than_colours():
    with pytest.raises(ValueError, match="8 objects cannot be recoloured from a palette of 7"):
        augment.recolor(jax.random.key(0), on_device(state_of("pallet")), palette=PALETTE[:7], apart=base.APART)


@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_rigid_moves_everything_by_one_motion(name):
    """The base, the objects and the goal move together: every relative pose stays, and all stay on the map."""
    state = state_of(name)
    corners = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]]) * np.asarray(state.size)[:, None] / 2
    motion = jax.jit(augment.rigid, static_argnames=("spec", "base_radius"))
    for seed in range(40):
        new = motion(jax.random.key(seed), on_device(state), spec=SPEC, base_radius=0.04)
        for field in ("poses", "goal"):
            before = transforms.pose_multiply(transforms.pose_inverse(state.base.astype(float)), getattr(state, field).astype(float))
            after = transforms.pose_multiply(transforms.pose_inverse(np.asarray(new.base, float)), np.asarray(getattr(new, field), float))
            np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-5)
            np.testing.assert_allclose(np.abs((after[:, 3:] * before[:, 3:]).sum(-1)), 1, atol=1e-5)
            covered = transforms.apply_pose(np.asarray(getattr(new, field), float)[:, None], corners)[..., :2]
            low, high = np.array([SPEC.x, SPEC.y]).T
            assert (covered > low - 1e-5).all() and (covered < high + 1e-5).all()


def test_rigid_motions_are_spread_as_they_say():
    """Of a speck in the middle of the map nearly all fit: turns of N(0, 60 degrees), shifts of N(0, a sixth of the map)."""
    state, middle = state_of("tower"), np.array([sum(SPEC.x) / 2, sum(SPEC.y) / 2, 0, 1, 0, 0, 0], np.float32)
    all_there = np.stack([middle] * len(state.size))
    speck = on_device(state.replace(size=np.full_like(state.size, 1e-3), poses=all_there, goal=all_there, base=middle))
    keys = jax.random.split(jax.random.key(0), 2000)
    base = np.asarray(jax.jit(jax.vmap(lambda key: augment.rigid(key, speck, spec=SPEC, base_radius=1e-3)))(keys).base, float)
    yaw = 2 * np.arctan2(base[:, 6], base[:, 3])
    assert 0.29 < (np.abs(transforms.wrap_angle(yaw)) > np.radians(60)).mean() < 0.35  # 0.317 of a normal distribution
    sixth = np.array([SPEC.x[1] - SPEC.x[0], SPEC.y[1] - SPEC.y[0]]) / 6
    np.testing.assert_allclose((base[:, :2] - middle[:2]).std(0) / sixth, 0.987, atol=0.04)  # cut off at three deviations
    assert np.abs((base[:, :2] - middle[:2]).mean(0) / sixth).max() < 0.1


@pytest.mark.parametrize("recolor", [False, True])
@pytest.mark.parametrize("rigid", [False, True])
def test_examples_are_disturbed_as_the_recipe_says(recolor, rigid):
    state, observer = on_device(state_of("tower")), python_types.SimpleNamespace(task=tasks.get("tower"), spec=SPEC)
    keys = jax.random.split(jax.random.key(0), 20)
    disturb = functools.partial(train_step.augmented, observer=observer, recolor=recolor, mix=0.5, rigid=rigid)
    new = jax.jit(jax.vmap(disturb, (0, None)))(keys, state)
    assert (np.abs(new.color - state.color).max((1, 2)) > 0.01).mean() == (1 if recolor else 0)
    for field in ("poses", "goal", "base"):
        moved = np.abs(getattr(new, field) - getattr(state, field)).reshape(20, -1).max(1) > 1e-3
        assert moved.any() == rigid
    for field in ("size", "symmetry", "placed", "ready"):
        assert (np.asarray(getattr(new, field)) == np.asarray(getattr(state, field))).all()


def test_rigid_motion_carries_the_labels():
    """The place of a moved pick is the moved place, and its yaw is the same."""
    state = state_of("pallet", seed=1)
    new = augment.rigid(jax.random.key(3), on_device(state), spec=SPEC, base_radius=0.04)
    local = np.array([0.01, -0.005, 0.0])
    for index in range(3):
        picks = [transforms.apply_pose(np.asarray(s.poses[index], float), local)[:2] for s in (state, new)]
        labels = [
            losses.place_label(on_device(s), index, jnp.asarray(pick, jnp.float32)) for s, pick in zip((state, new), picks, strict=True)
        ]
        world = transforms.pose_multiply(np.asarray(new.base, float), transforms.pose_inverse(state.base.astype(float)))
        old = np.concatenate([np.asarray(labels[0].xy), np.zeros((4, 1))], axis=-1)
        np.testing.assert_allclose(transforms.apply_pose(world, old)[:, :2], labels[1].xy, atol=1e-5)
        np.testing.assert_allclose(transforms.wrap_angle(np.asarray(labels[0].yaw - labels[1].yaw)), 0, atol=1e-4)


def test_rigid_leaves_a_scene_that_cannot_move():
    """A base as large as the map fits nowhere else."""
    state = state_of("tower")
    new = augment.rigid(jax.random.key(0), on_device(state), spec=SPEC, base_radius=2.0)
    np.testing.assert_allclose(new.poses, state.poses, atol=1e-6)


@functools.cache
def some_views():
    """Three cameras' views of a slope, with a hole."""
    eyes = jnp.array([[0.9, 0.3, 0.7], [0.1, 0.5, 0.7], [0.3, 0.05, 0.9]])
    cameras = camera.pinhole(camera.look_at(eyes, jnp.array([0.5, 0.0, 0.0])), height=12, width=16, focal=20.0)
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 0.51, (3, 12, 16)) + np.linspace(0, 0.1, 16)
    depth[:, 2, 3] = 0
    return types.Views(rgb=jnp.asarray(rng.random((3, 12, 16, 3)), jnp.float32), depth=jnp.asarray(depth, jnp.float32), camera=cameras)


KEYS = jax.random.split(jax.random.key(7), 300), jax.random.split(jax.random.key(8), 300)


@functools.cache
def erring(**errors):
    """The views under 300 keys."""
    see = functools.partial(augment.sensors, errors=augment.Sensors(**errors), disparity=12.0)
    return jax.jit(jax.vmap(lambda key, key_noise: see(key, key_noise, some_views())))(*KEYS)


def test_scenes_err_in_a_batch_as_alone():
    """Bit for bit where there is noise and where there is none: one after the other or all at once."""
    errors = {"depth_noise": 0.5, "shift": 0.01, "turn": 1.0, "missing": 0.5}
    few = [keys[:12] for keys in KEYS]
    views = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (12, *leaf.shape)), some_views())
    batch = jax.jit(lambda *keys: augment.sensors_batch(*keys, views, augment.Sensors(**errors), disparity=12.0))(*few)
    see = jax.jit(lambda *keys: augment.sensors(*keys, some_views(), augment.Sensors(**errors), disparity=12.0))
    alone = [see(*keys) for keys in zip(*few, strict=True)]
    jax.tree.map(lambda found, *one: np.testing.assert_array_equal(found, np.stack(one)), batch, *alone)
    every = erring(**errors)
    np.testing.assert_allclose(batch.camera.world_from_cam, every.camera.world_from_cam[:12], atol=1e-6)
    assert ((batch.depth == 0) == (every.depth[:12] == 0)).mean() > 0.999 and np.isclose(
        batch.depth, every.depth[:12], atol=1e-6
    ).mean() > 0.99


def test_sensors_without_errors_change_nothing():
    assert not augment.Sensors() and augment.Sensors(missing=0.1) and augment.Sensors(turn=0.1)
    same = augment.sensors(KEYS[0][0], KEYS[1][0], some_views(), augment.Sensors(), disparity=12.0)
    for name in ("rgb", "depth"):
        np.testing.assert_array_equal(getattr(same, name), getattr(some_views(), name))
    np.testing.assert_allclose(same.camera.world_from_cam, some_views().camera.world_from_cam, atol=1e-7)


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_one_camera_or_none_is_missing(share):
    """Each as often as the others, the colours untouched; what the others see stays as it is."""
    views = erring(missing=share, shift=0.01, turn=2.0)
    lost = np.asarray((views.depth == 0).all((2, 3)))
    assert set(lost.sum(1)) <= {0, 1} and abs(lost.any(1).mean() - share) < 0.09  # three standard errors
    if share == 1:
        assert np.abs(lost.mean(0) - 1 / 3).max() < 0.09
    kept = np.broadcast_to(np.asarray(some_views().depth), lost.shape + (12, 16))
    np.testing.assert_array_equal(np.asarray(views.depth)[~lost], kept[~lost])
    np.testing.assert_array_equal(views.rgb, np.broadcast_to(some_views().rgb, views.rgb.shape))


def test_pictures_are_noisy_as_often_as_told():
    """A picture has the noise of `noise.depth_noise` by its own key, or none; all views of a scene alike."""
    views = erring(depth_noise=0.3)
    noisy = jax.jit(jax.vmap(lambda key: noise.depth_noise(key, some_views().depth, disparity=12.0)))(KEYS[1])
    is_noisy = np.isclose(views.depth, noisy, atol=1e-6).mean((1, 2, 3)) > 0.99  # rounding may move a disparity step
    is_clean = np.asarray((views.depth == some_views().depth).all((1, 2, 3)))
    assert (is_noisy ^ is_clean).all() and abs(is_noisy.mean() - 0.3) < 0.08


def test_a_key_gives_the_current_picture_and_the_goal_the_same_cameras():
    """The noise's key has no say in where the cameras are believed, which one is missing, nor in whether there is noise."""
    errors = augment.Sensors(depth_noise=0.5, shift=0.01, turn=1.0, missing=0.5)
    see = jax.jit(lambda key, key_noise: augment.sensors(key, key_noise, some_views(), errors, disparity=12.0))
    kinds = set()
    for number in range(12):
        now, goal = (see(KEYS[0][number], KEYS[1][number + other]) for other in (0, 100))
        np.testing.assert_array_equal(now.camera.world_from_cam, goal.camera.world_from_cam)
        lost = [np.asarray((v.depth == 0).all((1, 2))) for v in (now, goal)]
        clean = [bool((v.depth == some_views().depth).all((1, 2)).any()) for v in (now, goal)]
        np.testing.assert_array_equal(*lost)
        assert clean[0] == clean[1] and (clean[0] or not np.array_equal(now.depth, goal.depth))
        kinds.add((bool(lost[0].any()), clean[0]))
        off = np.asarray(now.camera.world_from_cam - some_views().camera.world_from_cam)[:, :3, 3]
        assert 0 < np.linalg.norm(off, axis=-1).max() <= 0.01 + 1e-6
    assert len(kinds) == 4, "missing and not, noisy and not"
    assert not np.array_equal(see(KEYS[0][0], KEYS[1][0]).camera.world_from_cam, see(KEYS[0][1], KEYS[1][0]).camera.world_from_cam)


def test_believed_cameras_move_within_bounds():
    cameras = erring(missing=1.0, shift=0.01, turn=2.0).camera
    before, after = np.asarray(some_views().camera.world_from_cam, float), np.asarray(cameras.world_from_cam, float)
    far = np.linalg.norm(after[..., :3, 3] - before[:, :3, 3], axis=-1)
    turns = after[..., :3, :3] @ np.swapaxes(before[:, :3, :3], -1, -2)
    angle = np.degrees(np.arccos(np.clip((np.trace(turns, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))
    assert 0.0095 < far.max() <= 0.01 + 1e-6 and 1.9 < angle.max() <= 2.0 + 1e-2
