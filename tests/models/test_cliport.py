"""CLIPort: its public size, its arithmetic against plain numpy, where its turned features lie, and what it refuses."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import scipy.ndimage

from lala_jax.models import cliport, transporter

SMALL = {"yaw_bins": 4, "crop": 8, "width": 4, "stages": 3}


def _drawn(shapes):
    """Parameters that keep a picture's size through ReLUs, drawn by numpy."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda s: rng.normal(0, (2 / max(np.prod(s.shape[:-1]), 8)) ** 0.5, s.shape).astype(np.float32), shapes)


def _inputs(rows, cols, strides, embed=5):
    """A map of 4 channels, features of 3, 4, ... channels at the strides, and a sentence."""
    rng = np.random.default_rng(1)
    sides = [(rows, cols, 4)] + [(rows // stride, cols // stride, 3 + index) for index, stride in enumerate(strides)]
    maps, *features = (rng.normal(size=side).astype(np.float32) for side in sides)
    return maps, features, rng.normal(size=embed).astype(np.float32)


def _pair(before, width, out=None):
    """Count a `ConvBlock` and an `IdentityBlock`, none with a bias."""
    out = width if out is None else out
    return before * width + 9 * width**2 + width * out + before * out + out * width + 9 * width**2 + width * out


def _spatial(channels, out):
    """Add up `ResNet45_10s`."""
    widths = (64, 64, 128, 256, 512, 1024, 512, 256, 128, 64, 32)
    pairs = sum(_pair(before, width) for before, width in zip(widths, widths[1:], strict=False))
    return 9 * channels * 64 + 64 + pairs + _pair(32, 16, out)


def _semantic(channels, embed, out, text_fc):
    """Add up `RN50BertLingUNetLat`, or `CLIPLingUNetLat`, without frozen encoders, and apart the biases that its batch norm cancels.

    `channels` are the features'; CLIPort's are 256, 512, 1024, 2048. With fewer, its first levels are left out. `CLIPLingUNetLat`
    has no `text_fc`: its `lang_proj` take CLIP's 1024.
    """
    *skips, last = channels
    total, cancelled = (embed * 1024 + 1024 if text_fc else 0) + 9 * last * (last // 2), 0  # and conv1
    for skip in skips:
        total += (1024 if text_fc else embed) * skip + skip  # lang_proj
        for before, after in ((2 * skip, skip), (skip, skip // 2)):  # Up's DoubleConv
            total += 9 * before * after + after + 2 * after
            cancelled += after
        total += (skip // 2 + skip) * skip // 2  # lat_fusion with as many channels as the skip has
    for before, width in ((128, 64), (64, 32), (32, 16)):  # dec1 to dec3 and their lat_fusions
        total += _pair(before, width) + 3 * width * width
    return total + 16 * out + out, cancelled


@pytest.mark.parametrize(
    "channels, embed, text_layer, public",
    [
        ((256, 512, 1024, 2048), 768, True, 279_377_803),
        ((256, 512, 1024, 2048), 1024, False, 277_015_435),
        ((256, 512), 384, True, 128_947_339),
    ],
    ids=["RN50 + BERT", "CLIP", "conv3 + MiniLM"],
)
def test_has_the_public_parameters(channels, embed, text_layer, public):
    """CLIPort's TwoStreamRN50BertLingUNetLatTransporterAgent and TwoStreamClipLingUNetLatTransporterAgent.

    They are attention and twice two streams, and the 1x1s that fuse the latter.
    """
    counts = [_semantic(channels, embed, out, text_layer) for out in (1, 3, 3)]
    total = sum(count for count, _ in counts) + sum(_spatial(6, out) for out in (1, 3, 3)) + 2 * 6 * 3
    assert total == public
    maps = jax.ShapeDtypeStruct((320, 160, 6), jnp.float32)
    features = [jax.ShapeDtypeStruct((320 // (4 << i), 160 // (4 << i), c), jnp.float32) for i, c in enumerate(channels)]
    sentence, cell = jax.ShapeDtypeStruct((embed,), jnp.float32), jax.ShapeDtypeStruct((2,), jnp.int32)
    net = cliport.Cliport(text_layer=text_layer)
    (logits, intermediates), params = jax.eval_shape(net.init_with_output, jax.random.key(0), maps, features, sentence, cell)
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == public - sum(cancelled for _, cancelled in counts)
    assert logits["pick"].shape == (320, 160) and logits["place"].shape == (36, 320, 160)
    assert intermediates["key"].shape == (384, 224, 3) and intermediates["query"].shape == (36, 64, 64, 3)


def _spatial_values(params, x, stages):
    """Pass the spatial stream, and give what its decoder's layers were given."""
    x = reference.relu(reference.conv(x, params["stem"]))
    for stage in range(stages):
        x = reference.pair(params, f"down{stage}", x, 2 if stage else 1)
    laterals = [x]
    for stage in reversed(range(stages)):
        x = reference.upsample(reference.pair(params, f"up{stage}", x))
        laterals.append(x)
    return reference.pair(params, "head", x, last_relu=False)[..., ::2, ::2, :], laterals


def _semantic_values(params, features, laterals, sentence):
    """Pass the semantic stream, both ReLUs of every lateral fusion in place."""

    def dense(x, leaf):
        return x @ np.asarray(leaf["kernel"], np.float64) + leaf["bias"]

    def normal(x, leaf):
        mean, variance = (moment(x.reshape(-1, x.shape[-1]), axis=0) for moment in (np.mean, np.var))
        return (x - mean) / np.sqrt(variance + 1e-5) * leaf["scale"] + leaf["bias"]

    *skips, x = features
    text = dense(sentence, params["text"]) if "text" in params else sentence  # CLIPLingUNetLat has no such layer
    x = reference.relu(reference.conv(x, params["stem"]))
    for level in reversed(range(int(np.log2(laterals[-1].shape[-2] / x.shape[-2])))):
        if skips:
            x = x * dense(text, params[f"language{level + 1}"])
            x = np.concatenate([skips.pop(), reference.upsample(x)], -1)
            for index in (0, 1):
                x = reference.conv(x, params[f"up{level}_conv{index}"])
                x = reference.relu(normal(x, params[f"up{level}_norm{index}"]))
        else:
            x = reference.upsample(reference.pair(params, f"up{level}", x))
        both = np.concatenate([x, laterals[len(laterals) - 1 - level]], -1)
        x = reference.conv(reference.relu(both), params[f"lateral{level}"])
    return reference.conv(x, params["head"])[..., ::2, ::2, :]


def _two_streams(params, maps, features, sentence, stages=SMALL["stages"]):
    maps, *features = (np.asarray(one, np.float64) for one in (maps, *features))
    spatial, laterals = _spatial_values(params["spatial"], maps, stages)
    semantic = _semantic_values(params["semantic"], features, laterals, sentence)
    if "fuse" not in params:
        return spatial + semantic
    return reference.conv(reference.relu(np.concatenate([spatial, semantic], -1)), params["fuse"])


def test_equals_its_formulas_in_numpy():
    """From map, features and sentence to both logits on the same random weights; the best pick is taken where none is given."""
    net = cliport.Cliport(**SMALL)
    maps, features, sentence = _inputs(24, 8, (2, 4, 8))
    params = _drawn(jax.eval_shape(net.init, jax.random.key(0), maps, features, sentence))
    seen = [np.random.default_rng(2).normal(size=(4, *(8 // 2 ** (i + 1),) * 2, 3 + i)).astype(np.float32) for i in range(3)]

    @jax.jit
    def both(params, maps, features, sentence, seen):
        bound = net.bind(params)
        logits, intermediates = bound(maps, features, sentence)
        return logits, intermediates, bound.place(maps, features, sentence, intermediates["pick_cell"], seen)

    logits, intermediates, (place_seen, _) = both(params, maps, features, sentence, seen)

    def padded(rows, cols):
        return [
            np.pad(one, [(size // s, size // s) for size in (rows, cols)] + [(0, 0)])
            for one, s in zip([maps, *features], (1, 2, 4, 8), strict=True)
        ]

    def run(name, maps, *features):
        return _two_streams(params["params"][f"{name}_net"], maps, features, sentence)

    pick = run("pick", *padded(0, 8))[:, 8:16, 0]
    np.testing.assert_allclose(logits["pick"], pick, atol=1e-3 * pick.std())
    cell = np.unravel_index(np.argmax(pick), pick.shape)
    np.testing.assert_array_equal(intermediates["pick_cell"], cell)
    key = run("key", *padded(8, 8))[4:-4, 4:-4]
    np.testing.assert_allclose(intermediates["key"], key, atol=1e-3 * key.std())
    crops = reference.quarter_crops(maps, cell, 8)
    how = {"yaw_bins": 4, "crop": 8}
    turned = [cliport.turned_features(jnp.asarray(one), jnp.array(cell), stride=2 << i, **how) for i, one in enumerate(features)]
    for given, place in ((turned, logits["place"]), (seen, place_seen)):
        expected = reference.places(key, run("query", crops, *given)) / 8 / 3**0.5
        np.testing.assert_allclose(place, expected, atol=1e-3 * expected.std())
    other, *_ = both(params, maps, features, sentence[::-1], seen)
    assert np.abs(other["pick"] - logits["pick"]).max() > 1e-2 * pick.std()


def test_clips_form_equals_its_formulas_in_numpy():
    """Two streams to a stride of 32, whose sentence is multiplied in without a layer of its own before."""
    net = cliport.TwoStream(2, "conv", width=4, stages=5, text_layer=False)
    maps, features, sentence = _inputs(64, 32, (4, 8, 16, 32))
    params = _drawn(jax.eval_shape(net.init, jax.random.key(0), maps, features, sentence))
    expected = _two_streams(params["params"], maps, features, sentence, stages=5)
    found = jax.jit(net.apply)(params, maps, features, sentence)
    np.testing.assert_allclose(found, expected, atol=1e-3 * expected.std())
    other = jax.jit(net.apply)(params, maps, features, sentence[::-1])
    assert np.abs(other - found).max() > 1e-2 * expected.std()


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_turned_features_lie_over_the_turned_crop(stride):
    """Crop cell `[s a, s b]` reads what lies over its own place in the map; at stride 1 it is the map's crop."""
    features = np.random.default_rng(0).normal(size=(24 // stride, 16 // stride, 2)).astype(np.float32)
    cell, crop, turns = np.array([9, 6]), 8, 6
    got = cliport.turned_features(jnp.asarray(features), jnp.asarray(cell), yaw_bins=turns, crop=crop, stride=stride)
    assert got.shape == (turns, crop // stride, crop // stride, 2)
    for turn, a, b in np.ndindex(got.shape[:3]):
        angle = -2 * math.pi * turn / turns  # what a turned crop shows lies a turn back
        x, y = stride * b - crop // 2, stride * a - crop // 2
        at = cell + [math.sin(angle) * x + math.cos(angle) * y, math.cos(angle) * x - math.sin(angle) * y]
        read = functools.partial(scipy.ndimage.map_coordinates, coordinates=at[:, None] / stride, order=1, mode="grid-constant")
        np.testing.assert_allclose(got[turn, a, b], [read(channel)[0] for channel in np.moveaxis(features, -1, 0)], atol=1e-4)
    if stride == 1:
        np.testing.assert_allclose(
            got, transporter.pick_crops(jnp.asarray(features), jnp.asarray(cell), yaw_bins=turns, crop=crop), atol=1e-6
        )


def test_learns_everywhere():
    """Of two streams as in key and query; the semantic one need not reach as deep as the spatial one."""
    net = cliport.TwoStream(3, "conv", width=8, stages=3)
    maps, features, sentence = _inputs(8, 8, (2, 4))
    params = _drawn(jax.eval_shape(net.init, jax.random.key(0), maps, features, sentence))
    grads = jax.jit(jax.grad(lambda params: (net.apply(params, maps, features, sentence) ** 2).sum()))(params)
    for path, leaf in jax.tree.leaves_with_path(grads):
        assert np.isfinite(leaf).all() and np.any(leaf), f"no gradient reaches {jax.tree_util.keystr(path)}"


def test_gives_float32_whatever_it_computes_in():
    net = cliport.Cliport(**SMALL, dtype=jnp.bfloat16)
    (logits, _), params = jax.eval_shape(net.init_with_output, jax.random.key(0), *_inputs(8, 8, (2, 4)), np.array([1, 2]))
    assert {leaf.dtype for leaf in jax.tree.leaves((logits, params))} == {jnp.dtype("float32")}


@pytest.mark.parametrize(
    "options, strides, message",
    [
        ({"method": "direct"}, (2, 4), "method must be one of .*got 'direct'"),
        ({"yaw_bins": 0}, (2, 4), "yaw_bins must be at least 1, got 0"),
        ({"crop": 12}, (2, 4, 8), "crop must be a positive multiple of 8 here, got 12"),
        ({}, (4,), r"two or more strides, each twice the one before, got strides \[4\]"),
        ({}, (2, 8), r"each twice the one before, got strides \[2, 8\]"),
        ({}, (4, 2), r"each twice the one before, got strides \[4, 2\]"),
        ({}, (3, 6), r"sides \(24, 24\) divided by a power of two, got \(8, 8\)"),
        ({"stages": 2}, (2, 4, 8), r"strides \[2, 4, 8\] need a Cliport of 3 stages, got 2"),
    ],
)
def test_refuses_what_does_not_fit(options, strides, message):
    maps, features, sentence = _inputs(24, 24, strides)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(cliport.Cliport(**(SMALL | options)).init, jax.random.key(0), maps, features, sentence)


def test_refuses_an_unknown_fusion():
    with pytest.raises(ValueError, match=r"fusion must be one of \('add', 'conv'\), got 'mean'"):
        cliport.TwoStream(1, "mean")
