"""Every variant and fusion: its parameters, and which image can influence what."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from lala_jax.models import blocks, streams

HOURGLASS = 9_822_128  # parameters of one with 4 channels in and 1 out
FUSE = 2 * 3 * 3 + 3
LATERALS = sum(2 * width * width + width for width in (256, 128, 64))


def _small(variant, fusion="add", **options):
    net = streams.Streams(2, variant, fusion, width=4, stages=2, **options)
    current, goal, other = jax.random.normal(jax.random.key(0), (3, 8, 8, 3))
    return net, jax.jit(net.init)(jax.random.key(1, impl="rbg"), current, goal), current, goal, other


@pytest.mark.parametrize(
    "variant, fusion, out, parameters",
    [
        ("single", "add", 1, HOURGLASS),
        ("two_stream", "add", 1, 2 * HOURGLASS),
        ("two_stream_lateral", "add", 1, 2 * HOURGLASS + LATERALS),
        ("single", "conv", 3, HOURGLASS + 80),
        ("two_stream", "conv", 3, 2 * (HOURGLASS + 80) + FUSE),
        ("two_stream_lateral", "conv", 3, 2 * (HOURGLASS + 80) + FUSE + LATERALS),
    ],
)
def test_has_the_papers_parameters(variant, fusion, out, parameters):
    """Two more channels out cost 16 each in the last 1x1 and 64 in the shortcut before, then (16 + 16) each and 9 taps between."""
    net = streams.Streams(out, variant, fusion)
    image = jax.ShapeDtypeStruct((64, 64, 4), jnp.float32)
    params = jax.eval_shape(net.init, jax.random.key(0), image, image)
    extra = 2 * (16 + 64 + 16 + 16) - 80 if out == 3 else 0
    if variant != "single":
        extra *= 2
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == parameters + extra
    assert jax.eval_shape(net.apply, params, image, image).shape == (64, 64, out)


def test_single_sees_only_the_difference():
    net, params, current, goal, other = _small("single")
    apply = jax.jit(net.apply)
    np.testing.assert_allclose(apply(params, current, goal), apply(params, current + other, goal + other), atol=1e-5)
    assert not np.allclose(apply(params, current, goal), apply(params, goal, current))


def test_two_streams_add_two_networks():
    net, params, current, goal, _ = _small("two_stream")
    one = jax.jit(blocks.ResNet43_8s(2, width=4, stages=2).apply)
    want = one({"params": params["params"]["current"]}, current)[0] + one({"params": params["params"]["goal"]}, goal)[0]
    np.testing.assert_allclose(jax.jit(net.apply)(params, current, goal), want, atol=1e-5)


def test_two_streams_are_reduced_by_a_matrix_on_each_cell():
    net, params, current, goal, _ = _small("two_stream", "conv")
    one = jax.jit(blocks.ResNet43_8s(2, width=4, stages=2).apply)
    both = [one({"params": params["params"][name]}, image)[0] for name, image in (("current", current), ("goal", goal))]
    fuse = params["params"]["fuse"]
    want = np.concatenate(both, -1) @ np.asarray(fuse["kernel"][0, 0]) + fuse["bias"]
    np.testing.assert_allclose(jax.jit(net.apply)(params, current, goal), want, atol=1e-5)


@pytest.mark.parametrize("variant, mixes", [("two_stream", False), ("two_stream_lateral", True)])
def test_only_laterals_let_the_images_meet_before_the_sum(variant, mixes):
    """In a sum of two networks the effect of another current image does not depend on the goal."""
    net, params, current, goal, other = _small(variant)
    apply = jax.jit(net.apply)
    effect = [apply(params, other, seen) - apply(params, current, seen) for seen in (goal, -goal)]
    assert np.allclose(*effect, atol=1e-5) != mixes


@pytest.mark.parametrize("fusion", streams.FUSIONS)
def test_laterals_lead_from_the_current_stream_into_the_goals(fusion):
    """Level by level, coarse to fine, against NumPy in float64."""
    net = streams.Streams(2, "two_stream_lateral", fusion, width=4, stages=3)
    current, goal = np.random.default_rng(0).normal(size=(2, 8, 12, 3)).astype(np.float32)
    params = jax.jit(net.init)(jax.random.key(1, impl="rbg"), current, goal)
    assert ("fuse" in params["params"]) == (fusion == "conv")
    want = reference.streams(params["params"], "two_stream_lateral", current, goal, 3)
    np.testing.assert_allclose(jax.jit(net.apply)(params, current, goal), want, atol=1e-5)


@pytest.mark.parametrize("variant, fusion", list(itertools.product(streams.VARIANTS, streams.FUSIONS)))
def test_gives_float32_whatever_it_computes_in(variant, fusion):
    net = streams.Streams(2, variant, fusion, width=4, stages=2, dtype=jnp.bfloat16)
    image = jax.ShapeDtypeStruct((8, 8, 3), jnp.float32)
    params = jax.eval_shape(net.init, jax.random.key(0), image, image)
    out = jax.eval_shape(net.apply, params, image, image)
    assert out.shape == (8, 8, 2) and out.dtype == jnp.float32


def test_refuses_unknown_options_and_unequal_images():
    with pytest.raises(ValueError, match="variant must be one of .*'two_stream_lateral'.*, got 'three_stream'"):
        streams.Streams(1, "three_stream")
    with pytest.raises(ValueError, match=r"fusion must be one of \('add', 'conv'\), got 'mean'"):
        streams.Streams(1, fusion="mean")
    images = jax.random.normal(jax.random.key(0), (2, 8, 8, 3))
    with pytest.raises(ValueError, match="must have one shape"):
        streams.Streams(1).init(jax.random.key(1), images[0], images[1, :4])
