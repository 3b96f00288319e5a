"""The graph policy: it does what it is told, and learns towers by heart."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from test_policy import SPEC, state_of
from test_scoring import drawn_params

from lala_jax import policy_graph, types
from lala_jax.models import graph
from lala_jax.perception import transforms

GRAPH = policy_graph.GraphPolicy(model=graph.Graph(width=16, rounds=2), spec=SPEC)


@pytest.mark.parametrize("index", range(3))
def test_what_the_graph_policy_is_told_it_does(index, monkeypatch):
    """The chosen object comes to the chosen goal pose, turned no further than its symmetry asks."""
    state = state_of(5, objects=3)
    logits = jnp.zeros((3, 3)).at[index, index].set(1.0)
    monkeypatch.setattr(graph.Graph, "apply", lambda *_: logits)
    action, heat = GRAPH.act({}, None, None, state)
    motion = transforms.se2_about(action.pick[:2], action.yaw, action.place[:2] - action.pick[:2])
    moved = transforms.apply_se2(motion, state.poses[index, :2])
    np.testing.assert_allclose(moved, state.goal[index, :2], atol=1e-6)
    off = transforms.yaw_from_quat(state.poses[index, 3:]) + action.yaw - transforms.yaw_from_quat(state.goal[index, 3:])
    assert abs(transforms.wrap_angle(off, state.symmetry[index])) < 1e-5 and abs(action.yaw) <= math.pi / 4 + 1e-6
    np.testing.assert_allclose(action.pick[2], state.poses[index, 2] + 0.02, atol=1e-6)
    cell = np.unravel_index(heat.pick.argmax(), heat.pick.shape)
    np.testing.assert_array_equal(cell, types.index_from_world(SPEC, state.poses[index, :2]))


def test_the_graph_policy_learns_towers_by_heart():
    moments = [state_of(seed, objects=3, done=done) for seed in range(4) for done in range(3)]
    states = jax.tree.map(lambda *leaves: jnp.stack(leaves), *moments)
    optimizer = optax.adam(3e-3)
    params = jax.jit(GRAPH.init)(jax.random.key(0, impl="rbg"))

    def loss(params):
        each, metrics = jax.vmap(lambda state: GRAPH.loss(params, jax.random.key(0), state, None, None))(states)
        return each.mean(), metrics

    @jax.jit
    def train(params, opt):
        def step(carry, _):
            (_, metrics), grads = jax.value_and_grad(loss, has_aux=True)(carry[0])
            updates, opt = optimizer.update(grads, carry[1])
            return (optax.apply_updates(carry[0], updates), opt), jax.tree.map(jnp.mean, metrics)

        return jax.lax.scan(step, (params, opt), length=400)

    (params, _), metrics = train(params, optimizer.init(params))
    assert abs(metrics["loss"][0] - math.log(9)) < 0.3  # of nine pairs one is right
    assert metrics["loss"][-1] < 0.05 and metrics["pick_right"][-1] == metrics["place_right"][-1] == 1.0


def test_one_label_of_the_graph_policy_is_one_of_all():
    """Where two objects may go next, one drawn counts, and the loss of both right ones together is less than of either."""
    state = state_of(5, objects=3).replace(ready=jnp.array([True, True, False]))
    params = drawn_params(GRAPH)
    single = dataclasses.replace(GRAPH, multi_action=False)
    both = GRAPH.loss(params, jax.random.key(0), state, None, None)[0]
    drawn = {round(float(single.loss(params, jax.random.key(seed), state, None, None)[0]), 5) for seed in range(12)}
    assert len(drawn) == 2 and np.exp(-both) == pytest.approx(sum(np.exp(-one) for one in drawn), rel=1e-3)
