"""Footprints of boxes in numpy: what sampling and the oracle share."""

from __future__ import annotations

import numpy as np

from lala_jax.perception import transforms

_CROSS = np.array([[[0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0, -1, 0], [1, 0, 0], [0, 0, 0]]], float)


def matrix(poses: np.ndarray) -> np.ndarray:
    """Give the rotation matrices `[..., 3, 3]` (world_from_body) of `poses` `[..., 7]`, in float64.

    Euler-Rodrigues in a handful of array operations: sampling and the oracle ask for thousands of small batches.
    """
    quat = np.asarray(poses, float)[..., 3:]
    quat = quat / np.sqrt((quat * quat).sum(-1, keepdims=True))
    cross = np.tensordot(quat[..., 1:], _CROSS, 1)
    return np.eye(3) + 2 * (quat[..., :1, None] * cross + cross @ cross)


def yaw(poses: np.ndarray) -> np.ndarray:
    """Give the heading `[...]` in radians of the body x axis of `poses` `[..., 7]`, as seen from above."""
    return transforms.yaw_from_quat(np.asarray(poses, float)[..., 3:])


def footprint(poses: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Give the half edges `[..., 2, 3]` of boxes seen from above: column k is half the edge along body axis k, in metres.

    The footprint is the set of all sums of these columns times factors in -1..1, for any orientation.
    """
    return matrix(poses)[..., :2, :] * np.asarray(size, float)[..., None, :] / 2


def extent(poses: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Give half the axis-aligned bounding box `[..., 3]` of boxes with `poses` `[..., 7]` and full `size` `[..., 3]`, in metres."""
    return (np.abs(matrix(poses)) * np.asarray(size, float)[..., None, :] / 2).sum(-1)


def gap(pose_a: np.ndarray, size_a: np.ndarray, pose_b: np.ndarray, size_b: np.ndarray) -> np.ndarray:
    """Give the separation `[...]` in metres of the footprints of two boxes; negative where they overlap.

    Arguments broadcast. Separating axes: the sign is exact, a positive value is at most the true distance.
    """
    edges_a, edges_b = footprint(pose_a, size_a), footprint(pose_b, size_b)
    shape = np.broadcast_shapes(edges_a.shape, edges_b.shape)
    edges = np.concatenate([np.broadcast_to(edges_a, shape), np.broadcast_to(edges_b, shape)], axis=-1)
    normal = np.stack([-edges[..., 1, :], edges[..., 0, :]], axis=-2)
    length = np.linalg.norm(normal, axis=-2, keepdims=True)
    # An upright edge projects to a point: any direction is a valid axis then.
    normal = np.where(length > 1e-9, normal / np.maximum(length, 1e-9), np.array([[1.0], [0.0]]))
    radius = np.abs(np.einsum("...xk,...xn->...kn", edges, normal)).sum(-2)
    offset = np.asarray(pose_a, float)[..., :2] - np.asarray(pose_b, float)[..., :2]
    return (np.abs(np.einsum("...x,...xn->...n", offset, normal)) - radius).max(-1)


def covers(poses: np.ndarray, size: np.ndarray, xy: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Say for points `xy` `[P, 2]` whether the footprint of one upright box, shrunk by `margin` metres, holds them: `[P]`."""
    turn, half = matrix(poses)[:2, :2], np.asarray(size, float)[:2] / 2
    local = (np.asarray(xy, float) - np.asarray(poses, float)[:2]) @ turn
    return (np.abs(local) <= half - margin).all(-1)
