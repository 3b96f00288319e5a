"""Frozen pytrees that every stage shares, and the one pixel, cell and pose convention.

Conventions, told once:

- SI units; world frame z up, robot base at the origin facing +x.
- Images are `[height, width, ...]`; a pixel coordinate is continuous `(u, v)` = (column, row), the centre of
  pixel `[i, j]` is `(u, v) = (j + 0.5, i + 0.5)`. Camera axes are OpenCV's: x right, y down, z forward.
- Maps are `[rows, cols, ...]`: rows run along world +y, cols along world +x. A cell coordinate is continuous
  `(row, col)`, the centre of cell `[i, j]` is `(i + 0.5, j + 0.5)`; `xy` always means metres.
- A transform named `a_from_b` takes coordinates in b to coordinates in a: `a_from_b @ b_from_c`.
- A pose is `(x, y, z, qw, qx, qy, qz)`, MuJoCo's free joint order; a yaw is a right-handed angle about world z.
- Colours are RGB in 0..1. Depth is the z coordinate in the camera frame in metres, 0 where nothing was hit.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


@struct.dataclass
class Camera:
    """A pinhole camera, or a batch of them with leading dimensions on both leaves."""

    intrinsics: jax.Array  # [..., 3, 3] pixels: fx, fy, cx, cy
    world_from_cam: jax.Array  # [..., 4, 4] rigid, metres
    height: int = struct.field(pytree_node=False)  # pixels
    width: int = struct.field(pytree_node=False)  # pixels


@struct.dataclass
class Views:
    """What V cameras saw of one scene at one moment."""

    rgb: jax.Array  # [V, H, W, 3] 0..1
    depth: jax.Array  # [V, H, W] metres along the camera's z, 0 where nothing was hit
    camera: Camera  # leaves [V, ...]
    segmentation: jax.Array | None = None  # [V, H, W] int32 geom id, -1 where nothing was hit


@dataclasses.dataclass(frozen=True)
class MapSpec:
    """The workspace and its cells: static, hashable, the only place that rounds.

    Cell `[i, j]` covers y in `y_min + cell * [i, i + 1)` and x in `x_min + cell * [j, j + 1)`;
    slice `k` covers z in `z_min + slice_height * [k, k + 1)`.
    """

    x: tuple[float, float] = (0.25, 0.75)
    y: tuple[float, float] = (-0.5, 0.5)
    z: tuple[float, float] = (0.0, 0.28)
    cell: float = 0.003125
    slices: int = 14

    def __post_init__(self):
        for name in ("x", "y", "z"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"MapSpec.{name} must be (low, high) with low < high, got {(low, high)}")
        if self.cell <= 0 or self.slices < 1:
            raise ValueError(f"MapSpec needs cell > 0 and slices >= 1, got cell={self.cell}, slices={self.slices}")
        for name in ("x", "y"):
            low, high = getattr(self, name)
            cells = (high - low) / self.cell
            if abs(cells - round(cells)) > 1e-4:
                raise ValueError(f"MapSpec.{name} {(low, high)} is {cells:.4f} cells of {self.cell} m, not a whole number")

    @property
    def rows(self) -> int:
        return round((self.y[1] - self.y[0]) / self.cell)

    @property
    def cols(self) -> int:
        return round((self.x[1] - self.x[0]) / self.cell)

    @property
    def slice_height(self) -> float:
        return (self.z[1] - self.z[0]) / self.slices


def cell_from_world(spec: MapSpec, xy: jax.Array) -> jax.Array:
    """Map `xy` `[..., 2]` (metres) to continuous `(row, col)` `[..., 2]`; outside the map it goes below 0 or past the end."""
    xy = jnp.asarray(xy)
    return jnp.stack([(xy[..., 1] - spec.y[0]) / spec.cell, (xy[..., 0] - spec.x[0]) / spec.cell], axis=-1)


def world_from_cell(spec: MapSpec, cell: jax.Array) -> jax.Array:
    """Map continuous `(row, col)` `[..., 2]` to `xy` `[..., 2]` in metres; the centre of cell `[i, j]` is `(i + 0.5, j + 0.5)`."""
    cell = jnp.asarray(cell)
    return jnp.stack([spec.x[0] + cell[..., 1] * spec.cell, spec.y[0] + cell[..., 0] * spec.cell], axis=-1)


def index_from_world(spec: MapSpec, xy: jax.Array) -> jax.Array:
    """Give the int32 `(row, col)` `[..., 2]` of the cell that holds `xy` `[..., 2]` (metres), unclipped: check `in_map`."""
    return jnp.floor(cell_from_world(spec, xy)).astype(jnp.int32)


def world_from_index(spec: MapSpec, index: jax.Array) -> jax.Array:
    """Give the centre `[..., 2]` in metres of the cell with integer `(row, col)` `[..., 2]`."""
    return world_from_cell(spec, jnp.asarray(index) + 0.5)


def in_map(spec: MapSpec, index: jax.Array) -> jax.Array:
    """Say for integer `(row, col)` `[..., 2]` whether the cell exists."""
    return ((index >= 0) & (index < jnp.array([spec.rows, spec.cols]))).all(-1)


@struct.dataclass
class TopDownMap:
    """The fused views of one scene; its MapSpec travels beside it as a static argument."""

    features: jax.Array  # [rows, cols, slices, C] mean over the points in the voxel, 0 where none fell
    count: jax.Array  # [rows, cols, slices] float32, number of points that fell into the voxel
    offset: jax.Array  # [rows, cols, slices, 2] mean (row, col) of these points less the cell's centre, in cells; 0 where none fell
    height: jax.Array  # [rows, cols] metres above z_min of the highest point seen, 0 where none fell
    skin: jax.Array  # [rows, cols, 2] mean (row, col), likewise, of the points just under the highest: how far the top face fills the cell
    surface: jax.Array | None = None  # [rows, cols, F] pretrained features of what is highest, mean over the views; 0 where none saw it


@struct.dataclass
class PickPlace:
    """An action: pick at a surface point, place what hangs there so that the picked point lands at `place`.

    `yaw` turns the held object about world z, relative to its orientation at the pick.
    """

    pick: jax.Array  # [..., 3] world metres, on the visible surface
    place: jax.Array  # [..., 3] world metres, where the picked point goes; z is a hint (descent is contact sensed)
    yaw: jax.Array  # [...] radians


@struct.dataclass
class Scene:
    """The fixed facts of one episode with N objects, numpy or jax: a pure function of (task, seed)."""

    size: jax.Array  # [N, 3] full extents, metres
    color: jax.Array  # [N, 3] RGB 0..1
    base: jax.Array  # [7] pose of the stand or pallet (centre of its box geom), world
    start: jax.Array  # [N, 7] poses before the first action, world (box centres)
    goal: jax.Array  # [N, 7] poses in the goal picture, world
    symmetry: jax.Array  # [N] radians: turning the object by this about z changes nothing


def out_of_range(scene: Scene) -> str:
    """Say which numbers of a scene (numpy leaves, shapes as above) cannot be what their unit is; "" where all can."""
    color, symmetry = np.asarray(scene.color), np.asarray(scene.symmetry)
    if color.size and not (0.0 <= color.min() and color.max() <= 1.0):
        return f"color must be RGB in 0..1, got {color.min():.4g} to {color.max():.4g}"
    if symmetry.size and not (0.0 < symmetry.min() and symmetry.max() <= 2 * np.pi + 1e-5):
        return f"symmetry must be radians above 0 and at most 2 pi, got {symmetry.min():.4g} to {symmetry.max():.4g}"
    if (np.asarray(scene.size) <= 0.0).any():
        return f"size must be metres above 0, got {np.min(scene.size):.4g}"
    return next((text for name in ("base", "start", "goal") if (text := no_unit_quat(name, getattr(scene, name)))), "")


def no_unit_quat(name: str, poses: np.ndarray) -> str:
    """Say that poses `[..., 7]` hold quaternions that are not of length 1; "" where all are."""
    norms = np.linalg.norm(np.asarray(poses, float)[..., 3:], axis=-1)
    if norms.size and not np.allclose(norms, 1.0, atol=1e-3):
        return (
            f"{name} must hold x, y, z and a unit quaternion (w, x, y, z), got one of length {norms.flat[np.abs(norms - 1).argmax()]:.4g}"
        )
    return ""


@struct.dataclass
class Demo:
    """One recorded episode: T actions, T + 1 settled states."""

    scene: Scene
    poses: jax.Array  # [T + 1, N, 7] settled object poses, world
    action: PickPlace  # leaves [T, ...]
    placed: jax.Array  # [T + 1, N] bool: the object is at its goal pose
    ready: jax.Array  # [T + 1, N] bool: the object may be picked and placed right now
    seed: jax.Array  # [] int64 of the scene
    score: jax.Array  # [] 0..100 at the end


@struct.dataclass
class State:
    """One moment of one demonstration, what a training sample is made from; N objects, leading dimensions allowed on all leaves."""

    size: jax.Array  # [N, 3] full extents, metres
    color: jax.Array  # [N, 3] RGB 0..1
    base: jax.Array  # [7] pose of the stand or pallet, world
    goal: jax.Array  # [N, 7] goal poses, world
    symmetry: jax.Array  # [N] radians, as in Scene
    poses: jax.Array  # [N, 7] poses now, world
    placed: jax.Array  # [N] bool: at its goal pose
    ready: jax.Array  # [N] bool: may be picked and placed now
