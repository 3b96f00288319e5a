"""Rotations, rigid motions and their planar kin: quaternions are `(w, x, y, z)`, poses `[..., 7]`, motions of the plane `(x, y, yaw)`.

Every function takes leading batch dimensions, which broadcast. Numpy in gives numpy out, in its own precision and
without touching a device; one jax array among the arguments gives jax out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Num

# Shapes of the arguments, numpy or jax or nested sequences of numbers; results are arrays of the same shapes.
if TYPE_CHECKING:  # a static checker cannot do arithmetic with these unions; pytest checks them for real
    Angles = Vectors = Points2 = Motions = Quats = Poses = Rotations = Matrices = Any
else:
    _Any = Array | np.ndarray | np.generic
    Angles = Num[_Any, "..."] | float | Sequence
    Vectors = Num[_Any, "... 3"] | Sequence
    Points2 = Num[_Any, "... 2"] | Sequence
    Motions = Num[_Any, "... 3"] | Sequence
    Quats = Num[_Any, "... 4"] | Sequence
    Poses = Num[_Any, "... 7"] | Sequence
    Rotations = Num[_Any, "... 3 3"] | Sequence
    Matrices = Num[_Any, "... 4 4"] | Sequence


def to_arrays(*values):
    """Give the namespace (numpy, or jax.numpy if any value is a jax array) and the values as floating arrays in it."""
    xp = jnp if any(isinstance(value, jax.Array) for value in values) else np
    arrays = [xp.asarray(value) for value in values]
    return xp, *(a if xp.issubdtype(a.dtype, xp.floating) else a.astype(float) for a in arrays)


def same_batch(xp, *arrays):
    """Broadcast the leading dimensions of arrays whose last dimensions may differ."""
    lead = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
    return [xp.broadcast_to(a, lead + a.shape[-1:]) for a in arrays]


def wrap_angle(angle: Angles, period: Angles = 2 * math.pi) -> Angles:
    """Bring an angle in radians to the nearest equivalent of zero, `-period / 2 <= out <= period / 2`; `period` is the symmetry."""
    xp, angle, period = to_arrays(angle, period)
    return angle - period * xp.round(angle / period)


def quat_normalize(quat: Quats) -> Quats:
    """Scale a quaternion `[..., 4]` to unit length; zero becomes the identity."""
    xp, quat = to_arrays(quat)
    squared = (quat * quat).sum(-1, keepdims=True)
    nonzero = squared > 0
    identity = xp.zeros_like(quat) + xp.broadcast_to(xp.asarray([1.0, 0.0, 0.0, 0.0], quat.dtype), quat.shape)
    return xp.where(nonzero, quat / xp.sqrt(xp.where(nonzero, squared, xp.ones_like(squared))), identity)


def quat_multiply(a: Quats, b: Quats) -> Quats:
    """Multiply quaternions `[..., 4]`: the rotation that applies `b` first, then `a`."""
    xp, a, b = to_arrays(a, b)
    a, b = same_batch(xp, a, b)
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return xp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quat_inverse(quat: Quats) -> Quats:
    """Invert a unit quaternion `[..., 4]`."""
    xp, quat = to_arrays(quat)
    return xp.concatenate([quat[..., :1], -quat[..., 1:]], axis=-1)


def quat_from_yaw(yaw: Angles) -> Quats:
    """Give the quaternion `[..., 4]` of a right-handed turn by `yaw` radians about z."""
    xp, yaw = to_arrays(yaw)
    zero = xp.zeros_like(yaw)
    return xp.stack([xp.cos(yaw / 2), zero, zero, xp.sin(yaw / 2)], axis=-1)


def yaw_from_quat(quat: Quats) -> Angles:
    """Give the yaw `[...]` in radians of a quaternion: the heading of its x axis, exact for a turn about z only."""
    xp, quat = to_arrays(quat)
    w, x, y, z = (quat[..., i] for i in range(4))
    return xp.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def matrix_from_quat(quat: Quats) -> Rotations:
    """Give the rotation `[..., 3, 3]` of a quaternion `[..., 4]`, which need not be of unit length."""
    xp, quat = to_arrays(quat)
    w, x, y, z = (quat_normalize(quat)[..., i] for i in range(4))
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return xp.stack([xp.stack(row, axis=-1) for row in rows], axis=-2)


def quat_from_matrix(matrix: Rotations) -> Quats:
    """Give the unit quaternion `[..., 4]` with w >= 0 of a rotation `[..., 3, 3]` (Shepperd's method: the largest of four pivots)."""
    xp, m = to_arrays(matrix)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = (m[..., i, j] for i in range(3) for j in range(3))
    candidates = xp.stack(
        [
            xp.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], axis=-1),
            xp.stack([m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20], axis=-1),
            xp.stack([m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m21 + m12], axis=-1),
            xp.stack([m10 - m01, m02 + m20, m21 + m12, 1 - m00 - m11 + m22], axis=-1),
        ],
        axis=-2,
    )
    pivots = xp.stack([candidates[..., i, i] for i in range(4)], axis=-1)
    best = xp.argmax(pivots, axis=-1)[..., None, None]
    quat = quat_normalize(xp.take_along_axis(candidates, best, axis=-2)[..., 0, :])
    return xp.where(quat[..., :1] < 0, -quat, quat)


def rotate(quat: Quats, vectors: Vectors) -> Vectors:
    """Turn vectors `[..., 3]` by unit quaternions `[..., 4]`."""
    xp, quat, vectors = to_arrays(quat, vectors)
    quat, vectors = same_batch(xp, quat, vectors)
    w, axis = quat[..., :1], quat[..., 1:]
    cross = 2 * xp.cross(axis, vectors)
    return vectors + w * cross + xp.cross(axis, cross)


def pose_from(position: Vectors, quat: Quats) -> Poses:
    """Join a position `[..., 3]` and a quaternion `[..., 4]` into a pose `[..., 7]`."""
    xp, position, quat = to_arrays(position, quat)
    return xp.concatenate(same_batch(xp, position, quat), axis=-1)


def pose_from_yaw(position: Vectors, yaw: Angles) -> Poses:
    """Give the upright pose `[..., 7]` at a position `[..., 3]` with a yaw `[...]` in radians."""
    return pose_from(position, quat_from_yaw(yaw))


def pose_multiply(a_from_b: Poses, b_from_c: Poses) -> Poses:
    """Compose poses `[..., 7]` into `a_from_c`."""
    _, a, b = to_arrays(a_from_b, b_from_c)
    return pose_from(apply_pose(a, b[..., :3]), quat_multiply(a[..., 3:], b[..., 3:]))


def pose_inverse(a_from_b: Poses) -> Poses:
    """Invert a pose `[..., 7]` with a unit quaternion."""
    _, pose = to_arrays(a_from_b)
    inverse = quat_inverse(pose[..., 3:])
    return pose_from(-rotate(inverse, pose[..., :3]), inverse)


def apply_pose(a_from_b: Poses, points: Vectors) -> Vectors:
    """Take points `[..., 3]` in b to points in a; batch dimensions of pose and points broadcast (`pose[..., None, :]` for a cloud)."""
    xp, pose, points = to_arrays(a_from_b, points)
    turned = rotate(pose[..., 3:], points)
    return turned + xp.broadcast_to(pose[..., :3], turned.shape)


def matrix_from_pose(a_from_b: Poses) -> Matrices:
    """Give the homogeneous matrix `[..., 4, 4]` of a pose `[..., 7]`."""
    xp, pose = to_arrays(a_from_b)
    upper = xp.concatenate([matrix_from_quat(pose[..., 3:]), pose[..., :3, None]], axis=-1)
    last = xp.broadcast_to(xp.asarray([0.0, 0.0, 0.0, 1.0], pose.dtype), pose.shape[:-1] + (1, 4))
    return xp.concatenate([upper, last], axis=-2)


def pose_from_matrix(a_from_b: Matrices) -> Poses:
    """Give the pose `[..., 7]` of a rigid homogeneous matrix `[..., 4, 4]`."""
    _, matrix = to_arrays(a_from_b)
    return pose_from(matrix[..., :3, 3], quat_from_matrix(matrix[..., :3, :3]))


def matrix_inverse(a_from_b: Matrices) -> Matrices:
    """Invert a rigid homogeneous matrix `[..., 4, 4]` without a solve."""
    xp, matrix = to_arrays(a_from_b)
    turned = xp.swapaxes(matrix[..., :3, :3], -1, -2)
    position = -(turned * xp.expand_dims(matrix[..., :3, 3], -2)).sum(-1)
    return xp.concatenate([xp.concatenate([turned, position[..., None]], axis=-1), matrix[..., 3:, :]], axis=-2)


def apply_matrix(a_from_b: Matrices, points: Vectors) -> Vectors:
    """Take points `[..., 3]` in b to points in a by one rigid matrix `[4, 4]`, in full float32 on every device."""
    xp, matrix, points = to_arrays(a_from_b, points)
    x, y, z = (points[..., i] for i in range(3))
    rows = [matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z + matrix[i, 3] for i in range(3)]
    return xp.stack(rows, axis=-1)


def se2_multiply(a_from_b: Motions, b_from_c: Motions) -> Motions:
    """Compose planar motions `[..., 3]` of `(x, y, yaw)` into `a_from_c`."""
    xp, a, b = to_arrays(a_from_b, b_from_c)
    a, b = same_batch(xp, a, b)
    return xp.concatenate([apply_se2(a, b[..., :2]), a[..., 2:] + b[..., 2:]], axis=-1)


def se2_inverse(a_from_b: Motions) -> Motions:
    """Invert a planar motion `[..., 3]` of `(x, y, yaw)`."""
    xp, motion = to_arrays(a_from_b)
    back = xp.concatenate([xp.zeros_like(motion[..., :2]), -motion[..., 2:]], axis=-1)
    return xp.concatenate([-apply_se2(back, motion[..., :2]), -motion[..., 2:]], axis=-1)


def apply_se2(a_from_b: Motions, points: Points2) -> Points2:
    """Take points of the plane `[..., 2]` in b to points in a by `(x, y, yaw)` `[..., 3]`."""
    xp, motion, points = to_arrays(a_from_b, points)
    motion, points = same_batch(xp, motion, points)
    cos, sin = xp.cos(motion[..., 2]), xp.sin(motion[..., 2])
    x, y = points[..., 0], points[..., 1]
    return xp.stack([cos * x - sin * y + motion[..., 0], sin * x + cos * y + motion[..., 1]], axis=-1)


def pose_from_se2(a_from_b: Motions) -> Poses:
    """Give the pose `[..., 7]` of a planar motion `(x, y, yaw)` `[..., 3]`: it moves things on the table and leaves heights alone."""
    xp, motion = to_arrays(a_from_b)
    position = xp.concatenate([motion[..., :2], xp.zeros_like(motion[..., :1])], axis=-1)
    return pose_from_yaw(position, motion[..., 2])


def se2_about(center: Points2, yaw: Angles, shift: Points2 = (0.0, 0.0)) -> Motions:
    """Give the planar motion `[..., 3]` that turns by `yaw` about `center` `[..., 2]` and then moves by `shift` metres."""
    xp, center, yaw, shift = to_arrays(center, yaw, shift)
    turn = xp.concatenate([xp.zeros(yaw.shape + (2,), yaw.dtype), yaw[..., None]], axis=-1)
    turned = apply_se2(turn, center)
    center, shift = xp.broadcast_to(center, turned.shape), xp.broadcast_to(shift, turned.shape)
    return xp.concatenate([center + shift - turned, xp.broadcast_to(yaw[..., None], turned.shape[:-1] + (1,))], axis=-1)
