"""The sentence encoder: its size, agreement with plain NumPy on random weights, and that padding does not matter."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import numpy_bert
import pytest

from lala_jax.models import bert

SMALL = {"vocab": 20, "positions": 9, "width": 12, "layers": 2, "heads": 3, "hidden": 20}
POOLER = 384 * 384 + 384


def published(vocab, positions, width, layers, heads, hidden):
    """Random tensors, called and laid out as Hugging Face's BertModel has them."""
    rng = np.random.default_rng(0)
    dense = {"attention.self.query": (width, width), "attention.self.key": (width, width), "attention.self.value": (width, width)}
    dense |= {"attention.output.dense": (width, width), "intermediate.dense": (hidden, width), "output.dense": (width, hidden)}
    shapes = {"embeddings.word_embeddings.weight": (vocab, width), "embeddings.position_embeddings.weight": (positions, width)}
    shapes |= {"embeddings.token_type_embeddings.weight": (2, width), "pooler.dense.weight": (width, width)}
    norms = ["embeddings.LayerNorm"]
    for layer in range(layers):
        for name, shape in dense.items():
            shapes |= {f"encoder.layer.{layer}.{name}.weight": shape, f"encoder.layer.{layer}.{name}.bias": shape[:1]}
        norms += [f"encoder.layer.{layer}.{name}.LayerNorm" for name in ("attention.output", "output")]
    for name in norms:
        shapes |= {f"{name}.weight": (width,), f"{name}.bias": (width,)}
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


@pytest.fixture(scope="module")
def small():
    net, tensors = bert.Bert(**SMALL), published(**SMALL)
    return net, tensors, bert.from_published(tensors, net)


def _sentences():
    """Ids and mask `[4, 9]` of sentences of 1, 4, 8 and 9 tokens; what stands in the padding is random too."""
    rng = np.random.default_rng(1)
    return rng.integers(0, 20, (4, 9)), np.arange(9) < np.array([1, 4, 8, 9])[:, None]


def test_published_size():
    """22,713,216 parameters are published, the pooler's among them."""
    tokens = jax.ShapeDtypeStruct((3, 20), jnp.int32)
    net = bert.Bert()
    params = jax.eval_shape(net.init, jax.random.key(0), tokens, tokens)
    assert sum(leaf.size for leaf in jax.tree.leaves(params)) == 22_713_216 - POOLER
    assert jax.eval_shape(net.apply, params, tokens, tokens).shape == (3, 384)


def test_agrees_with_plain_numpy(small):
    net, tensors, params = small
    ids, mask = _sentences()
    out = jax.jit(net.apply)(params, jnp.asarray(ids), jnp.asarray(mask))
    assert out.dtype == jnp.float32
    for index, (row, shown) in enumerate(zip(ids, mask, strict=True)):
        np.testing.assert_allclose(out[index], numpy_bert.embed(tensors, row[shown], layers=2, heads=3), atol=1e-5)
    assert np.ptp(out, axis=0).max() > 0.1, "all sentences look the same"


def test_padding_does_not_matter_and_order_does(small):
    net, _, params = small
    ids, mask = map(jnp.asarray, _sentences())
    apply = jax.jit(net.apply)
    out = apply(params, ids, mask)
    np.testing.assert_array_equal(apply(params, jnp.where(mask, ids, 0), mask), out)
    np.testing.assert_array_equal(apply(params, ids, mask.astype(jnp.int32)), out)
    assert np.abs(apply(params, ids.at[3, :2].set(ids[3, 1::-1]), mask)[3] - out[3]).max() > 1e-3
    np.testing.assert_array_equal(apply(params, ids, jnp.zeros_like(mask)), 0.0)


def test_jit_equals_eager_and_vmap_equals_a_loop(small):
    net, _, params = small
    ids, mask = map(jnp.asarray, _sentences())
    out = jax.jit(jax.vmap(net.apply, (None, 0, 0)))(params, ids, mask)
    np.testing.assert_allclose(out[1], net.apply(params, ids[1], mask[1]), atol=1e-6)
    np.testing.assert_allclose(out, jax.jit(net.apply)(params, ids[None], mask[None])[0], atol=1e-6)


def test_gradients_are_finite_with_padding_and_an_empty_mask(small):
    net, _, params = small
    ids, mask = map(jnp.asarray, _sentences())
    grads = jax.jit(jax.grad(lambda params: net.apply(params, ids, mask.at[0].set(False))[:, 0].sum()))(params)
    for path, leaf in jax.tree.leaves_with_path(grads):
        assert np.isfinite(leaf).all(), jax.tree_util.keystr(path)
        assert np.any(np.abs(leaf) > 1e-6) or "key" in str(path) and "bias" in str(path)  # a key's bias moves all logits alike


def test_bfloat16_gives_float32_near_the_same(small):
    net, _, params = small
    ids, mask = map(jnp.asarray, _sentences())
    out = jax.jit(net.clone(dtype=jnp.bfloat16).apply)(params, ids, mask)
    assert out.dtype == jnp.float32
    np.testing.assert_allclose(out, jax.jit(net.apply)(params, ids, mask), atol=0.05)


def test_mistakes_are_named(small):
    net, tensors, params = small
    with pytest.raises(ValueError, match="Bert.width must be a multiple of its 5 heads, got 12"):
        bert.Bert(width=12, heads=5)
    with pytest.raises(ValueError, match=re.escape("token ids and mask must have one shape [..., T], got (3,) and (4,)")):
        net.apply(params, jnp.zeros(3, int), jnp.ones(4, bool))
    with pytest.raises(ValueError, match="Bert takes at most 9 tokens, got 10"):
        net.apply(params, jnp.zeros(10, int), jnp.ones(10, bool))
    name = "encoder.layer.1.output.dense.weight"
    with pytest.raises(ValueError, match=re.escape(f"Bert needs a tensor {name} of shape (12, 20), got (20, 12)")):
        bert.from_published(tensors | {name: tensors[name].T}, net)
    with pytest.raises(ValueError, match=re.escape("Bert needs a tensor embeddings.LayerNorm.bias of shape (12,), got none")):
        bert.from_published({name: leaf for name, leaf in tensors.items() if name != "embeddings.LayerNorm.bias"}, net)
