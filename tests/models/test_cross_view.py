"""Cross-view completion: what is covered stays unseen, the other views are used where they belong, and all of the encoder learns."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax import checkpoint, types
from lala_jax.models import cross_view, resnet
from lala_jax.perception import camera as cameras

SIDE, PATCH, WHICH = 32, 8, 1
HIDDEN = np.array([[1, 0, 1, 1], [1, 1, 1, 0], [0, 1, 1, 1], [1, 1, 0, 1]], bool)
COVERED = np.kron(HIDDEN, np.ones((PATCH, PATCH), bool))
EYES = np.array([[0.6, 0.1, 0.7], [-0.5, 0.4, 0.8], [0.1, -0.7, 0.6]])


def scene(height=SIDE, width=SIDE):
    """Three views of a table with squares of 7 cm in random colours; depth and colour from NumPy's own rays."""
    camera = cameras.pinhole(cameras.look_at(EYES.astype(np.float32), np.zeros((3, 3), np.float32)), height=height, width=width, focal=60.0)
    colors = np.random.default_rng(0).uniform(size=(40, 40, 3))
    rgb, depth = np.zeros((3, height, width, 3)), np.zeros((3, height, width))
    for view, eye in enumerate(EYES):
        rotation = np.asarray(camera.world_from_cam[view, :3, :3], float)
        for i in range(height):
            for j in range(width):
                ray = rotation @ [(j + 0.5 - width / 2) / 60, (i + 0.5 - height / 2) / 60, 1]
                depth[view, i, j] = -eye[2] / ray[2]
                x, y, _ = eye + depth[view, i, j] * ray
                rgb[view, i, j] = colors[int(x // 0.07) + 20, int(y // 0.07) + 20]
    return types.Views(jnp.asarray(rgb, jnp.float32), jnp.asarray(depth, jnp.float32), camera)


@functools.cache
def built(stage="stem"):
    """A model, its variables and the jitted function of views, covered view and patches."""
    net = cross_view.CrossView(resnet.TORCHVISION, stage, PATCH)
    variables = jax.jit(net.init)(jax.random.key(0, impl="rbg"), scene(), WHICH, HIDDEN)
    return net, variables, jax.jit(net.apply)


def predict(views, which=WHICH):
    _, variables, apply = built()
    return np.asarray(apply(variables, views, which, HIDDEN))


def test_targets_are_patches_normalised():
    rgb = np.array(scene().rgb[0])
    rgb[:8, :8], rgb[:8, 8:16] = 0.3, [0.5, 0.2, 0.2]
    found = np.asarray(cross_view.targets(jnp.asarray(rgb), PATCH))
    assert found.shape == (4, 4, 192)
    for row in range(4):
        for col in range(4):
            pixels = rgb[8 * row : 8 * row + 8, 8 * col : 8 * col + 8].astype(float).ravel()
            expected = (pixels - pixels.mean()) / np.hypot(pixels.std(), cross_view.FLOOR)
            np.testing.assert_allclose(found[row, col], expected, atol=1e-5)
    assert np.abs(found[0, 0]).max() < 1e-5, "a grey patch is nothing"
    assert (found[0, 1].reshape(8, 8, 3) == found[0, 1, :3]).all() and found[0, 1, 0] > 1 > found[0, 1, 1], "a plain one is its hue"


def test_errors_count_what_was_covered_alone():
    rng = np.random.default_rng(1)
    predicted, target = rng.normal(size=(2, 4, 4, 192)).astype(np.float32)
    one, other = cross_view.errors(jnp.asarray(predicted), jnp.asarray(target), jnp.asarray(HIDDEN))
    np.testing.assert_allclose(one, ((predicted - target) ** 2)[HIDDEN].mean(), rtol=1e-5)
    np.testing.assert_allclose(other, (target**2)[HIDDEN].mean(), rtol=1e-5)


@pytest.mark.parametrize("share, count", [(0.9, 14), (0.5, 8), (1.0, 16)])
def test_covers_a_share(share, count):
    drawn = jax.vmap(lambda key: cross_view.cover(key, 4, share))(jax.random.split(jax.random.key(0), 50))
    assert (drawn.sum((1, 2)) == count).all()
    assert (np.asarray(drawn).mean(0) > share - 0.25).all() and (share == 1 or len(np.unique(np.asarray(drawn), axis=0)) > 25)


def test_windows_are_parts_of_the_views():
    """Each shows the same pixels of the same world points as the whole view does, about the point or as near to it as the picture goes."""
    views = scene(48, 40)
    whole = np.asarray(jax.vmap(cameras.unproject)(views.depth, views.camera))
    for point in ([0.05, -0.05, 0.0], [0.4, 0.0, 0.0]):
        found = cross_view.windows(views, jnp.array(point), 16)
        world = np.asarray(jax.vmap(cameras.unproject)(found.depth, found.camera))
        for view, (eye, pose) in enumerate(zip(EYES, np.asarray(views.camera.world_from_cam, float), strict=True)):
            x, y, z = (np.array(point) - eye) @ pose[:3, :3]
            middle = np.array([60 * y / z + 24, 60 * x / z + 20])
            i, j = np.clip(np.round(middle - 8).astype(int), 0, [32, 24])
            np.testing.assert_array_equal(found.rgb[view], views.rgb[view, i : i + 16, j : j + 16])
            np.testing.assert_allclose(world[view], whole[view, i : i + 16, j : j + 16], atol=1e-5)


def test_features_lie_where_the_covered_view_sees_their_points():
    """Against NumPy: the pixel of every fourth pixel's point in the covered view, its depth there, and what may be read."""
    views = scene()
    views = views.replace(depth=views.depth.at[0, 4, 8].set(0.0))
    places, near, own, seen = (np.asarray(x) for x in cross_view.locate(views, WHICH, jnp.asarray(COVERED), 4))
    points = np.asarray(jax.vmap(cameras.unproject)(scene().depth, views.camera), float)[:, ::4, ::4].reshape(-1, 3)
    target = np.asarray(views.camera.world_from_cam[WHICH], float)
    local = (points - target[:3, 3]) @ target[:3, :3]
    blind = np.zeros((3, 8, 8), bool)
    blind[0, 1, 2] = True
    covered = np.zeros((3, 8, 8), bool)
    covered[WHICH] = COVERED[::4, ::4]
    np.testing.assert_array_equal(own.reshape(3, 64), np.arange(3)[:, None] == np.full(64, WHICH))
    np.testing.assert_array_equal(seen, ~(blind | covered).ravel())
    np.testing.assert_allclose(places[seen], 60 * (local[:, :2] / local[:, 2:])[seen] + SIDE / 2, atol=1e-3)
    others = seen & ~own
    np.testing.assert_allclose(near[others], (local[others, 2].mean() - local[others, 2]) / cross_view.DEPTH, atol=1e-4)
    assert not near[own].any() and not near[blind.ravel()].any()


def test_what_is_covered_is_not_seen():
    """Neither the colours under the cover nor any depth of the covered view change a bit; what is left uncovered does."""
    views, other = scene(), scene().rgb[WHICH, ::-1, ::-1]
    expected = predict(views)
    covered = views.rgb.at[WHICH].set(jnp.where(COVERED[..., None], other, views.rgb[WHICH]))
    changed = views.replace(rgb=covered, depth=views.depth.at[WHICH].set(views.depth[WHICH] * 1.3))
    assert (changed.rgb != views.rgb).sum() > 1000
    np.testing.assert_array_equal(predict(changed), expected)
    left = views.rgb.at[WHICH].set(jnp.where(COVERED[..., None], views.rgb[WHICH], other))
    assert np.abs(predict(views.replace(rgb=left)) - expected).max() > 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("row, col", [(1, 1), (2, 2), (2, 1)])
def test_the_other_views_are_used_where_they_show_the_patch(row, col):
    """A square of the table repainted in one other view changes the patch that it lies in, and what is far from there much less."""
    views = scene()
    expected = predict(views)
    points = jax.vmap(cameras.unproject)(views.depth, views.camera)[0]
    uv, _ = cameras.project(points, jax.tree.map(lambda leaf: leaf[WHICH], views.camera))
    inside = (np.asarray(uv) // PATCH == [col, row]).all(-1)
    assert inside.sum() > 20
    rgb = views.rgb.at[0].set(jnp.where(inside[..., None], 1 - views.rgb[0], views.rgb[0]))
    change = np.abs(predict(views.replace(rgb=rgb)) - expected).max(-1)
    far = np.abs(np.indices((4, 4)) - np.array([row, col])[:, None, None]).max(0) > 1
    assert change[row, col] > 0.01 * np.abs(expected).max() and change[far].max() < change[row, col] / 4


def test_views_have_no_order():
    views, order = scene(), np.array([1, 2, 0])
    turned = jax.tree.map(lambda leaf: leaf[order], views)
    np.testing.assert_allclose(predict(turned, int(np.argmax(order == WHICH))), predict(views), atol=1e-5)


def test_vmap_is_a_loop():
    _, variables, apply = built()
    views, other = scene(), scene().replace(rgb=scene().rgb[:, ::-1])
    twice = jax.tree.map(lambda *leaves: jnp.stack(leaves), views, other)
    both = jax.vmap(functools.partial(apply, variables))(twice, jnp.array([WHICH, 0]), jnp.stack([HIDDEN, HIDDEN.T]))
    np.testing.assert_allclose(both[0], predict(views), atol=1e-5)
    np.testing.assert_allclose(both[1], apply(variables, other, 0, HIDDEN.T), atol=1e-5)


def test_every_layer_of_the_encoder_learns():
    net, variables, _ = built("conv2")
    views = scene()
    target = cross_view.targets(views.rgb[WHICH], PATCH)

    def loss(params):
        return cross_view.errors(net.apply({**variables, "params": params}, views, WHICH, HIDDEN), target, HIDDEN)[0]

    grads = checkpoint.named(jax.jit(jax.grad(loss))(variables["params"]))
    assert {name.split("/")[0] for name in grads} >= {"encoder", "read0", "read1", "pixels", "patch_token"}
    trunk = {name: float(jnp.abs(grad).max()) for name, grad in grads.items() if name.startswith("encoder/")}
    assert len(trunk) == 3 * len(resnet.layers("conv2")) and min(trunk.values()) > 0
    assert all(np.isfinite(list(trunk.values())))


def test_refuses_what_does_not_fit():
    net = cross_view.CrossView(resnet.TORCHVISION, "stem", 4)
    with pytest.raises(ValueError, match=r"4 x 4 patches of 4 pixels do not make views of \[32, 32\]"):
        jax.eval_shape(net.init, jax.random.key(0), scene(), WHICH, HIDDEN)
    with pytest.raises(ValueError, match="stage must be one of stem, conv2, .*got 'conv9'"):
        jax.eval_shape(net.clone(stage="conv9", patch=8).init, jax.random.key(0), scene(), WHICH, HIDDEN)
