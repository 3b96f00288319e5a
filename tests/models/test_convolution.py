"""Convolutions over blocks of cells, and with a gradient of their own, against XLA's, with all gradients."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax.models import convolution

NUMBERS = ("NHWC", "HWIO", "NHWC")


def plain(x, kernel, strides):
    return jax.lax.conv_general_dilated(x, kernel, strides, "SAME", dimension_numbers=NUMBERS)


@pytest.mark.parametrize("strides", [(1, 1), (2, 2), (3, 2), (4, 4)])
@pytest.mark.parametrize("size", [1, 2, 3, 5, 8])
def test_values_and_gradients_are_those_of_the_strided_convolution(strides, size):
    rng = np.random.default_rng(size)
    x = jnp.asarray(rng.normal(size=(2, 12, 24, 3)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(size, max(size - 1, 1), 3, 4)), jnp.float32)

    def ours(x, kernel):
        return convolution.blocked(x, kernel, strides, "SAME", dimension_numbers=NUMBERS)

    got, back = jax.vjp(ours, x, kernel)
    want, want_back = jax.vjp(lambda x, kernel: plain(x, kernel, strides), x, kernel)
    assert got.shape == want.shape == (2, 12 // strides[0], 24 // strides[1], 4)
    np.testing.assert_allclose(got, want, atol=1e-4)
    slope = jnp.asarray(rng.normal(size=want.shape), jnp.float32)
    for mine, theirs in zip(back(slope), want_back(slope), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=2e-4)


def test_it_stands_in_in_flax_with_the_same_parameters():
    x = jax.random.normal(jax.random.key(0), (2, 8, 8, 3))
    layer = nn.Conv(4, (5, 5), strides=(2, 2))
    params = layer.init(jax.random.key(1), x)
    got = nn.Conv(4, (5, 5), strides=(2, 2), conv_general_dilated=convolution.blocked).apply(params, x)
    np.testing.assert_allclose(got, layer.apply(params, x), atol=1e-5)


def test_nothing_is_dilated_backward():
    kernel = jnp.zeros((5, 5, 3, 4))
    text = jax.jit(jax.grad(lambda x: convolution.blocked(x, kernel, (2, 2), "SAME", dimension_numbers=NUMBERS).sum()))
    assert "lhs_dilate = [2, 2]" not in text.lower(jnp.zeros((1, 8, 8, 3))).as_text()
    reference = jax.jit(jax.grad(lambda x: plain(x, kernel, (2, 2)).sum()))
    assert "lhs_dilate = [2, 2]" in reference.lower(jnp.zeros((1, 8, 8, 3))).as_text()


@pytest.mark.parametrize(
    "size, strides, padding",
    [
        ((3, 3), (1, 1), ((1, 1), (1, 1))),
        ((2, 3), (1, 1), ((0, 3), (4, 0))),
        ((1, 1), (1, 1), ((0, 0), (0, 0))),
        ((1, 1), (1, 1), ((2, 0), (0, 1))),
        ((1, 1), (2, 2), ((0, 0), (0, 0))),
        ((1, 1), (4, 3), ((0, 0), (0, 0))),
    ],
)
def test_the_kernels_gradient_as_a_product_is_that_of_the_convolution(size, strides, padding):
    """Of a batch of images, and of batches that `vmap` makes; strides need not divide the sides."""
    rng = np.random.default_rng(0)
    x, kernel = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((2, 3, 6, 8, 5), (*size, 5, 4)))

    def loss(x, kernel, convolve):
        return jnp.sin(jax.vmap(lambda x: convolve(x, kernel, strides, padding, dimension_numbers=NUMBERS))(x)).sum()

    both = convolution.product_gradient, jax.lax.conv_general_dilated
    (got, slopes), (want, expected) = (jax.value_and_grad(loss, (0, 1))(x, kernel, one) for one in both)
    np.testing.assert_allclose(got, want, rtol=1e-5)
    jax.tree.map(lambda mine, theirs: np.testing.assert_allclose(mine, theirs, atol=1e-4), slopes, expected)


def test_the_input_is_not_turned_for_it():
    x, kernel = jnp.zeros((4, 8, 8, 40)), jnp.zeros((3, 3, 40, 4))

    def text(convolve):
        grad = jax.grad(lambda kernel: convolve(x, kernel, (1, 1), ((1, 1), (1, 1)), dimension_numbers=NUMBERS).sum())
        return jax.jit(grad).lower(kernel).as_text()

    turned = "dim_numbers = [f, 0, 1, b]x"
    assert turned in text(jax.lax.conv_general_dilated) and turned not in text(convolution.product_gradient)


def test_the_inputs_gradient_waits_for_the_kernels():
    """As a kernel's gradient that is not finite shows, though nothing that the input's is made of is so."""
    x, kernel = jnp.ones((1, 4, 4, 5)).at[0, 0, 0, 0].set(jnp.inf), jnp.ones((1, 1, 5, 4))

    def slope(convolve):
        return jax.jit(jax.grad(lambda x, kernel: convolve(x, kernel, (1, 1), ((0, 0), (0, 0)), dimension_numbers=NUMBERS).sum(), (0, 1)))

    (waited, found), (at_once, wanted) = (slope(one)(x, kernel) for one in (convolution.product_gradient, jax.lax.conv_general_dilated))
    np.testing.assert_array_equal(found, wanted)
    assert not np.isfinite(found).all() and np.isfinite(at_once).all() and np.isnan(waited).any()


@pytest.mark.parametrize(
    "change, message",
    [
        ({"padding": "VALID"}, "padding 'VALID'"),
        ({"rhs_dilation": (2, 2)}, "rhs_dilation"),
        ({"feature_group_count": 3}, "groups"),
        ({"window_strides": (2, 3)}, r"strides \(2, 3\) must divide the sides \(8, 8\)"),
    ],
)
def test_what_it_cannot_do_is_refused(change, message):
    how = {"window_strides": (2, 2), "padding": "SAME", "dimension_numbers": NUMBERS} | change
    with pytest.raises(ValueError, match=message):
        convolution.blocked(jnp.zeros((1, 8, 8, 3)), jnp.zeros((3, 3, 3, 4)), **how)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"window_strides": (2, 1)}, r"strides of 1, or a 1x1 kernel without padding.*got \(2, 1\)"),
        ({"feature_group_count": 3}, "got 3 groups"),
        ({"rhs_dilation": (2, 2)}, "got rhs_dilation"),
    ],
)
@pytest.mark.parametrize("size, padding", [((3, 3), ((0, 0), (0, 0))), ((1, 1), ((1, 1), (1, 1)))])
def test_what_has_no_gradient_of_its_own_is_refused(change, message, size, padding):
    how = {"window_strides": (1, 1), "padding": padding} | change
    with pytest.raises(ValueError, match=message):
        convolution.product_gradient(jnp.zeros((1, 8, 8, 3)), jnp.zeros((*size, 3, 4)), **how)


def test_relu_is_flaxs_and_its_derivative_needs_the_result_only():
    x = jnp.asarray([[-jnp.inf, -2.0, -0.0], [0.0, 1e-30, jnp.inf]])
    slope = jnp.asarray([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    for wrap in (lambda function: function, jax.jit, jax.vmap):
        got, back = jax.vjp(wrap(convolution.relu), x)
        want, want_back = jax.vjp(wrap(nn.relu), x)
        np.testing.assert_array_equal(got, want)
        np.testing.assert_array_equal(*back(slope), *want_back(slope))
    for relu, needed in ((convolution.relu, True), (nn.relu, False)):
        program = jax.make_jaxpr(jax.grad(lambda x, relu=relu: relu(x).sum()))(x)
        (compare,) = (line for line in program.eqns if line.primitive.name in ("ne", "gt"))
        assert (compare.invars[0] in program.jaxpr.eqns[0].outvars) == needed
