"""ResNet-50's trunk: every layer against NumPy in both families' arithmetic, and where its features lie on the image."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import resnet_reference

from lala_jax import backbone, checkpoint
from lala_jax.models import resnet

# Rows of an odd number, 8 * 5 + 1, and columns of an even one, where padding of "SAME" would not be symmetric: to 11 x 14 and 6 x 7.
RGB = np.random.default_rng(0).uniform(size=(41, 54, 3)).astype(np.float32)
FLAVOURS = {"keras": resnet.KERAS, "torchvision": resnet.TORCHVISION}


@functools.cache
def files(flavour):
    """Tensors as a file names them: the packaged weights, or random ones."""
    if flavour == "torchvision":
        return resnet_reference.torchvision_state(np.random.default_rng(1))
    with np.load(backbone.FOLDER / "resnet50_imagenet_v1.npz", allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


@functools.cache
def variables(flavour, folder):
    np.savez(folder / f"{flavour}.npz", **files(flavour))
    module, found = backbone.load(folder / f"{flavour}.npz", stage="conv3")
    assert module == resnet.ResNet50(FLAVOURS[flavour], "conv3")
    return found


@functools.cache
def apply(flavour):
    return jax.jit(functools.partial(resnet.ResNet50(FLAVOURS[flavour], "conv3").apply, capture_intermediates=True))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("weights")


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_every_layer_is_numpys(flavour, folder):
    with jax.default_matmul_precision("highest"):
        features, state = apply(flavour)(variables(flavour, folder), RGB)
    seen = {path.removesuffix("/__call__/0"): x for path, x in checkpoint.named(state["intermediates"]).items()}
    expected = getattr(resnet_reference, flavour)(files(flavour), RGB)
    assert len(expected) == 24 + 7  # layers and blocks
    for path, reference in expected.items():
        assert seen[path].shape == reference.shape and reference.std() > 0.01, path
        np.testing.assert_allclose(seen[path], reference, rtol=0, atol=1e-4 * np.abs(reference).max(), err_msg=path)
    np.testing.assert_array_equal(features, seen["conv3_4"])
    assert features.shape == (6, 7, 512) and features.dtype == jnp.float32 and seen["conv2_3"].shape == (11, 14, 256)


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_features_lie_on_every_eighth_pixel(flavour, folder):
    """With kernels that are even along the rows, mirroring the image about its middle row mirrors the features."""
    even = jax.tree.map(lambda x: (x + x[::-1]) / 2 if x.ndim == 4 else x, variables(flavour, folder))
    plain, mirrored = (apply(flavour)(even, image)[0] for image in (RGB, RGB[::-1]))
    np.testing.assert_allclose(mirrored[::-1], plain, rtol=0, atol=1e-4 * float(jnp.abs(plain).max()))
    assert jnp.abs(mirrored - plain).max() > 0.1 * jnp.abs(plain).max()


def test_sizes_are_the_published_ones():
    """torchvision's 25,557,032 parameters without the head of 2,049,000; Keras' 53,120 that are not trained."""
    module = resnet.ResNet50(resnet.KERAS, "conv5")
    shapes = jax.eval_shape(module.init, jax.random.key(0), jax.ShapeDtypeStruct((33, 33, 3), jnp.float32))
    sizes = {name: sum(leaf.size for leaf in jax.tree.leaves(tree)) for name, tree in shapes.items()}
    assert sizes == {"params": 25_557_032 - 2_049_000, "batch_stats": 53_120}
    kernels = {name: leaf.shape for name, leaf in checkpoint.named(shapes["params"]).items() if name.endswith("kernel")}
    assert kernels == {f"{path}/conv/kernel": shape for path, shape in resnet.layers("conv5").items()}


@pytest.mark.parametrize("stage, layers, parameters", [("stem", 1, 9_536), ("conv2", 11, 225_344), ("conv3", 24, 1_444_928)])
def test_a_shallow_trunk_is_part_of_a_deeper_one(stage, layers, parameters):
    part, whole = resnet.layers(stage), resnet.layers("conv5")
    assert len(part) == layers and part.items() <= whole.items()
    assert sum(np.prod(shape) + 2 * shape[3] for shape in part.values()) == parameters


def test_jit_is_eager_vmap_is_a_loop_and_deeper_variables_are_ignored(folder):
    found = variables("keras", folder)
    stem = resnet.ResNet50(resnet.KERAS, "stem")
    images = jnp.stack([RGB, RGB[::-1]])[:, None]
    one = stem.apply(found, RGB)
    assert one.shape == (11, 14, 64)
    for many in (jax.jit(stem.apply)(found, images)[:, 0], jax.vmap(stem.apply, (None, 0))(found, images[:, 0])):
        np.testing.assert_allclose(many[0], one, atol=1e-5)
        np.testing.assert_allclose(many[1], stem.apply(found, RGB[::-1]), atol=1e-5)
    pooled = jnp.maximum(apply("keras")(found, RGB)[1]["intermediates"]["stem"]["__call__"][0], 0)
    np.testing.assert_allclose(one[1, 2], pooled[1:4, 3:6].max((0, 1)), atol=1e-5)


def test_the_pyramid_ends_every_stage(folder):
    """What its name's last block gives; the last is what a call gives."""
    found = variables("keras", folder)
    features, state = apply("keras")(found, RGB)
    pyramid = jax.jit(functools.partial(resnet.ResNet50(resnet.KERAS, "conv3").apply, method="pyramid"))(found, RGB)
    assert set(pyramid) == {"stem", "conv2", "conv3"}
    np.testing.assert_allclose(pyramid["conv2"], state["intermediates"]["conv2_3"]["__call__"][0], atol=1e-5)
    np.testing.assert_allclose(pyramid["conv3"], features, atol=1e-5)
    np.testing.assert_allclose(pyramid["stem"], resnet.ResNet50(resnet.KERAS, "stem").apply(found, RGB), atol=1e-5)


def test_bfloat16_is_inside_only(folder):
    half = resnet.ResNet50(resnet.KERAS, "stem", jnp.bfloat16)
    found = variables("keras", folder)
    features, state = half.apply(found, RGB, capture_intermediates=True)
    exact = resnet.ResNet50(resnet.KERAS, "stem").apply(found, RGB)
    assert features.dtype == jnp.float32 and state["intermediates"]["stem"]["__call__"][0].dtype == jnp.bfloat16
    assert 1e-5 < jnp.abs(features - exact).max() / exact.max() < 0.03


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="stage must be one of stem, conv2, .*got 'layer1'"):
        resnet.ResNet50(resnet.KERAS, "layer1")
    with pytest.raises(ValueError, match="strided must be one of .*got 'first'"):
        resnet.Flavour("first", (0, 1, 2), 1.0, (0, 0, 0), (1, 1, 1), 1e-5)
    for image in (jnp.zeros((8, 8, 4)), jnp.zeros((8, 3)), jnp.zeros((8, 8, 3), jnp.uint8)):
        with pytest.raises(ValueError, match=r"needs RGB images \[..., H, W, 3\] of floats in 0..1, got .*8"):
            resnet.ResNet50(resnet.KERAS, "stem").init(jax.random.key(0), image)
