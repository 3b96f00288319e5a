"""Augmentation keeps what it must: colours' identity, relative poses, the map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_losses import SPEC, on_device, state_of

from lala_jax import augment, losses, train_step, types
from lala_jax.perception import transforms
from lala_jax.sim import tasks
from lala_jax.sim.tasks import base

PALETTE = jnp.asarray(train_step.palette(tasks.get("pallet")))


def closest(colors):
    """The distance of the closest two colours, by a loop."""
    return min(float(np.linalg.norm(a - b)) for i, a in enumerate(np.asarray(colors)) for b in np.asarray(colors)[:i])


def test_recolor_without_noise_deals_the_palette():
    state = state_of("pallet")
    for seed in range(5):
        new = augment.recolor(jax.random.key(seed), on_device(state), palette=PALETTE, jitter=0.0, mix=0.0)
        distance = np.linalg.norm(np.asarray(new.color)[:, None] - np.asarray(PALETTE)[None], axis=-1)
        assert (distance.min(1) < 1e-6).all()
        assert len(set(distance.argmin(1))) == len(state.color)


def test_recolor_keeps_colours_apart_and_in_range():
    """Colours drawn anywhere are as far apart as the closest two of the palette, or as told."""
    state, drawn = state_of("pallet"), jax.jit(augment.recolor, static_argnames=("jitter", "mix"))
    assert base.APART == pytest.approx(closest(PALETTE))
    colors = []
    for seed in range(40):
        for apart in (None, 0.3):
            color = np.asarray(drawn(jax.random.key(seed), on_device(state), palette=PALETTE, jitter=0.0, mix=1.0, apart=apart).color)
            assert closest(color) > (apart or base.APART) - 1e-5
            assert color.min() >= 0 and color.max() <= 1
        colors.append(color)
    assert np.abs(np.mean(colors, (0, 1)) - 0.5).max() < 0.08
    assert np.min(colors, (0, 1)).max() < 0.05 and np.max(colors, (0, 1)).min() > 0.95


def test_recolor_mixes_palette_and_other_colours():
    state, drawn = state_of("pallet"), jax.jit(augment.recolor, static_argnames=("jitter", "mix"))
    known = 0
    for seed in range(40):
        color = np.asarray(drawn(jax.random.key(seed), on_device(state), palette=PALETTE, jitter=0.0, mix=0.5).color)
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
        augment.recolor(jax.random.key(0), on_device(state_of("pallet")), palette=PALETTE[:7])


@pytest.mark.parametrize("name", ["tower", "pallet"])
def test_rigid_moves_everything_by_one_motion(name):
    """The base, the objects and the goal move together: every relative pose stays, and all stay on the map."""
    state = state_of(name)
    moved_some, motion = False, jax.jit(augment.rigid, static_argnames=("spec", "base_radius"))
    for seed in range(12):
        new = motion(jax.random.key(seed), on_device(state), spec=SPEC, base_radius=0.04)
        for field in ("poses", "goal"):
            before = transforms.pose_multiply(transforms.pose_inverse(state.base.astype(float)), getattr(state, field).astype(float))
            after = transforms.pose_multiply(transforms.pose_inverse(np.asarray(new.base, float)), np.asarray(getattr(new, field), float))
            np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-5)
            np.testing.assert_allclose(np.abs((after[:, 3:] * before[:, 3:]).sum(-1)), 1, atol=1e-5)
            inside = types.in_map(SPEC, types.index_from_world(SPEC, jnp.asarray(getattr(new, field))[:, :2]))
            assert np.asarray(inside).all()
        moved_some |= not np.allclose(new.base, state.base, atol=1e-3)
    assert moved_some


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
