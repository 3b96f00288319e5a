"""The graph network: equal to a loop over its nodes and edges, blind to the order of the objects and to what is not told."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_policy import state_of

from lala_jax.models import graph

NET = graph.Graph(width=6, rounds=2)
STATE = state_of(3, objects=4, done=1)


@pytest.fixture(scope="module")
def variables():
    shapes = jax.eval_shape(NET.init, jax.random.key(0), STATE)
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: rng.normal(0, 0.7, leaf.shape).astype(np.float32), shapes)


score = jax.jit(NET.apply)


def yaw(pose):
    w, x, y, z = pose[3:]
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def loop(params, state):
    """The same network a node and an edge at a time."""

    def mlp(name, x):
        def dense(part, x):
            layer = params[f"{name}_{part}"]
            return x @ layer["kernel"] + layer["bias"]

        x = dense("out", np.maximum(dense("in", x), 0))
        norm = params[f"{name}_norm"]
        return (x - x.mean()) / np.sqrt(x.var() + 1e-6) * norm["scale"] + norm["bias"]

    state = jax.tree.map(lambda leaf: np.asarray(leaf, float), state)
    things = [(pose, index, goal) for goal, poses in ((0.0, state.poses), (1.0, state.goal)) for index, pose in enumerate(poses)]
    nodes = []
    for pose, i, goal in things:
        turn = yaw(pose) * 2 * np.pi / state.symmetry[i]
        nodes.append(np.array([*state.size[i] * 10, *state.color[i], *pose[:3] * 10, np.cos(turn), np.sin(turn), goal]))
    edges = {}
    for a, (pose, i, _) in enumerate(things):
        for b, (other, j, _) in enumerate(things):
            gap = (pose[:3] - other[:3]) * 10
            apart = [np.linalg.norm(gap[:2]), np.linalg.norm(state.size[i] - state.size[j]) * 10]
            edges[a, b] = np.array([*gap, *apart, np.linalg.norm(state.color[i] - state.color[j])])
    for index in range(NET.rounds):
        edges = {(a, b): mlp(f"edges{index}", np.concatenate([edge, nodes[a], nodes[b]])) for (a, b), edge in edges.items()}
        own = [np.stack([edges[a, b] for b in range(len(nodes))]) for a in range(len(nodes))]
        nodes = [mlp(f"nodes{index}", np.concatenate([node, mine.max(0), mine.mean(0)])) for node, mine in zip(nodes, own, strict=True)]
    count = len(state.size)
    last = params["score"]
    return np.array([[(edges[a, count + b] @ last["kernel"] + last["bias"])[0] for b in range(count)] for a in range(count)])


def test_equals_a_loop(variables):
    found = score(variables, STATE)
    assert found.shape == (4, 4) and np.ptp(found) > 0.1
    np.testing.assert_allclose(found, loop(variables["params"], STATE), rtol=2e-4, atol=2e-4)


def test_the_order_of_the_objects_does_not_matter(variables):
    order = jnp.array([2, 0, 3, 1])
    shuffled = jax.tree.map(lambda leaf: leaf[order], STATE.replace(base=order)).replace(base=STATE.base)
    np.testing.assert_allclose(score(variables, shuffled), score(variables, STATE)[order][:, order], atol=1e-4)


def test_what_is_placed_is_not_told(variables):
    other = STATE.replace(placed=~STATE.placed, ready=~STATE.ready, base=STATE.base + 1)
    np.testing.assert_array_equal(score(variables, other), score(variables, STATE))


def test_a_turn_that_looks_alike_changes_nothing(variables):
    half = jnp.array([np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)])  # a quarter turn of a cube
    w, z = half[0], half[3]
    poses = STATE.poses
    turned = poses.at[:, 3].set(w * poses[:, 3] - z * poses[:, 6]).at[:, 6].set(w * poses[:, 6] + z * poses[:, 3])
    assert np.abs(turned - poses).max() > 0.1
    np.testing.assert_allclose(score(variables, STATE.replace(poses=turned)), score(variables, STATE), atol=1e-4)


def test_the_largest_hands_its_gradient_to_one_entry():
    """Also where several are as large: then to the first of them; of numbers that differ, all is as `jnp.max` has it."""
    x, w = np.random.default_rng(0).normal(size=(3, 5, 4)).astype(np.float32), jnp.arange(12.0).reshape(3, 4)
    found, expected = (jax.value_and_grad(lambda x, of=of: (of(x, 1) * w).sum())(x) for of in (graph.largest, jnp.max))
    jax.tree.map(np.testing.assert_allclose, found, expected)
    slopes = jax.grad(lambda x: (graph.largest(x, 1) * w).sum())(np.zeros_like(x))
    np.testing.assert_array_equal(slopes[:, 0], w)
    assert not slopes[:, 1:].any()
