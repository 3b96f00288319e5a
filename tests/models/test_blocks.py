"""The hourglass: the paper's size and cost, its arithmetic against plain numpy, and its options."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference

from lala_jax.models import blocks


def _abstract(net, *shape):
    image = jax.ShapeDtypeStruct(shape, jnp.float32)
    return jax.eval_shape(net.init, jax.random.key(0), image), image


def _count(params):
    return sum(leaf.size for leaf in jax.tree.leaves(params))


def _multiplications(net, *shape):
    """Count every tap of every convolution, those on padding too."""
    jaxpr = jax.make_jaxpr(net.apply)(*_abstract(net, *shape))

    def count(jaxpr):
        total = 0
        for eqn in jaxpr.eqns:
            if eqn.primitive.name == "conv_general_dilated":
                out_features, *taps = (eqn.invars[1].aval.shape[axis] for axis in eqn.params["dimension_numbers"].rhs_spec)
                assert eqn.outvars[0].aval.size % out_features == 0
                total += eqn.outvars[0].aval.size * int(np.prod(taps))
            total += sum(count(sub.jaxpr) for sub in eqn.params.values() if hasattr(sub, "jaxpr"))
        return total

    return count(jaxpr.jaxpr)


def _expected_parameters(channels, out):
    """Add up the layers as the paper lists them: a stem with biases, then pairs without."""
    total, before = 9 * channels * 64 + 64, 64
    for width, last in ((64, 64), (128, 128), (256, 256), (512, 512), (256, 256), (128, 128), (64, 64), (16, out)):
        first = before * width + 9 * width * width + width * last + before * last
        second = last * width + 9 * width * width + width * last
        total, before = total + first + second, last
    return total


@pytest.mark.parametrize("channels, out", [(4, 1), (4, 3), (6, 3)])
def test_has_the_papers_parameters(channels, out):
    params, _ = _abstract(blocks.ResNet43_8s(out), 64, 64, channels)
    assert _count(params) == _expected_parameters(channels, out)
    assert round(_count(params) / 1e6, 2) == 9.82


@pytest.mark.parametrize("out, shape, giga", [(1, (320, 320, 6), 48), (3, (384, 224, 6), 40), (3, (36, 64, 64, 6), 69)])
def test_costs_what_the_papers_costs(out, shape, giga):
    net = blocks.ResNet43_8s(out)
    assert round(_multiplications(net, *shape) / 1e9) == giga
    output, decoded = jax.eval_shape(net.apply, *_abstract(net, *shape))
    assert output.shape == (*shape[:-1], out)
    height, width = shape[-3:-1]
    assert [x.shape[-3:] for x in decoded] == [(height // 4, width // 4, 256), (height // 2, width // 2, 128), (height, width, 64)]


@pytest.mark.parametrize("stride, project, last_relu", [(1, False, True), (1, False, False), (2, True, True)])
def test_a_block_is_its_formula(stride, project, last_relu):
    block = blocks.ResidualBlock(3, 5, stride, project, last_relu)
    x = jax.random.normal(jax.random.key(0), (6, 4, 5))
    params = jax.jit(block.init)(jax.random.key(1, impl="rbg"), x)
    leaves, image = params["params"], np.asarray(x, np.float64)
    y = reference.relu(reference.conv(image, leaves["reduce"]))
    y = reference.relu(reference.conv(y, leaves["middle"], stride))
    y = reference.conv(y, leaves["expand"]) + (reference.conv(image, leaves["shortcut"], stride) if project else image)
    np.testing.assert_allclose(jax.jit(block.apply)(params, x), np.maximum(y, 0) if last_relu else y, atol=1e-5)


def test_upsampling_interpolates_between_the_cells_that_strides_take():
    x = np.random.default_rng(0).normal(size=(2, 3, 5, 2)).astype(np.float32)
    want = np.apply_along_axis(lambda line: np.interp(np.arange(10) / 2, np.arange(5), line), 2, x)
    want = np.apply_along_axis(lambda line: np.interp(np.arange(6) / 2, np.arange(3), line), 1, want)
    np.testing.assert_allclose(blocks.upsample(x), want, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(blocks.upsample(x))[:, ::2, ::2], x)


@pytest.mark.parametrize("stages", (1, 2, 3))
def test_a_compact_one_keeps_the_image_and_any_batch(stages):
    net = blocks.ResNet43_8s(2, width=4, stages=stages)
    x = jax.random.normal(jax.random.key(0), (2, 3, 8, 12, 3))
    params = jax.jit(net.init)(jax.random.key(1, impl="rbg"), x[0, 0])
    output, decoded = jax.jit(net.apply)(params, x)
    assert output.shape == (2, 3, 8, 12, 2) and len(decoded) == stages - 1
    one, _ = jax.jit(net.apply)(params, x[1, 2])
    np.testing.assert_allclose(output[1, 2], one, atol=1e-5)


def test_laterals_enter_the_decoder():
    net = blocks.ResNet43_8s(1, width=4, stages=2)
    x = jax.random.normal(jax.random.key(0), (8, 8, 3))
    lateral = [jax.random.normal(jax.random.key(1), (8, 8, 4))]
    params = jax.jit(net.init)(jax.random.key(2, impl="rbg"), x, lateral)
    assert _count(params) - _count(_abstract(net, 8, 8, 3)[0]) == 8 * 4 + 4
    apply = jax.jit(net.apply)
    assert not np.allclose(apply(params, x, lateral)[0], apply(params, x, [-lateral[0]])[0])


def test_an_output_of_one_channel_is_never_dead():
    x = jax.random.uniform(jax.random.key(0), (8, 8, 3))

    def spread(key):
        return blocks.ResNet43_8s(1, width=8, stages=1).init_with_output(key, x)[0][0].std()

    keys = jax.random.split(jax.random.key(1, impl="rbg"), 32)
    assert (jax.jit(lambda keys: jax.lax.map(spread, keys))(keys) > 1e-3).all()


def test_computes_in_bfloat16_with_float32_parameters():
    net = blocks.ResNet43_8s(1, width=4, stages=2, dtype=jnp.bfloat16)
    params, image = _abstract(net, 8, 8, 3)
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype("float32")}
    assert jax.eval_shape(net.apply, params, image)[0].dtype == jnp.bfloat16


def test_slopes_are_the_same_with_many_channels(monkeypatch):
    """Those of a stem that takes the kernel's gradient as a product, on a CPU, and those of XLA's convolution elsewhere."""
    net, image = blocks.ResNet43_8s(2, width=4, stages=2), jax.random.normal(jax.random.key(0), (2, 8, 12, 40))
    params = jax.jit(net.init)(jax.random.key(1, impl="rbg"), image)
    found = []
    for platform in ("cpu", "tpu"):
        monkeypatch.setattr(jax, "default_backend", lambda platform=platform: platform)
        found.append(jax.jit(jax.grad(lambda params: jnp.sin(net.apply(params, image)[0]).sum())).lower(params))
    assert ["dot_general" in program.as_text() for program in found] == [True, False]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), *[program.compile()(params) for program in found])


def test_refuses_sides_that_do_not_divide():
    with pytest.raises(ValueError, match=r"sides divisible by 8, got \(60, 64, 3\)"):
        _abstract(blocks.ResNet43_8s(1), 60, 64, 3)
