"""Pinhole cameras: pixels to rays to world points and back. Unbatched: vmap over views.

Pixel coordinates are continuous `(u, v)`, the centre of pixel `[i, j]` at `(j + 0.5, i + 0.5)`; camera axes are OpenCV's
(x right, y down, z forward); depth is the camera's z in metres, 0 where nothing was hit.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lala_jax import types
from lala_jax.perception import transforms


def check_floating(name: str, pixels: jax.Array, unit: str) -> None:
    """Raise ValueError where pixels are whole numbers, of 0..255 or millimetres."""
    if not jnp.issubdtype(pixels.dtype, jnp.floating):
        raise ValueError(f"{name} must be floating point, {unit}, got {pixels.dtype}")


def intrinsics(height: int, width: int, *, focal: float) -> Float[Array, "3 3"]:
    """Give the matrix of a camera with square pixels and the principal point at the image's centre; `focal` in pixels."""
    return jnp.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], jnp.float32)


def moved(camera: types.Camera, shift: jax.Array, quat: jax.Array) -> types.Camera:
    """Shift cameras (leaves `[...]`) by `shift` `[..., 3]` metres and turn them about themselves by `quat` `[..., 4]`, in world axes."""
    pose = camera.world_from_cam
    rotation = jnp.matmul(transforms.matrix_from_quat(quat), pose[..., :3, :3], precision=jax.lax.Precision.HIGHEST)
    return camera.replace(world_from_cam=pose.at[..., :3, :3].set(rotation).at[..., :3, 3].add(shift))


def look_at(eye: transforms.Vectors, target: transforms.Vectors, up: transforms.Vectors = (0.0, 0.0, 1.0)) -> transforms.Matrices:
    """Give `world_from_cam` `[..., 4, 4]` of a camera at `eye` that looks at `target` with `up` upwards in the image.

    Looking along `up` leaves the roll open; world +y then points up in the image (+x if `up` is along y).
    Numpy in gives numpy out (float64 stays float64), jax in gives jax out.
    """
    xp, eye, target, up = transforms.to_arrays(eye, target, up)
    eye, target, up = transforms.same_batch(xp, eye, target, up)
    forward = _unit(xp, target - eye)
    along_y = abs(up[..., 1:2]) > abs(up[..., :1]) + abs(up[..., 2:])
    spare = xp.where(along_y, _axis_like(xp, up, 0), _axis_like(xp, up, 1))
    right = xp.cross(forward, up)
    parallel = (right * right).sum(-1, keepdims=True) < 1e-12 * (up * up).sum(-1, keepdims=True)
    right = _unit(xp, xp.where(parallel, xp.cross(forward, spare), right))
    columns = xp.stack([right, xp.cross(forward, right), forward, eye], axis=-1)
    last = xp.broadcast_to(xp.asarray([0.0, 0.0, 0.0, 1.0], eye.dtype), eye.shape[:-1] + (1, 4))
    return xp.concatenate([columns, last], axis=-2)


def _unit(xp, vector):
    return vector / xp.sqrt((vector * vector).sum(-1, keepdims=True))


def _axis_like(xp, vector, axis: int):
    return xp.broadcast_to(xp.asarray(np.eye(3)[axis], vector.dtype), vector.shape)


def pinhole(world_from_cam: transforms.Matrices, *, height: int = 480, width: int = 640, focal: float = 450.0) -> types.Camera:
    """Make a camera, or a batch of them, of one size; `focal` in pixels, the default is the RealSense D415 model of the benchmark."""
    world_from_cam = jnp.asarray(world_from_cam, jnp.float32)
    matrix = jnp.broadcast_to(intrinsics(height, width, focal=focal), world_from_cam.shape[:-2] + (3, 3))
    return types.Camera(intrinsics=matrix, world_from_cam=world_from_cam, height=height, width=width)


def scale(camera: types.Camera, height: int, width: int) -> types.Camera:
    """Resize a camera, or a batch of them, to another image size; the field of view stays, and so do pixel areas' borders."""
    factor = np.array([width / camera.width, height / camera.height, 1.0], np.float32)[:, None]
    factor = np.broadcast_to(factor, camera.intrinsics.shape)
    return camera.replace(intrinsics=camera.intrinsics * factor, height=height, width=width)


def pixel_centers(height: int, width: int) -> Float[Array, "height width 2"]:
    """Give the continuous `(u, v)` of every pixel's centre."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return jnp.asarray(np.stack([u, v], axis=-1), jnp.float32)


def directions(camera: types.Camera) -> Float[Array, "height width 3"]:
    """Give every pixel's ray in world axes, one metre long along the camera's z: `eye + depth * direction` is the point seen."""
    k, m = camera.intrinsics, camera.world_from_cam
    y = (jnp.arange(camera.height, dtype=jnp.float32)[:, None] + 0.5 - k[1, 2]) / k[1, 1]
    x = (jnp.arange(camera.width, dtype=jnp.float32)[None, :] + 0.5 - k[0, 2] - k[0, 1] * y) / k[0, 0]
    x, y = jnp.broadcast_arrays(x, y)
    return jnp.stack([m[i, 0] * x + m[i, 1] * y + m[i, 2] for i in range(3)], axis=-1)


def unproject(depth: Float[Array | np.ndarray, " ..."], camera: types.Camera) -> Float[Array, "height width 3"]:
    """Give the world point in metres that each pixel of `depth` `[H, W]` sees; depth 0 gives the eye, so mask by `depth > 0`."""
    if depth.shape != (camera.height, camera.width):
        size = (camera.height, camera.width)
        raise ValueError(f"unproject is unbatched: depth must have its camera's shape {size}, got {depth.shape}; vmap over views")
    rays = directions(camera)
    eye = camera.world_from_cam[:3, 3]
    return jnp.stack([eye[i] + depth * rays[..., i] for i in range(3)], axis=-1)


def project(points: transforms.Vectors, camera: types.Camera) -> tuple[Float[Array, "... 2"], Float[Array, " ..."]]:
    """Give the continuous `(u, v)` `[..., 2]` and the depth `[...]` in metres of world points `[..., 3]`.

    A point with depth <= 0 is behind the camera: its `(u, v)` is finite but means nothing.
    """
    local = transforms.apply_matrix(transforms.matrix_inverse(camera.world_from_cam), points)
    x, y, depth = local[..., 0], local[..., 1], local[..., 2]
    safe = jnp.where(abs(depth) < 1e-6, 1e-6, depth)
    k = camera.intrinsics
    u = (k[0, 0] * x + k[0, 1] * y) / safe + k[0, 2]
    v = k[1, 1] * y / safe + k[1, 2]
    return jnp.stack([u, v], axis=-1), depth


def in_image(uv: Float[Array, "... 2"], depth: Float[Array, " ..."], camera: types.Camera) -> jax.Array:
    """Say for projected points `[..., 2]` with depth `[...]` whether they are in front of the camera and inside its image."""
    u, v = uv[..., 0], uv[..., 1]
    return (depth > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
