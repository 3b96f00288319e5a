"""The default agent as a policy: match, place and refine, with labels of every right action. Pure and unbatched."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from lala_jax import losses, policy, types
from lala_jax.models import goal_aware
from lala_jax.perception import topdown

QUARTER_NEAR = 0.03  # metres about the best place in which its quarter turns are looked for
REFINE_DRAWS = 2  # times an object is held over its goal in a training example
FIT_SCALE = 2.0  # logits per `goal_aware.MISFIT`
PLACE_SHARE = 0.5  # what a place logit counts beside a fit when quarter turns are compared: both are log-odds of the same thing
TOKEN_TOLERANCE = 0.008  # metres a goal voxel's centre may be outside the object it shows


@dataclasses.dataclass(frozen=True)
class GoalAwarePolicy:
    """The default agent: `models.goal_aware` with multi-action, matching and refinement losses; the fields are ablation switches."""

    model: goal_aware.GoalAware
    multi_action: bool = True
    match_weight: float = 1.0
    refine_weight: float = 1.0
    refine: bool = True
    max_height: bool = False  # see only what is highest in each column
    average_turns: bool = False  # act on the mean of the logits of both maps as they are and turned by 180 degrees
    privileged: ClassVar[bool] = False
    frozen: ClassVar[Mapping[str, Any]] = {}

    @property
    def spec(self) -> types.MapSpec:
        return self.model.spec

    @property
    def _matches(self) -> bool:
        return bool(self.match_weight and self.model.matching)

    def init(self, key: jax.Array):
        """Make the parameters."""
        blank = policy.empty_map(self.spec)
        return self.model.init(key, blank, blank, jnp.zeros(2, jnp.int32))["params"]

    def loss(self, params, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap):
        """Give `(loss, metrics)` of one example: what is not yet placed teaches, without `multi_action` only the object that is drawn."""
        key_draw, key_match, key_refine = jax.random.split(key, 3)
        state = jax.tree.map(jnp.asarray, state)
        variables, model, spec = {"params": params}, self.model, self.spec
        candidates = state.ready if not self.multi_action else ~state.placed
        sample = policy.draw(key_draw, state, spec=spec, rotations=model.rotations, candidates=candidates, multi_action=self.multi_action)
        teaches = candidates if self.multi_action else candidates & (jnp.arange(len(candidates)) == sample.index)
        match, layout = self._look(variables, current, goal)
        target = model.apply(variables, match, sample.pick, method="target")
        place = self._place(variables, layout, target, sample.pick)
        terms = {
            "pick": losses.masked_cross_entropy(match.pick, sample.pick_best),
            "place": losses.place_cross_entropy(place, sample.bins, sample.cells, sample.valid),
        }
        more = {}
        if self._matches:
            terms["match"], terms["next"], more["match_right"] = self._match_losses(key_match, state, match, teaches)
        if self.refine:
            terms["refine"], terms["fit"], refined = self._refine_losses(variables, key_refine, state, match, layout, teaches)
            more |= refined
        total = terms["pick"] + terms["place"] + self.match_weight * (terms.get("match", 0.0) + terms.get("next", 0.0))
        total += self.refine_weight * (terms.get("refine", 0.0) + terms.get("fit", 0.0))
        metrics = {f"loss_{name}": value for name, value in terms.items()} | {"loss": total} | more
        return total, metrics | policy.hits(sample, match.pick, place, spec=spec, rotations=model.rotations)

    def _look(self, variables, current, goal):
        if self.max_height:
            current, goal = topdown.keep_highest(current), topdown.keep_highest(goal)
        apply = self.model.apply
        return apply(variables, current, goal, method="match"), apply(variables, current, goal, method="layout")

    def _place(self, variables, layout, target, pick) -> jax.Array:
        return jnp.asarray(self.model.apply(variables, layout, target, pick, method="place"))

    def _match_losses(self, key, state, match, teaches):
        """Match every object that `teaches` `[N]` with its voxels in the goal, and tell the voxels that may be built next."""
        spec, token = self.spec, match.token
        xy = types.world_from_cell(spec, (token[:, :2] + 0.5) * goal_aware.POOL)
        z = spec.z[0] + (token[:, 2:] + 0.5) * spec.slice_height
        centres = jnp.concatenate([xy, z], axis=-1)
        whose = losses.owner(centres, poses=state.goal, size=state.size, tolerance=TOKEN_TOLERANCE)
        whose = jnp.where(match.token_valid, whose, -1)
        cells = losses.pick_valid(state, spec=spec)
        keys = jax.random.split(key, cells.shape[0])

        def one(key, index, valid):
            flat = jax.random.categorical(key, jnp.where(valid.ravel(), 0.0, -1e9))
            picked = match.current[flat // spec.cols // goal_aware.POOL, flat % spec.cols // goal_aware.POOL]
            scores = jnp.where(match.token_valid, match.token_embedding @ picked, -1e9)
            own = whose == index
            use = valid.any() & own.any() & teaches[index]
            return use, losses.masked_cross_entropy(scores, own), own[scores.argmax()]

        use, loss, right = jax.vmap(one)(keys, jnp.arange(cells.shape[0]), cells)
        total = jnp.maximum(use.sum(), 1)
        upcoming = (whose >= 0) & (state.ready & teaches)[whose]
        return (
            (use * loss).sum() / total,
            losses.masked_cross_entropy(match.token_next, upcoming),
            jnp.where(use.any(), (use * right).sum() / total, jnp.nan),
        )

    def _refine_losses(self, variables, key, state, match, layout, teaches):
        """Hold every object that `teaches` `[N]` over its goal as it fits and a quarter turned, a little off: which fits, by how much?"""
        model, spec = self.model, self.spec
        bins = model.rotations / (2 * math.pi)
        cells = losses.pick_valid(state, spec=spec)
        which = jnp.tile(jnp.arange(cells.shape[0]), REFINE_DRAWS)
        keys = jax.random.split(key, which.shape[0])

        def one(key, index):
            valid = cells[index]
            key_pick, key_cell, key_turn, key_quarter = jax.random.split(key, 4)
            flat = jax.random.categorical(key_pick, jnp.where(valid.ravel(), 0.0, -1e9))
            pick = jnp.stack([flat // spec.cols, flat % spec.cols]).astype(jnp.int32)
            label = losses.quarter_label(state, index, types.world_from_index(spec, pick))
            pair = jnp.mod(jax.random.randint(key_quarter, (), 0, 4) + jnp.arange(2), 4)
            label = jax.tree.map(lambda leaf: leaf[pair], label)
            start = types.index_from_world(spec, label.xy) + jax.random.randint(key_cell, (2, 2), -1, 2)
            start = jnp.clip(start, 0, jnp.array([spec.rows - 1, spec.cols - 1]))
            turn_error = jax.random.uniform(key_turn, (2,), minval=-1.0, maxval=1.0)
            target = model.apply(variables, match, pick, method="target")
            offset, fit = self._refine(variables, layout, target, pick, start, label.yaw * bins + turn_error)
            wanted = jnp.concatenate([types.cell_from_world(spec, label.xy) - (start + 0.5), -turn_error[:, None]], axis=-1)
            use = valid.any() & teaches[index]
            misfit = jnp.where(label.valid, 0.0, jnp.abs(state.size[index, 0] - state.size[index, 1])) / goal_aware.MISFIT
            fit_loss = losses.masked_cross_entropy(FIT_SCALE * fit, label.valid) + losses.huber(fit + misfit).mean() / 2
            error = jnp.linalg.norm(offset[:, :2] - wanted[:, :2], axis=-1).mean() * spec.cell
            told = use & ~label.valid.all()  # a square fits either way: nothing to tell
            return use, told, losses.huber(offset - wanted).sum(-1).mean(), fit_loss, error, label.valid[fit.argmax()]

        use, told, offset_loss, fit_loss, error, right = jax.vmap(one)(keys, which)

        def mean(values, where, empty):
            return jnp.where(where.any(), jnp.where(where, values, 0.0).sum() / jnp.maximum(where.sum(), 1), empty)

        metrics = {"refine_error": mean(error, use, jnp.nan), "fit_right": mean(right, told, jnp.nan)}
        return mean(offset_loss, use, 0.0), mean(fit_loss, told, 0.0), metrics

    def _refine(self, variables, layout, target, pick, cells, turns):
        """Refine H guesses, `cells` `[H, 2]` and `turns` `[H]`: offsets `[H, 3]` and how well they fit `[H]`."""

        def one(cell, turn) -> tuple[jax.Array, jax.Array]:
            return self.model.apply(variables, layout, target, pick, cell, turn, method="refine")

        return jax.vmap(one)(cells, turns)

    def _guesses(self, logits):
        """Give the best place, and the best places near it that are turned by one to three quarters: cells `[4, 2]` and bins `[4]`."""
        rotations, rows, cols = logits.shape
        turn, row, col = policy.argmax_index(logits)
        away = jnp.maximum(jnp.abs(jnp.arange(rows) - row)[:, None], jnp.abs(jnp.arange(cols) - col)[None])
        near = jnp.where(away * self.spec.cell <= QUARTER_NEAR, 0.0, -1e9)

        def one(quarter):
            turns = jnp.mod(turn + jnp.round(quarter * rotations / 4).astype(jnp.int32) + jnp.arange(-1, 2), rotations)
            which, row, col = policy.argmax_index(logits[turns] + near)
            return jnp.stack([row, col]), turns[which]

        cells, turns = jax.vmap(one)(jnp.arange(1, 4))
        return jnp.concatenate([jnp.stack([row, col])[None], cells]), jnp.append(turn, turns)

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap) -> tuple[types.PickPlace, policy.Heatmaps]:
        """Choose an action: the best pick, its best place or that one's quarter turn that fits better, refined below cell and bin.

        Raises ValueError for maps of another spec.
        """
        for name, one in (("current", current), ("goal", goal)):
            policy.check_map(name, one, self.spec)
        variables, model, spec = {"params": params}, self.model, self.spec
        match, layout = self._look(variables, current, goal)
        pick_logits = match.pick
        if self.average_turns:
            turned, turned_layout = self._look(variables, topdown.half_turn(current), topdown.half_turn(goal))
            pick_logits = (pick_logits + turned.pick[::-1, ::-1]) / 2
        pick = jnp.stack(policy.argmax_index(pick_logits))
        target = model.apply(variables, match, pick, method="target")
        place_logits = self._place(variables, layout, target, pick)
        if self.average_turns:
            there = jnp.array([spec.rows - 1, spec.cols - 1]) - pick
            target_there = model.apply(variables, turned, there, method="target")
            place_there = self._place(variables, turned_layout, target_there, there)
            place_logits = (place_logits + place_there[:, ::-1, ::-1]) / 2
        cells, turns = self._guesses(place_logits)
        cell, turn = cells[0] + 0.5, turns[0].astype(jnp.float32)
        if self.refine:
            offset, fit = self._refine(variables, layout, target, pick, cells, turns.astype(jnp.float32))
            best = (FIT_SCALE * fit + PLACE_SHARE * place_logits[turns, cells[:, 0], cells[:, 1]]).argmax()
            offset = jnp.clip(offset[best], -2.0, 2.0)
            cell = jnp.clip(cells[best] + 0.5 + offset[:2], 0.0, jnp.array([spec.rows, spec.cols]))
            turn = turns[best] + offset[2]
        yaw = turn * (2 * math.pi / model.rotations)
        return policy.to_action(spec, current, pick, types.world_from_cell(spec, cell), yaw), policy.Heatmaps(pick_logits, place_logits)
