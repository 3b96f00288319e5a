"""The optimiser: the learning rate over the steps, and what clipping and weight decay do, in numbers worked out by hand."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from lala_jax import optim

CONFIG = {"schedule": "constant", "learning_rate": 0.1, "warmup": 0, "weight_decay": 0.0, "clip": 1.0}


def rates(name, *steps, warmup, total=110):
    found = optim.schedule(name, peak=2.0, warmup=warmup, steps=total)
    return [float(found(step)) for step in steps]


def first_update(gradient, value=1.0, **changes):
    """The update of a parameter by one gradient."""
    optimizer = optim.create({**CONFIG, **changes}, steps=10)
    params = {"w": jnp.full(4, value)}
    updates, _ = optimizer.update({"w": jnp.asarray(gradient, jnp.float32)}, optimizer.init(params), params)
    return np.asarray(updates["w"])


def test_rates_rise_and_stay_or_fall():
    np.testing.assert_allclose(rates("constant", 0, 5, 10, 60, 900, warmup=10), [0, 1, 2, 2, 2], rtol=1e-6)
    half = 0.02 + (2 - 0.02) * (1 + math.cos(math.pi / 2)) / 2
    np.testing.assert_allclose(rates("cosine", 0, 5, 10, 60, 110, 900, warmup=10), [0, 1, 2, half, 0.02, 0.02], rtol=1e-6)


@pytest.mark.parametrize("name", optim.SCHEDULES)
def test_without_a_warm_up_the_first_step_counts(name):
    assert rates(name, 0, warmup=0) == [2.0]
    assert (first_update(np.ones(4), schedule=name) != 0).all()


def test_what_is_too_short_for_its_warm_up_still_has_rates():
    assert rates("cosine", 0, 10, 12, warmup=10, total=3) == pytest.approx([0, 2, 0.02])


def test_other_schedules_are_refused():
    with pytest.raises(ValueError, match=r"optim.schedule must be one of \('cosine', 'constant'\), got 'linear'"):
        optim.schedule("linear", peak=1.0, warmup=1, steps=2)


def test_gradients_are_clipped_by_their_global_norm():
    """Adam's first step hides the scale of a gradient, unless that is about its epsilon of 1e-8."""
    tiny = np.array([3e-8, 4e-8, 0, 0])
    np.testing.assert_allclose(first_update(tiny), -0.1 * tiny / (tiny + 1e-8), rtol=1e-4)
    np.testing.assert_allclose(first_update(tiny, clip=1e-8), -0.1 * (tiny / 5) / (tiny / 5 + 1e-8), rtol=1e-4)


def test_weights_decay_in_proportion_to_the_rate():
    np.testing.assert_allclose(first_update(np.zeros(4), value=3.0, weight_decay=0.5), np.full(4, -0.1 * 0.5 * 3.0), rtol=1e-6)
