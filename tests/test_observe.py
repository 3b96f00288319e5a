"""From poses to maps: what the fused map shows is what the scene is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax import losses, observe, types
from lala_jax.perception import topdown
from lala_jax.sim import render, scene, tasks

SPEC = types.MapSpec(cell=0.0125)
TASK = tasks.get("pallet")


def observer(**options):
    return observe.Observer(TASK, SPEC, height=120, width=160, **options)


def scenes(seeds):
    drawn = [TASK.sample(seed) for seed in seeds]
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *drawn)


@pytest.fixture(scope="module")
def maps():
    batch = scenes([0, 1])
    return batch, jax.jit(observer().maps)(batch.size, batch.color, batch.base, batch.start)


def test_top_faces_have_their_height_and_colour(maps):
    """Well inside a box's top face, the map's height is the box's and its colour the box's, shaded as a level face is."""
    batch, seen = maps
    shade = scene.AMBIENT + scene.DIFFUSE * scene.LIGHT_DIR[2]
    for index in range(2):
        one = jax.tree.map(lambda leaf: leaf[index], seen)  # noqa: B023
        nothing = jnp.zeros(8, bool)
        state = types.State(
            batch.size[index], batch.color[index], batch.base[index], batch.goal[index], batch.symmetry[index], batch.start[index],
            nothing, ~nothing,
        )  # fmt: skip
        inside = np.asarray(losses.pick_valid(state, spec=SPEC, margin=0.012))
        top = np.asarray(topdown.max_height(one))
        for box in range(8):
            assert inside[box].any()
            np.testing.assert_allclose(top[inside[box], 3], float(batch.start[index, box, 2] + batch.size[index, box, 2] / 2), atol=1e-4)
            np.testing.assert_allclose(top[inside[box], :3], np.tile(batch.color[index, box] * shade, (inside[box].sum(), 1)), atol=2e-3)


def test_a_batch_is_its_scenes(maps):
    batch, seen = maps
    alone = observer().maps(*(leaf[1:] for leaf in (batch.size, batch.color, batch.base, batch.start)))
    np.testing.assert_allclose(seen.height[1], alone.height[0], atol=1e-6)
    np.testing.assert_array_equal(seen.count[1], alone.count[0])


def test_depth_noise_needs_a_key_and_stays_small(maps):
    batch, seen = maps
    noisy = observer(depth_noise=True)
    fields = batch.size[:1], batch.color[:1], batch.base[:1], batch.start[:1]
    with pytest.raises(ValueError, match="needs a key"):
        noisy.maps(*fields)
    heights = np.asarray(jax.jit(noisy.maps)(*fields, key=jax.random.key(0)).height[0])
    off = np.abs(heights - np.asarray(seen.height[0]))
    assert 1e-4 < np.median(off) < 0.02


def test_the_arm_at_home_is_in_the_background():
    """The parked arm is somewhere in the four views and nowhere over the workspace's map."""
    model, data = scene.geom_template(TASK)
    views = render.render(model, data, observer().camera, geoms=scene.static_geoms(model))
    table = min(scene.static_geoms(model))
    assert (np.asarray(views.segmentation) > table).any()
    assert float(topdown.from_views(views.replace(segmentation=None), spec=SPEC).height.max()) < 1e-3


def test_unknown_preset_names_the_choices():
    with pytest.raises(ValueError, match="paper, ring"):
        observer(preset="rnig").check()
