"""From a scene's state to its top-down maps: render, unproject, fuse. One jitted program for a batch of scenes."""

from __future__ import annotations

import dataclasses
import functools

import jax

from lala_jax import types
from lala_jax.perception import noise, topdown
from lala_jax.sim import render, scene
from lala_jax.sim.tasks import base

BASELINE = 0.055  # metres between the two imagers of a RealSense D415


@dataclasses.dataclass(frozen=True)
class Observer:
    """How a task's scenes are looked at; hashable, so that it may be a static argument."""

    task: base.Task
    spec: types.MapSpec
    preset: str = "ring"
    height: int = 480  # pixels
    width: int = 640
    depth_noise: bool = False

    def views(self, size: jax.Array, color: jax.Array, base: jax.Array, poses: jax.Array) -> types.Views:
        """Render the cameras' views of one scene: objects `[N, 3]`, `[N, 3]`, base `[7]`, poses `[N, 7]`. Unbatched."""
        model, data = scene.geom_template(self.task)
        moving = (scene.base_geom(model), *scene.object_geoms(model))
        model, data = scene.place(model, data, size=size, color=color, poses=poses, base=base)
        return render.render_over(self.background(), model, data, self.camera, geoms=moving)

    @property
    def camera(self) -> types.Camera:
        """Give the cameras, leaves `[V, ...]`."""
        return scene.cameras(self.preset, height=self.height, width=self.width)

    def background(self) -> render.Layer:
        """Give the views of what never moves, the table and the parked arm; computed once."""
        return _background(self)

    def maps(
        self, size: jax.Array, color: jax.Array, base: jax.Array, poses: jax.Array, *, key: jax.Array | None = None
    ) -> types.TopDownMap:
        """Render and fuse B scenes (leaves `[B, ...]`); `key` draws the depth noise where there is any."""
        views = jax.vmap(self.views)(size, color, base, poses)
        if self.depth_noise:
            if key is None:
                raise ValueError("Observer(depth_noise=True).maps needs a key to draw the noise")
            with jax.ensure_compile_time_eval():
                disparity = BASELINE * float(self.camera.intrinsics[0, 0, 0])
            views = views.replace(depth=noise.depth_noise(key, views.depth, disparity=disparity))
        return topdown.from_views_batch(views, spec=self.spec)

    def check(self) -> None:
        """Raise ValueError naming the first camera of the preset that sees nothing of the table or the arm."""
        render.check_views(self.background())


@functools.cache
def _background(observer: Observer) -> render.Layer:
    model, data = scene.geom_template(observer.task)
    with jax.ensure_compile_time_eval():
        draw = functools.partial(render.background, geoms=scene.static_geoms(model), segmentation=False)
        return jax.jit(draw)(model, data, observer.camera)
