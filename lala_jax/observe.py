"""From a scene's state to its top-down maps: render, unproject, fuse. One jitted program for a batch of scenes."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from lala_jax import backbone, compiling, types
from lala_jax.perception import batches, calibration, noise, topdown
from lala_jax.perception import camera as cameras
from lala_jax.sim import distance, render, scene
from lala_jax.sim.tasks import base

BASELINE = 0.055  # metres between the two imagers of a RealSense D415
SEEN = 0.01  # share of a camera's pixels that must show the map's area
SCENES = 16  # whose features are computed at once, where they are: 300 MB each at 640 x 480

Whole = Callable[[Callable[[jax.Array], jax.Array], jax.Array], jax.Array]


@struct.dataclass
class Rig:
    """The cameras of E episodes where they are not the preset's, leaves `[E, V, ...]`."""

    believed: types.Camera  # where they are thought to be
    background: types.Views | None  # what they see of what never moves, from where they are; None where they have not moved


@dataclasses.dataclass(frozen=True)
class Observer:
    """How a task's scenes are looked at; hashable, so that it may be a static argument."""

    task: base.Task
    spec: types.MapSpec
    preset: str = "ring"
    height: int = 480  # pixels
    width: int = 640
    depth_noise: bool = False
    shift: float = 0.0  # metres, at most, that each episode's cameras are away from where they are thought to be
    turn: float = 0.0  # degrees, at most, that they are turned
    calibrate: bool = False  # find out where they are from the first pictures of an episode
    missing: int = -1  # the camera that sees nothing, -1 for none
    backbone: str = ""  # pretrained features of the views to fuse over the surface: a name or a file for `backbone.load`; "" for none
    stage: str = "conv2"  # of the backbone
    dtype: str = "float32"  # what the backbone computes in, and its features are kept in

    @property
    def camera(self) -> types.Camera:
        """Give the preset's cameras, leaves `[V, ...]`."""
        return scene.cameras(self.preset, height=self.height, width=self.width)

    @property
    def disparity(self) -> float:
        """Give the disparity, in pixels, of a point one metre away."""
        with jax.ensure_compile_time_eval():
            return BASELINE * float(self.camera.intrinsics[0, 0, 0])

    @property
    def moves(self) -> bool:
        """Say whether the cameras may be elsewhere than the preset says, so that `maps` needs a rig."""
        return bool(self.shift or self.turn or self.calibrate)

    def background(self) -> render.Layer:
        """Give the preset's views of what never moves, the table and the parked arm; computed once."""
        return _background(self)

    def views(self, size: jax.Array, color: jax.Array, base: jax.Array, poses: jax.Array, layer: render.Layer | None = None) -> types.Views:
        """Render the cameras' views of one scene: objects `[N, 3]`, `[N, 3]`, base `[7]`, poses `[N, 7]`. Unbatched.

        `layer` is the background of other cameras than the preset's.
        """
        layer = self.background() if layer is None else layer
        model, data = scene.geom_template(self.task)
        moving = (scene.base_geom(model), *scene.object_geoms(model))
        model, data = scene.place(model, data, size=size, color=color, poses=poses, base=base)
        return render.render_over(layer, model, data, layer.camera, geoms=moving)

    def look(
        self, size, color, base, poses, *, key: jax.Array | None = None, layer: render.Layer | None = None, whole: Whole | None = None
    ) -> types.Views:
        """Render B scenes (leaves `[B, ...]`) as the cameras report them; `key` draws the depth noise where there is any.

        `layer` (leaves `[B, V, ...]`) is the background of other cameras than the preset's. `whole(function, depth)` draws it where
        the scenes are a share of those that `key` is for.
        """
        views = jax.vmap(self.views)(size, color, base, poses, layer)
        if self.depth_noise:
            if key is None:
                raise ValueError("Observer(depth_noise=True) needs a key to draw the noise")
            draw = functools.partial(noise.depth_noise, key, disparity=self.disparity)
            views = views.replace(depth=draw(views.depth) if whole is None else whole(draw, views.depth))
        if self.missing >= 0:
            views = views.replace(depth=views.depth.at[:, self.missing].set(0.0))
        return views

    def maps(
        self, size: jax.Array, color: jax.Array, base: jax.Array, poses: jax.Array, *, key: jax.Array | None = None, rig: Rig | None = None
    ) -> types.TopDownMap:
        """Look at B scenes (leaves `[B, ...]`) and fuse the views; cameras that may move need the `rig` of `mount`."""
        if self.moves and rig is None:
            raise ValueError("an Observer whose cameras move or are calibrated needs the rig of Observer.mount")
        views = self.look(size, color, base, poses, key=key, layer=None if rig is None else rig.background)
        if rig is not None:
            views = views.replace(camera=rig.believed)
        return self.fuse(views)

    def fuse(self, views: types.Views) -> types.TopDownMap:
        """Fuse the views of B scenes (leaves `[B, V, ...]`), with their pretrained features where the observer has a backbone.

        The features of each pixel are scaled to a root mean square of one before they are fused.
        """
        maps = topdown.from_views_batch(views, spec=self.spec)
        if not self.backbone:
            return maps

        module, variables = _load(self.backbone, self.stage, self.dtype)

        def one(views):
            features = jnp.asarray(module.apply(variables, views.rgb))
            features *= jax.lax.rsqrt(jnp.square(features).mean(-1, keepdims=True) + 1e-6)
            return topdown.surface_features(views, features.astype(self.dtype), spec=self.spec)

        return maps.replace(surface=batches.each(one, views, at_once=SCENES))

    def mount(self, key: jax.Array, size: jax.Array, color: jax.Array, base: jax.Array, poses: jax.Array) -> Rig:
        """Put up the cameras of E episodes: move them, and calibrate them on the pictures of the first `poses` `[E, N, 7]`."""
        key_move, key_noise = jax.random.split(key)
        count, nominal = size.shape[0], self.camera
        model, data = scene.geom_template(self.task)
        static = scene.static_geoms(model)
        layer = None
        if self.shift or self.turn:
            keys = jax.random.split(key_move, count)
            camera = jax.vmap(lambda k: noise.move_cameras(k, nominal, shift=self.shift, turn=math.radians(self.turn)))(keys)
            layer = jax.lax.map(lambda one: render.background(model, data, one, geoms=static, segmentation=False), camera)
        believed = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), nominal)
        if self.calibrate:
            views = self.look(size, color, base, poses, key=key_noise, layer=layer)

            def measure(points):
                return distance.distance(model, data, points, geoms=static)

            believed = jax.lax.map(lambda one: calibration.calibrate(one[0], one[1], measure), (views.depth, believed))
        return Rig(believed, layer)

    def check(self) -> None:
        """Raise ValueError naming the first camera of the preset that sees nothing, or nothing of the map's area."""
        layer = self.background()
        render.check_views(layer)
        for number, share in enumerate(np.asarray(_share_of_map(layer.depth, self.camera, self.spec))):
            if share < SEEN:
                seen = f"the map's area, x {self.spec.x} and y {self.spec.y}, in {share:.2%} of its pixels, not {SEEN:.0%}"
                raise ValueError(f"camera {number} sees {seen}: where does it look?")


@functools.partial(jax.jit, static_argnums=2)
def _share_of_map(depth: jax.Array, camera: types.Camera, spec: types.MapSpec) -> jax.Array:
    """Give the share `[V]` of the pixels of `depth` `[V, H, W]` that show something over or under the map's cells."""
    points = jax.vmap(cameras.unproject)(depth, camera)
    return ((depth > 0) & types.in_map(spec, types.index_from_world(spec, points[..., :2]))).mean((1, 2))


_load = functools.lru_cache(maxsize=2)(lambda name, stage, dtype: backbone.load(name, stage=stage, dtype=jnp.dtype(dtype)))


@functools.cache
@compiling.uncollected()
def _background(observer: Observer) -> render.Layer:
    model, data = scene.geom_template(observer.task)
    with jax.ensure_compile_time_eval():
        draw = functools.partial(render.background, geoms=scene.static_geoms(model), segmentation=False)
        return jax.jit(draw)(model, data, observer.camera)
