"""Items one after the other and all at once: the same values, the same gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax.perception import batches


def test_both_ways_give_the_same_values_and_gradients():
    items = {"a": jax.random.normal(jax.random.key(0), (3, 5)), "b": jnp.arange(3.0)}

    def one(item):
        return {"sum": jnp.sin(item["a"]).sum() * item["b"], "max": item["a"].max()}

    found = [
        jax.value_and_grad(lambda items, m=method: batches.each(one, items, method=m)["sum"].sum())(items) for method in batches.METHODS
    ]
    by_hand = sum(float(np.sin(np.asarray(items["a"][i])).sum()) * i for i in range(3))
    assert found[0][0] == pytest.approx(by_hand, rel=1e-5)
    for other in found[1:]:
        jax.tree.map(lambda mine, theirs: np.testing.assert_allclose(mine, theirs, rtol=1e-5), other, found[0])
    assert {name: leaf.shape for name, leaf in batches.each(one, items).items()} == {"sum": (3,), "max": (3,)}


def test_another_method_is_refused():
    with pytest.raises(ValueError, match=r"method must be one of \('auto', 'map', 'vmap'\), got 'loop'"):
        batches.each(lambda item: item, jnp.zeros(3), method="loop")
