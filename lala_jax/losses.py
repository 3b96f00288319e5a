"""Labels and losses: every right action counts, as a log-sum-exp over the valid set.

All functions are unbatched. The paper's one-hot cross-entropy (eqs. 4-6) is the case of a valid set of one;
the paper itself names supervising all possible actions as the remedy it did not try (section VI.C).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import struct

from lala_jax import types
from lala_jax.perception import transforms

MAX_SYMMETRY = 4  # yaws that look alike, at most: a square's four
PICK_MARGIN = 0.009  # metres kept from a face's edge, the suction cup's radius and a little


@struct.dataclass
class PlaceLabel:
    """Every right place of one picked point; S = MAX_SYMMETRY entries, those beyond the object's symmetry masked out."""

    xy: jax.Array  # [S, 2] metres
    yaw: jax.Array  # [S] radians in 0..2 pi
    valid: jax.Array  # [S] bool


def cell_centres(spec: types.MapSpec) -> jax.Array:
    """Give the centre `[rows, cols, 2]` of every cell in metres."""
    rows, cols = jnp.meshgrid(jnp.arange(spec.rows), jnp.arange(spec.cols), indexing="ij")
    return types.world_from_index(spec, jnp.stack([rows, cols], axis=-1))


def pick_valid(state: types.State, *, spec: types.MapSpec, margin: float = PICK_MARGIN, share: float = 1.0) -> jax.Array:
    """Mark which cells are right picks of which object, `[N, rows, cols]` bool.

    A cell belongs to the object whose top face is the highest over the cell's centre, and is a pick where
    the centre is at least `margin` metres inside that face, in the middle `share` of what this leaves of each side (but
    at least within 0.71 cells of the middle, so that a cell is left). Objects are taken as upright boxes.
    """
    centres = cell_centres(spec)

    def one(pose, size):
        world_from_object = jnp.append(pose[:2], transforms.yaw_from_quat(pose[3:]))
        object_from_world = transforms.se2_inverse(world_from_object)
        local = jnp.abs(transforms.apply_se2(object_from_world, centres))
        covered = (local < size[:2] / 2).all(-1)
        inside = (local < jnp.maximum(share * (size[:2] / 2 - margin), 0.71 * spec.cell)).all(-1)
        return jnp.where(covered, pose[2] + size[2] / 2, -jnp.inf), inside

    tops, inside = jax.vmap(one)(state.poses, state.size)
    return inside & (tops >= tops.max(0)) & jnp.isfinite(tops)


def place_label(state: types.State, index: jax.Array, pick_xy: jax.Array) -> PlaceLabel:
    """Give every right place of the point `pick_xy` `[2]` (metres) on object `index`: its goal pose and the yaws that look alike."""
    turns, symmetry = jnp.arange(MAX_SYMMETRY), state.symmetry[index]
    xy, yaw = _at_goal(state, index, pick_xy, turns * symmetry)
    return PlaceLabel(xy=xy, yaw=yaw, valid=turns < jnp.round(2 * math.pi / symmetry))


def quarter_label(state: types.State, index: jax.Array, pick_xy: jax.Array) -> PlaceLabel:
    """Give the places of `pick_xy` with object `index` at its goal, turned by 0..3 quarters; `valid` marks the turns that look alike."""
    turns = jnp.arange(4) * (math.pi / 2) + 0 * state.symmetry[index]  # no number where the symmetry is none: the loss must say so
    xy, yaw = _at_goal(state, index, pick_xy, turns)
    off = turns / state.symmetry[index]
    return PlaceLabel(xy=xy, yaw=yaw, valid=jnp.abs(off - jnp.round(off)) < 1e-3)


def _at_goal(state, index, pick_xy, turns):
    """Say where a picked point goes, and by which yaw in 0..2 pi, when its object comes to its goal, turned by `turns` `[S]` more."""
    now, goal = state.poses[index], state.goal[index]
    yaw = transforms.yaw_from_quat(goal[3:]) - transforms.yaw_from_quat(now[3:]) + turns
    motion = transforms.se2_about(now[:2], yaw, goal[:2] - now[:2])
    return transforms.apply_se2(motion, pick_xy), jnp.mod(yaw, 2 * math.pi)


def place_index(label: PlaceLabel, *, spec: types.MapSpec, rotations: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Give bins `[S]`, cells `[S, 2]` and which of them are valid and on the map `[S]`."""
    bins = jnp.mod(jnp.round(label.yaw * rotations / (2 * math.pi)).astype(jnp.int32), rotations)
    cells = types.index_from_world(spec, label.xy)
    return bins, cells, label.valid & types.in_map(spec, cells)


def masked_cross_entropy(logits: jax.Array, valid: jax.Array) -> jax.Array:
    """Give `-log sum_{valid} softmax(logits)` over all axes; 0 where nothing is valid."""
    logits, valid = logits.ravel(), valid.ravel()
    right = jax.nn.logsumexp(jnp.where(valid, logits, -1e9))
    return jnp.where(valid.any(), jax.nn.logsumexp(logits) - right, 0.0)


def place_cross_entropy(logits: jax.Array, bins: jax.Array, cells: jax.Array, valid: jax.Array) -> jax.Array:
    """Give the multi-action cross-entropy of place logits `[k, rows, cols]` for up to S right (bin, cell)s; 0 where none is valid."""
    _, rows, cols = logits.shape
    row, col = jnp.clip(cells[:, 0], 0, rows - 1), jnp.clip(cells[:, 1], 0, cols - 1)
    right = jax.nn.logsumexp(jnp.where(valid, logits[bins, row, col], -1e9))
    return jnp.where(valid.any(), jax.nn.logsumexp(logits) - right, 0.0)


def owner(points: jax.Array, *, poses: jax.Array, size: jax.Array, tolerance: float) -> jax.Array:
    """Say which box `[N, ...]` each world point `[P, 3]` belongs to: int32 `[P]`, -1 for none within `tolerance` metres."""

    def excess(pose, extent):
        local = transforms.apply_pose(transforms.pose_inverse(pose), points)
        return (jnp.abs(local) - extent / 2).max(-1)

    distance = jax.vmap(excess)(poses, size)
    nearest = distance.argmin(0)
    return jnp.where(distance.min(0) < tolerance, nearest, -1)


def huber(error: jax.Array, *, delta: float = 1.0) -> jax.Array:
    """Give the Huber loss elementwise."""
    size = jnp.abs(error)
    return jnp.where(size < delta, 0.5 * error**2, delta * (size - 0.5 * delta))
