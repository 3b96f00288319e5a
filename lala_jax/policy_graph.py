"""A graph network on true poses as a policy: what perfect perception would be worth. Pure and unbatched."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lala_jax import losses, policy, types
from lala_jax.models import graph
from lala_jax.perception import transforms


@dataclasses.dataclass(frozen=True)
class GraphPolicy:
    """An upper reference for perception: `models.graph` on true poses. It does not look, and places as exactly as it is told."""

    model: graph.Graph
    spec: types.MapSpec
    multi_action: bool = True
    privileged: ClassVar[bool] = True
    frozen: ClassVar[Mapping[str, Any]] = {}

    def init(self, key: jax.Array):
        """Make the parameters."""
        pose = jnp.zeros((2, 7)).at[:, 3].set(1.0)
        size, none = jnp.ones((2, 3)), jnp.zeros(2, bool)
        blank = types.State(size, size, pose[0], pose, jnp.full(2, math.pi), pose, none, none)
        return self.model.init(key, blank)["params"]

    def loss(self, params, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap):
        """Give `(loss, metrics)` of one example: cross-entropy over all pairs, right are the objects that may go next to their goals."""
        del current, goal
        state = jax.tree.map(jnp.asarray, state)  # outside jit it may be as a data set has it
        logits = self.model.apply({"params": params}, state)
        right = jnp.diag(state.ready)
        if not self.multi_action:
            right &= jnp.arange(len(right))[:, None] == jax.random.categorical(key, jnp.where(state.ready, 0.0, -1e9))
        loss = losses.masked_cross_entropy(logits, right)
        index, where = policy.argmax_index(logits)
        told = state.ready.any()
        metrics = {"loss": loss, "pick_right": state.ready[index], "place_right": index == where}
        return loss, {name: value if name == "loss" else jnp.where(told, value, jnp.nan) for name, value in metrics.items()}

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap, truth: types.State) -> tuple[types.PickPlace, policy.Heatmaps]:
        """Choose an action: the best object by the middle of its top, to the best goal pose, by the least turn that looks right."""
        del current, goal
        truth = jax.tree.map(jnp.asarray, truth)
        logits = self.model.apply({"params": params}, truth)
        index, where = policy.argmax_index(logits)
        now, then, size = truth.poses[index], truth.goal[where], truth.size[index]
        yaw = transforms.yaw_from_quat(then[3:]) - transforms.yaw_from_quat(now[3:])
        action = types.PickPlace(
            pick=now[:3].at[2].add(size[2] / 2),
            place=then[:3].at[2].add(size[2] / 2),
            yaw=transforms.wrap_angle(yaw, truth.symmetry[index]),
        )
        return action, policy.Heatmaps(self._drawn(truth.poses, logits.max(1)), self._drawn(truth.goal, logits[index])[None])

    def _drawn(self, poses, logits):
        """Put each object's logit on the cell under it, `[rows, cols]`."""
        cell = jnp.clip(types.index_from_world(self.spec, poses[:, :2]), 0, jnp.array([self.spec.rows - 1, self.spec.cols - 1]))
        low = jnp.full((self.spec.rows, self.spec.cols), logits.min() - 10.0)
        return low.at[cell[:, 0], cell[:, 1]].max(logits)
