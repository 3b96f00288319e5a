"""Augmentation keeps what it must: colours' identity, relative poses, the map."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_losses import SPEC, on_device, state_of

from lala_jax import augment, losses, train_step, types
from lala_jax.perception import transforms
from lala_jax.sim import tasks

PALETTE = jnp.asarray(train_step.palette(tasks.get("pallet")))


def test_recolor_without_noise_deals_the_palette():
    state = state_of("pallet")
    for seed in range(5):
        new = augment.recolor(jax.random.key(seed), on_device(state), palette=PALETTE, jitter=0.0, mix=0.0)
        distance = np.linalg.norm(np.asarray(new.color)[:, None] - np.asarray(PALETTE)[None], axis=-1)
        assert (distance.min(1) < 1e-6).all()
        assert len(set(distance.argmin(1))) == len(state.color)


def test_recolor_keeps_colours_apart_and_in_range():
    """Mirrored and permuted channels keep every distance between two colours."""
    state = state_of("pallet")
    gaps = np.linalg.norm(np.asarray(PALETTE)[:, None] - np.asarray(PALETTE)[None], axis=-1)
    closest = gaps[~np.eye(len(gaps), dtype=bool)].min()
    for seed in range(10):
        color = np.asarray(augment.recolor(jax.random.key(seed), on_device(state), palette=PALETTE, jitter=0.0, mix=1.0).color)
        apart = np.linalg.norm(color[:, None] - color[None], axis=-1)[~np.eye(len(color), dtype=bool)]
        assert apart.min() > closest - 1e-5
        assert color.min() >= 0 and color.max() <= 1


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
