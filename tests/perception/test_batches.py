"""Items one after the other and all at once: the same values, the same gradients."""

import re

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


@pytest.mark.parametrize("at_once, groups", [(1, [1]), (2, [2, 1]), (3, [3]), (7, [3])])
def test_some_at_a_time_give_what_all_do(at_once, groups):
    """Also where their number is no multiple; and never more than that at once."""
    items = jax.random.normal(jax.random.key(0), (3, 5))

    def every(items):
        return batches.each(lambda item: jnp.sin(item).sum(), items, method="vmap", at_once=at_once)

    np.testing.assert_allclose(every(items), np.sin(np.asarray(items)).sum(-1), rtol=1e-5)
    text = jax.jit(every).lower(items).as_text()
    assert sorted(map(int, re.findall(r"sine .*tensor<(\d)x5xf32>", text)), reverse=True) == groups


def test_a_stretch_is_as_all_are_and_the_rest_is_blank_by_one_program():
    items = {"a": jax.random.normal(jax.random.key(0), (4, 5)), "b": jnp.arange(4)}

    def one(item):
        return jnp.sin(item["a"]), {"odd": item["b"] % 2 == 1, "next": item["b"] + 1}

    program = jax.jit(lambda items, start, count: batches.stretch(one, items, start, count, most=3))
    for start, count in [(0, 0), (0, 1), (0, 3), (1, 3), (2, 2), (3, 1)]:
        sines, more = program(items, start, count)
        np.testing.assert_allclose(sines[:count], np.sin(np.asarray(items["a"][start : start + count])), rtol=1e-5)
        np.testing.assert_array_equal(more["next"], [1, 2, 3, 4][start : start + count] + [0] * (3 - count))
        np.testing.assert_array_equal(more["odd"], [False, True, False, True][start : start + count] + [False] * (3 - count))
        assert len(sines) == 3 and not np.any(sines[count:])
    assert program._cache_size() == 1


def test_another_method_is_refused():
    with pytest.raises(ValueError, match=r"method must be one of \('auto', 'map', 'vmap'\), got 'loop'"):
        batches.each(lambda item: item, jnp.zeros(3), method="loop")
