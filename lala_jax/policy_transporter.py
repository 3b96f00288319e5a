"""The paper's agents and their rivals as a policy. Pure and unbatched."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lala_jax import policy, types
from lala_jax.models import transporter


@dataclasses.dataclass(frozen=True)
class TransporterPolicy:
    """The paper's agents and their rivals: `models.transporter`, one-hot labels unless `multi_action`.

    They see max-height maps, in which a finished tower is its top block; without `max_height`, all slices as channels.
    """

    model: transporter.Transporter
    spec: types.MapSpec
    multi_action: bool = False
    max_height: bool = True
    surface: int = 0  # channels of the map's features of the surface
    privileged: ClassVar[bool] = False
    frozen: ClassVar[Mapping[str, Any]] = {}

    def init(self, key: jax.Array):
        """Make the parameters."""
        blank = policy.picture(policy.empty_map(self.spec, surface=self.surface), max_height=self.max_height)
        return self.model.init(key, blank, blank, jnp.zeros(2, jnp.int32), blank)["params"]

    def _look(self, params, current, goal, pick=None):
        seen = [policy.picture(*maps, max_height=self.max_height) for maps in ((current,), (goal,), (current, goal))]
        logits, intermediates = self.model.apply({"params": params}, *seen[:2], pick, seen[2])
        return policy.Heatmaps(logits["pick"], logits["place"]), intermediates["pick_cell"]

    def loss(self, params, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap):
        """Give `(loss, metrics)` of one example, as `policy.imitation` does."""
        rotations = self.model.yaw_bins
        sample = policy.draw(key, state, spec=self.spec, rotations=rotations, candidates=state.ready, multi_action=self.multi_action)
        logits, _ = self._look(params, current, goal, sample.pick)
        return policy.imitation(sample, logits, spec=self.spec)

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap) -> tuple[types.PickPlace, policy.Heatmaps]:
        """Choose an action: the best pick cell and its best place cell and bin (eqs. 2 and 3)."""
        logits, pick = self._look(params, current, goal)
        return policy.best_place(current, pick, logits.place, spec=self.spec), logits
