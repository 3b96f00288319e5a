"""CLIP's towers: their published size, agreement with NumPy on random weights, where features lie, and what is refused."""

import functools

import clip_reference
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax.models import clip

RN50 = {"blocks": (3, 4, 6, 3), "width": 64, "side": 224, "embed": 1024}
RN50 |= {"vocab": 49408, "positions": 77, "text_width": 512, "layers": 12}
SMALL = {"blocks": (2, 1, 1, 2), "width": 4, "side": 64, "embed": 6, "vocab": 11, "positions": 7, "text_width": 12, "layers": 2}
NET = clip.Clip(clip.Visual((2, 1, 1, 2), 4), clip.Pool(2, 4, 6), clip.Text(11, 7, 12, 2, 3, 6))
IDS = np.array([[9, 3, 2, 10, 0, 0, 0], [9, 10, 4, 5, 6, 7, 8]])  # 10 ends a sentence


@functools.cache
def state():
    return clip_reference.state(np.random.default_rng(0), **SMALL)


@functools.cache
def variables():
    return clip.from_published(state(), NET)


@functools.cache
def tower(name):
    """Compile a tower of the whole model: of its variables and an image or ids."""
    with_all_digits = jax.default_matmul_precision("highest")
    return with_all_digits(jax.jit(lambda variables, x: getattr(NET.bind(variables), name)(x)))


def pictures(*shape):
    return np.random.default_rng(1).uniform(size=(*shape, 3)).astype(np.float32)


def close(found, expected):
    assert found.shape == expected.shape and found.dtype == jnp.float32 and expected.std() > 0.1
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("shape", [(2, 64, 64), (95, 75)])
def test_features_are_numpys(shape):
    """Batched and not, and also where the strides do not divide the sides, as PyTorch rounds them."""
    rgb = pictures(*shape)
    features = tower("visual")(variables(), rgb)
    assert [x.shape[-3:] for x in features] == [((shape[-2] + 1) // s, (shape[-1] + 1) // s, 4 * s) for s in (4, 8, 16, 32)]
    for index, one in enumerate(rgb.reshape(-1, *rgb.shape[-3:])):
        for found, reference in zip(features, clip_reference.visual(state(), one, blocks=SMALL["blocks"]), strict=True):
            close(found[index] if found.ndim > 3 else found, reference)


def test_embeddings_and_scores_are_numpys():
    rgb = pictures(2, 64, 64)
    images, (texts, tokens) = tower("image")(variables(), rgb), tower("text")(variables(), IDS)
    with jax.default_matmul_precision("highest"):
        scores = jax.jit(NET.apply)(variables(), rgb, IDS)
    for image, picture in zip(images, rgb, strict=True):
        features = clip_reference.visual(state(), picture, blocks=SMALL["blocks"])
        close(image, clip_reference.pool(state(), features[-1], heads=4))
    for text, own, ids in zip(texts, tokens, IDS, strict=True):
        embedding, features = clip_reference.text(state(), ids, layers=2, heads=3)
        close(text, embedding)
        close(own, features)
    cosines = np.array([[i @ t / np.sqrt((i @ i) * (t @ t)) for t in np.asarray(texts)] for i in np.asarray(images)])
    np.testing.assert_allclose(scores, np.exp(state()["logit_scale"]) * cosines, rtol=0, atol=1e-4)


def test_rn50_has_the_published_parameters():
    """OpenAI's RN50 has 102,007,137 parameters, whose names and shapes NumPy's version states, and features of 256 to 2048 channels."""
    net, expected = clip.Clip(), clip_reference.shapes(**RN50)
    found = clip.tensors(net)
    assert {name: shape for name, (_, shape) in found.items()} == expected
    paths = {path: np.prod(shape, dtype=int) for path, shape in found.values()}
    assert len(paths) == len(expected)
    assert sum(size for path, size in paths.items() if path.startswith("params/")) == 102_007_137
    assert sum(size for path, size in paths.items() if path.startswith("batch_stats/")) == 53_120 + 2 * (32 + 32 + 64 - 64)  # stems
    rgb, ids = jax.ShapeDtypeStruct((2, 224, 224, 3), jnp.float32), jax.ShapeDtypeStruct((3, 77), jnp.int32)
    scores, weights = jax.eval_shape(net.init_with_output, jax.random.key(0), rgb, ids)
    assert scores.shape == (2, 3)

    def towers(weights, rgb, ids):
        bound = net.bind(weights)
        features = bound.visual(rgb)
        return features, bound.pool(features[-1][:, :7, :7]), bound.text(ids)

    features, image, text = jax.eval_shape(towers, weights, jax.ShapeDtypeStruct((2, 320, 224, 3), jnp.float32), ids)
    assert [x.shape for x in features] == [(2, 80, 56, 256), (2, 40, 28, 512), (2, 20, 14, 1024), (2, 10, 7, 2048)]
    assert image.shape == (2, 1024) and [x.shape for x in text] == [(3, 1024), (3, 77, 512)]


@pytest.mark.parametrize(
    "sizes, net",
    [
        (RN50, clip.Clip()),
        (
            RN50 | {"blocks": (4, 6, 10, 6), "width": 80, "side": 288, "embed": 640, "text_width": 640},
            clip.Clip(clip.Visual((4, 6, 10, 6), 80), clip.Pool(9, 40, 640), clip.Text(width=640, heads=10, out=640)),
        ),
    ],
    ids=["RN50", "RN50x4"],
)
def test_sizes_are_read_off_the_shapes(sizes, net):
    """Those that OpenAI published; with numbers of heads that its constructors compute."""
    arrays = {name: np.broadcast_to(np.float32(0), shape) for name, shape in clip_reference.shapes(**sizes).items()}
    assert clip.sized(arrays) == net
    assert net.visual.stride == 32 and clip.Visual((1, 1)).stride == 8


@pytest.mark.parametrize("name", ["visual.layer1.0.conv1.weight", "token_embedding.weight", "text_projection"])
def test_what_says_no_sizes(name):
    for arrays, got in (({}, "none"), ({name: np.ones(3)}, r"one of shape \(3,\)")):
        left = {other: tensor for other, tensor in state().items() if other != name} | arrays
        with pytest.raises(ValueError, match=rf"CLIP with a ResNet has a tensor {name} of \d dimensions, got {got}"):
            clip.sized(left)


def test_features_lie_off_their_patches_corner():
    """With kernels that are even along the rows, mirroring 95 rows mirrors the features: rows `s * i + s / 2 - 1` lie evenly there."""
    even = jax.tree.map(lambda x: (x + x[::-1]) / 2 if x.ndim == 4 else x, variables())
    rgb = pictures(95, 75)
    plain, mirrored = (tower("visual")(even, image) for image in (rgb, rgb[::-1]))
    for one, other in zip(plain, mirrored, strict=True):
        np.testing.assert_allclose(other[::-1], one, rtol=0, atol=1e-4 * float(jnp.abs(one).max()))
        assert jnp.abs(other - one).max() > 5e-3 * jnp.abs(one).max()


def test_what_follows_a_sentences_end_changes_nothing():
    whole, _ = tower("text")(variables(), IDS)
    padded, _ = tower("text")(variables(), np.where(np.arange(7) > IDS.argmax(-1)[:, None], 1, IDS))
    np.testing.assert_array_equal(padded, whole)
    short, tokens = tower("text")(variables(), IDS[0, :4])
    assert tokens.shape == (4, 12)
    np.testing.assert_allclose(short, whole[0], atol=1e-5)
    assert jnp.abs(tower("text")(variables(), IDS[:, [0, 2, 1, 3, 4, 5, 6]])[0] - whole)[0].max() > 1e-2


def test_bfloat16_gives_float32_near_the_same():
    rgb = pictures(2, 64, 64)
    features = tower("visual")(variables(), rgb)
    exact = [features[0], tower("image")(variables(), rgb), *tower("text")(variables(), IDS)]
    visual = clip.Visual((2,), 4, jnp.bfloat16)  # one stage; deeper variables are ignored
    half = clip.Clip(visual, NET.pool.clone(dtype=jnp.bfloat16), NET.text.clone(dtype=jnp.bfloat16))

    @jax.jit
    def run(variables):
        bound = half.bind(variables)
        return [*bound.visual(rgb), bound.pool(features[-1]), *bound.text(IDS)]

    for one, other in zip(run(variables()), exact, strict=True):
        assert one.dtype == jnp.float32
        assert 1e-5 < jnp.abs(one - other).max() / jnp.abs(other).max() < 0.05


REFUSED = {
    r"needs a tensor visual.bn1.weight of floats and shape \(2,\), got none": {"visual.bn1.weight": None},
    r"has no tensor visual.layer1.2.conv1.weight, got one of shape \(4, 16, 1, 1\)": {
        "visual.layer1.2.conv1.weight": np.ones((4, 16, 1, 1))
    },
    r"needs a tensor visual.layer2.0.downsample.0.weight of floats and shape \(32, 16, 1, 1\), got float32 \(16, 32, 1, 1\)": {
        "visual.layer2.0.downsample.0.weight": np.ones((16, 32, 1, 1), np.float32)
    },
    r"needs a tensor transformer.resblocks.1.attn.in_proj_weight of floats and shape \(36, 12\), got float32 \(12, 36\)": {
        "transformer.resblocks.1.attn.in_proj_weight": np.ones((12, 36), np.float32)
    },
    r"needs a tensor text_projection of floats and shape \(12, 6\), got int64 \(12, 6\)": {"text_projection": np.ones((12, 6), np.int64)},
    r"needs a tensor logit_scale of floats and shape \(\), got .*\(1,\)": {"logit_scale": np.ones(1, np.float32)},
    "tensor visual.bn3.running_var of CLIP has values": {"visual.bn3.running_var": np.full(4, -0.1, np.float32)},
    "tensor ln_final.bias of CLIP has values": {"ln_final.bias": np.full(12, np.nan, np.float32)},
}


@pytest.mark.parametrize("message", REFUSED)
def test_other_tensors_are_refused(message):
    changed = {name: tensor for name, tensor in (state() | REFUSED[message]).items() if tensor is not None}
    with pytest.raises(ValueError, match=message):
        clip.from_published(changed, NET)


def test_inputs_that_it_cannot_take():
    bound = NET.bind(variables())
    with pytest.raises(ValueError, match="CLIP pools features of 2 x 2 cells, got 2 x 3"):
        bound.pool(jnp.zeros((2, 3, 128)))
    with pytest.raises(ValueError, match="CLIP takes at most 7 tokens, got 8"):
        bound.text(jnp.zeros(8, int))
    with pytest.raises(ValueError, match=r"needs RGB images \[..., H, W, 3\] of floats in 0..1, got uint8 \[64, 64, 3\]"):
        bound.visual(jnp.zeros((64, 64, 3), jnp.uint8))
