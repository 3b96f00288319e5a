"""A graph network on true poses: which object goes to which place of the goal, and which of them next.

What the paper's related work does instead of looking: objects and goal poses are nodes, all pairs are edges. As in Graph Networks
(Battaglia et al., Relational inductive biases, deep learning, and graph networks, 2018) a round updates edges from their ends, then nodes
from their edges; weights are shared by all nodes and edges, so that the order of the objects does not matter.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from lala_jax import types
from lala_jax.models import convolution
from lala_jax.perception import transforms

LENGTH = 0.1  # metres that enter as 1


class Graph(nn.Module):
    """Score every (object, goal pose) pair: which goes where, next."""

    width: int = 64
    rounds: int = 3

    @nn.compact
    def __call__(self, state: types.State) -> jax.Array:
        """Give logits `[N, N]` of moving object i to the goal pose of object j, for one softmax over all pairs.

        Only `size`, `color`, `poses`, `goal` and `symmetry` are read. A goal pose comes with the size and colour of its object, as a
        picture of the goal would show them; that it belongs to the object of its own index must be found out from these.
        """
        nodes, pairs = _nodes(state), _pairs(state)
        for index in range(self.rounds):
            count = len(nodes)
            ends = [jnp.broadcast_to(nodes[:, None], (count, count, nodes.shape[-1])), jnp.broadcast_to(nodes, (count, *nodes.shape))]
            pairs = self._mlp(jnp.concatenate([pairs, *ends], axis=-1), f"edges{index}")
            nodes = self._mlp(jnp.concatenate([nodes, largest(pairs, 1), pairs.mean(1)], axis=-1), f"nodes{index}")
        objects = len(state.size)
        return nn.Dense(1, kernel_init=nn.initializers.normal(1e-2), name="score")(pairs[:objects, objects:])[..., 0]

    def _mlp(self, x, name):
        x = convolution.relu(nn.Dense(self.width, name=f"{name}_in")(x))
        return nn.LayerNorm(name=f"{name}_norm")(nn.Dense(self.width, name=f"{name}_out")(x))


def largest(x: jax.Array, axis: int) -> jax.Array:
    """Give the largest along an axis, with the gradient to the first that is.

    That of `jnp.max` goes to those that equal the result, divided by how many these are. Where XLA computes `x` once more for that, and
    rounds it otherwise, there is none, and 0 / 0.
    """
    return jnp.take_along_axis(x, jnp.argmax(x, axis, keepdims=True), axis).squeeze(axis)


def _nodes(state):
    """Describe the objects where they are, then where they belong: `[2 N, 12]`."""
    own = jnp.concatenate([state.size / LENGTH, state.color], axis=-1)

    def one(poses, goal):
        yaw = transforms.yaw_from_quat(poses[:, 3:])[:, None] * (2 * math.pi / state.symmetry[:, None])
        place = [poses[:, :3] / LENGTH, jnp.cos(yaw), jnp.sin(yaw), jnp.full((len(poses), 1), goal)]
        return jnp.concatenate([own, *place], axis=-1)

    return jnp.concatenate([one(state.poses, 0.0), one(state.goal, 1.0)])


def _pairs(state):
    """Say how each node differs from each other in place, size and colour: `[2 N, 2 N, 6]`."""
    place, size, color = (
        jnp.concatenate(both) for both in ((state.poses[:, :3], state.goal[:, :3]), (state.size,) * 2, (state.color,) * 2)
    )
    gap = (place[:, None] - place) / LENGTH
    apart = [jnp.linalg.norm(gap[..., :2], axis=-1), *(jnp.linalg.norm(x[:, None] - x, axis=-1) for x in (size / LENGTH, color))]
    return jnp.concatenate([gap, jnp.stack(apart, axis=-1)], axis=-1)
