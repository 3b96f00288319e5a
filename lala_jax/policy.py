"""Policies: a network, its loss and its action, behind one interface for training and closed loop. Pure and unbatched.

A policy is a static, hashable object; its parameters travel beside it. All that training and evaluation know of it is in `Policy`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from lala_jax import losses, types
from lala_jax.models import goal_aware, graph, transporter
from lala_jax.perception import topdown, transforms

SURFACE_RADIUS = 2  # cells about a point within which its height is the highest seen
MIDDLE = 0.5  # share of a face's sides within which a pick is taught, as the oracle picks
QUARTER_NEAR = 0.03  # metres about the best place in which its quarter turns are looked for
REFINE_DRAWS = 2  # times an object is held over its goal in a training example
FIT_SCALE = 2.0  # logits per `goal_aware.MISFIT`
PLACE_SHARE = 0.5  # what a place logit counts beside a fit when quarter turns are compared: both are log-odds of the same thing
TOKEN_TOLERANCE = 0.008  # metres a goal voxel's centre may be outside the object it shows


class Policy(Protocol):
    """What training and evaluation know of a policy; `params` are those of `init`, together with what is `frozen`."""

    privileged: ClassVar[bool]  # `act` is told the true state, too

    @property
    def frozen(self) -> Mapping[str, Any]:
        """What `params` must hold besides: neither trained nor stored with them."""
        ...

    def init(self, key: jax.Array) -> Any:
        """Make the parameters, a dict."""
        ...

    def loss(
        self, params: Any, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Give `(loss, metrics)` of one example; the maps are of the policy's `spec`."""
        ...

    @property
    def act(self) -> Callable[..., tuple[types.PickPlace, Heatmaps]]:
        """Choose an action: `act(params, current, goal)`, and where it is `privileged` `act(params, current, goal, truth)`.

        Of two unbatched maps of the policy's `spec`; the action's leaves are `[3]`, `[3]` and `[]`, in the robot's frame.
        """
        ...


@struct.dataclass
class Heatmaps:
    """What a policy thought, for pictures and diagnoses."""

    pick: jax.Array  # [rows, cols] logits
    place: jax.Array  # [k, rows, cols] logits


def empty_map(spec: types.MapSpec, *, features: int = 3, surface: int = 0) -> types.TopDownMap:
    """Give a map in which nothing was seen."""
    grid = (spec.rows, spec.cols, spec.slices)
    return types.TopDownMap(
        features=jnp.zeros((*grid, features)),
        count=jnp.zeros(grid),
        offset=jnp.zeros((*grid, 2)),
        height=jnp.zeros(grid[:2]),
        skin=jnp.zeros((*grid[:2], 2)),
        surface=jnp.zeros((*grid[:2], surface)) if surface else None,
    )


def check_map(name: str, seen: types.TopDownMap, spec: types.MapSpec) -> None:
    """Raise ValueError unless a map is of a spec's sizes."""
    wanted = spec.rows, spec.cols, spec.slices
    if seen.count.shape != wanted:
        raise ValueError(f"{name} must be one map of rows, cols and slices {wanted}, made with spec={spec}, got {seen.count.shape}")


def argmax_index(logits: jax.Array) -> tuple[jax.Array, ...]:
    """Give the int32 index of the largest entry along every axis, the first of equals and of NaNs, as `jnp.argmax` does.

    That one goes entry by entry on a CPU; a maximum and a minimum take it a quarter of the time.
    """
    flat = logits.ravel()
    first = jnp.where((flat == flat.max()) | jnp.isnan(flat), jnp.arange(flat.size), flat.size).min()
    return tuple(i.astype(jnp.int32) for i in jnp.unravel_index(first, logits.shape))


def surface_height(current: types.TopDownMap, cell: jax.Array) -> jax.Array:
    """Give the height `[]` in metres above z_min of the highest point seen within `SURFACE_RADIUS` cells of `cell` `[2]`."""
    size = 2 * SURFACE_RADIUS + 1
    padded = jnp.pad(current.height, SURFACE_RADIUS)
    return jax.lax.dynamic_slice(padded, (cell[0], cell[1]), (size, size)).max()


def to_action(spec: types.MapSpec, current: types.TopDownMap, pick: jax.Array, place_xy: jax.Array, yaw: jax.Array) -> types.PickPlace:
    """Pick at the integer cell `pick` `[2]` and place it at `place_xy` `[2]` (metres), at the heights seen there, turned by `yaw`."""
    pick_xy = types.world_from_index(spec, pick)
    place_cell = jnp.clip(types.index_from_world(spec, place_xy), 0, jnp.array([spec.rows - 1, spec.cols - 1]))
    return types.PickPlace(
        pick=jnp.append(pick_xy, spec.z[0] + surface_height(current, pick)),
        place=jnp.append(place_xy, spec.z[0] + surface_height(current, place_cell)),
        yaw=jnp.mod(yaw + math.pi, 2 * math.pi) - math.pi,
    )


@struct.dataclass
class Sample:
    """What one training example asks: a pick drawn among the right ones and where it may go."""

    pick_valid: jax.Array  # [rows, cols] bool: every right pick now
    pick_best: jax.Array  # [rows, cols] bool: those around the middle of a face, what a pick is taught
    index: jax.Array  # [] the object of the drawn pick
    pick: jax.Array  # [2] int32 the drawn cell
    drawn: jax.Array  # [] bool: there was something to draw
    place: losses.PlaceLabel
    bins: jax.Array  # [S]
    cells: jax.Array  # [S, 2]
    valid: jax.Array  # [S]


def draw(key: jax.Array, state: types.State, *, spec: types.MapSpec, rotations: int, candidates: jax.Array, multi_action: bool) -> Sample:
    """Draw an object among `candidates` `[N]` bool, a cell of its visible top face, and say where it goes.

    Without `multi_action` the drawn pick and its place of least turn are the only right ones (the paper's one-hot labels); it is then
    drawn as the demonstrations pick, about the middle of the face.
    """
    key_object, key_cell = jax.random.split(key)
    whole, middle = (losses.pick_valid(state, spec=spec, share=share) for share in (1.0, MIDDLE))
    cells = whole if multi_action else middle
    candidates = candidates & cells.any((1, 2))
    index = jax.random.categorical(key_object, jnp.where(candidates, 0.0, -1e9))
    flat = jax.random.categorical(key_cell, jnp.where(cells[index].ravel(), 0.0, -1e9))
    pick = jnp.stack([flat // spec.cols, flat % spec.cols]).astype(jnp.int32)
    label = losses.place_label(state, index, types.world_from_index(spec, pick))
    bins, places, valid = losses.place_index(label, spec=spec, rotations=rotations)
    pick_valid, pick_best = ((each & state.ready[:, None, None]).any(0) for each in (whole, middle))
    if not multi_action:
        least = jnp.argmin(jnp.where(valid, jnp.abs(jnp.mod(label.yaw + math.pi, 2 * math.pi) - math.pi), jnp.inf))
        valid = valid & (jnp.arange(valid.size) == least)
        pick_valid = pick_best = jnp.zeros_like(pick_valid).at[pick[0], pick[1]].set(True)
    drawn = candidates.any()
    return Sample(pick_valid, pick_best, index, pick, drawn, label, bins, places, valid & drawn)


def hits(sample: Sample, pick_logits: jax.Array, place_logits: jax.Array, *, spec: types.MapSpec, rotations: int) -> dict[str, jax.Array]:
    """Score the arg maxima: share of right picks, and of places within 1 cm and 15 deg of a right one."""
    row, col = argmax_index(pick_logits)
    turn, place_row, place_col = argmax_index(place_logits)
    xy = types.world_from_index(spec, jnp.stack([place_row, place_col]))
    near = jnp.linalg.norm(sample.place.xy - xy, axis=-1) < 0.01
    off = jnp.mod(sample.place.yaw - turn * (2 * math.pi / rotations) + math.pi, 2 * math.pi) - math.pi
    right = sample.place.valid & near & (jnp.abs(off) < math.radians(15))
    return {
        "pick_right": jnp.where(sample.pick_valid.any(), sample.pick_valid[row, col], jnp.nan),
        "place_right": jnp.where(sample.drawn, right.any(), jnp.nan),
        "place_near": jnp.where(sample.drawn, (near & sample.place.valid).any(), jnp.nan),
    }


def picture(*maps: types.TopDownMap, max_height: bool) -> jax.Array:
    """Give a map `[rows, cols, c]` as the paper's networks take it: what is highest, or without `max_height` all slices as channels.

    Of several maps it is that of their geometric mean, channel by channel: what a product of them knows, in the units of one map (colours
    in 0..1, heights in metres, features of a ReLU), so that the table of them all looks as the table of one.
    """

    def mean(of: Callable[[types.TopDownMap], jax.Array]) -> jax.Array:
        values = [of(one) for one in maps]
        return values[0] if len(maps) == 1 else jnp.maximum(jnp.prod(jnp.stack(values), axis=0), 0.0) ** (1 / len(maps))

    if max_height:
        return transporter.normalise(mean(topdown.max_height))
    seen = jnp.stack([one.count > 0 for one in maps]).all(0)
    slices = transporter.normalise_slices(mean(lambda one: one.features[..., :3]), seen, mean(lambda one: one.height))
    return slices if maps[0].surface is None else jnp.concatenate([slices, mean(lambda one: one.surface)], axis=-1)


def imitation(sample: Sample, logits: Heatmaps, *, spec: types.MapSpec) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Give `(loss, metrics)` of one example: cross-entropy of pick and place (eqs. 4-6)."""
    pick = losses.masked_cross_entropy(logits.pick, sample.pick_best & sample.drawn)
    place = losses.place_cross_entropy(logits.place, sample.bins, sample.cells, sample.valid)
    metrics = {"loss_pick": pick, "loss_place": place, "loss": pick + place}
    return pick + place, metrics | hits(sample, logits.pick, logits.place, spec=spec, rotations=len(logits.place))


def best_place(current: types.TopDownMap, pick: jax.Array, place: jax.Array, *, spec: types.MapSpec) -> types.PickPlace:
    """Place what is at the integer cell `pick` `[2]` at the best cell and bin of `place` `[k, rows, cols]` (eqs. 2 and 3)."""
    turn, row, col = argmax_index(place)
    xy = types.world_from_index(spec, jnp.stack([row, col]))
    return to_action(spec, current, pick.astype(jnp.int32), xy, turn * (2 * math.pi / len(place)))


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
        blank = empty_map(self.spec)
        return self.model.init(key, blank, blank, jnp.zeros(2, jnp.int32))["params"]

    def loss(self, params, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap):
        """Give `(loss, metrics)` of one example; any object that is not yet placed may teach the place and the match."""
        key_draw, key_match, key_refine = jax.random.split(key, 3)
        variables, model, spec = {"params": params}, self.model, self.spec
        candidates = state.ready if not self.multi_action else ~state.placed
        sample = draw(key_draw, state, spec=spec, rotations=model.rotations, candidates=candidates, multi_action=self.multi_action)
        match, layout = self._look(variables, current, goal)
        target = model.apply(variables, match, sample.pick, method="target")
        place = self._place(variables, layout, target, sample.pick)
        terms = {
            "pick": losses.masked_cross_entropy(match.pick, sample.pick_best),
            "place": losses.place_cross_entropy(place, sample.bins, sample.cells, sample.valid),
        }
        more = {}
        if self._matches:
            terms["match"], terms["next"], more["match_right"] = self._match_losses(key_match, state, match)
        if self.refine:
            terms["refine"], terms["fit"], refined = self._refine_losses(variables, key_refine, state, match, layout)
            more |= refined
        total = terms["pick"] + terms["place"] + self.match_weight * (terms.get("match", 0.0) + terms.get("next", 0.0))
        total += self.refine_weight * (terms.get("refine", 0.0) + terms.get("fit", 0.0))
        metrics = {f"loss_{name}": value for name, value in terms.items()} | {"loss": total} | more
        return total, metrics | hits(sample, match.pick, place, spec=spec, rotations=model.rotations)

    def _look(self, variables, current, goal):
        if self.max_height:
            current, goal = topdown.keep_highest(current), topdown.keep_highest(goal)
        apply = self.model.apply
        return apply(variables, current, goal, method="match"), apply(variables, current, goal, method="layout")

    def _place(self, variables, layout, target, pick) -> jax.Array:
        return jnp.asarray(self.model.apply(variables, layout, target, pick, method="place"))

    def _match_losses(self, key, state, match):
        """Match every unplaced object with its voxels in the goal, and tell the voxels that may be built next."""
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
            use = valid.any() & own.any() & ~state.placed[index]
            return use, losses.masked_cross_entropy(scores, own), own[scores.argmax()]

        use, loss, right = jax.vmap(one)(keys, jnp.arange(cells.shape[0]), cells)
        total = jnp.maximum(use.sum(), 1)
        upcoming = (whose >= 0) & state.ready[whose]
        return (
            (use * loss).sum() / total,
            losses.masked_cross_entropy(match.token_next, upcoming),
            jnp.where(use.any(), (use * right).sum() / total, jnp.nan),
        )

    def _refine_losses(self, variables, key, state, match, layout):
        """Hold every unplaced object over its goal as it fits and a quarter turned, a little off: which fits, and how far off are they?"""
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
            use = valid.any() & ~state.placed[index]
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
        turn, row, col = argmax_index(logits)
        away = jnp.maximum(jnp.abs(jnp.arange(rows) - row)[:, None], jnp.abs(jnp.arange(cols) - col)[None])
        near = jnp.where(away * self.spec.cell <= QUARTER_NEAR, 0.0, -1e9)

        def one(quarter):
            turns = jnp.mod(turn + jnp.round(quarter * rotations / 4).astype(jnp.int32) + jnp.arange(-1, 2), rotations)
            which, row, col = argmax_index(logits[turns] + near)
            return jnp.stack([row, col]), turns[which]

        cells, turns = jax.vmap(one)(jnp.arange(1, 4))
        return jnp.concatenate([jnp.stack([row, col])[None], cells]), jnp.append(turn, turns)

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap) -> tuple[types.PickPlace, Heatmaps]:
        """Choose an action: the best pick, its best place or that one's quarter turn that fits better, refined below cell and bin.

        Raises ValueError for maps of another spec.
        """
        for name, one in (("current", current), ("goal", goal)):
            check_map(name, one, self.spec)
        variables, model, spec = {"params": params}, self.model, self.spec
        match, layout = self._look(variables, current, goal)
        pick_logits = match.pick
        if self.average_turns:
            turned, turned_layout = self._look(variables, topdown.half_turn(current), topdown.half_turn(goal))
            pick_logits = (pick_logits + turned.pick[::-1, ::-1]) / 2
        pick = jnp.stack(argmax_index(pick_logits))
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
        return to_action(spec, current, pick, types.world_from_cell(spec, cell), yaw), Heatmaps(pick_logits, place_logits)


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
        blank = picture(empty_map(self.spec, surface=self.surface), max_height=self.max_height)
        return self.model.init(key, blank, blank, jnp.zeros(2, jnp.int32), blank)["params"]

    def _look(self, params, current, goal, pick=None):
        seen = [picture(*maps, max_height=self.max_height) for maps in ((current,), (goal,), (current, goal))]
        logits, intermediates = self.model.apply({"params": params}, *seen[:2], pick, seen[2])
        return Heatmaps(logits["pick"], logits["place"]), intermediates["pick_cell"]

    def loss(self, params, key: jax.Array, state: types.State, current: types.TopDownMap, goal: types.TopDownMap):
        """Give `(loss, metrics)` of one example, as `imitation` does."""
        rotations = self.model.yaw_bins
        sample = draw(key, state, spec=self.spec, rotations=rotations, candidates=state.ready, multi_action=self.multi_action)
        logits, _ = self._look(params, current, goal, sample.pick)
        return imitation(sample, logits, spec=self.spec)

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap) -> tuple[types.PickPlace, Heatmaps]:
        """Choose an action: the best pick cell and its best place cell and bin (eqs. 2 and 3)."""
        logits, pick = self._look(params, current, goal)
        return best_place(current, pick, logits.place, spec=self.spec), logits


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
        logits = self.model.apply({"params": params}, state)
        right = jnp.diag(state.ready)
        if not self.multi_action:
            right &= jnp.arange(len(right))[:, None] == jax.random.categorical(key, jnp.where(state.ready, 0.0, -1e9))
        loss = losses.masked_cross_entropy(logits, right)
        index, where = argmax_index(logits)
        told = state.ready.any()
        metrics = {"loss": loss, "pick_right": state.ready[index], "place_right": index == where}
        return loss, {name: value if name == "loss" else jnp.where(told, value, jnp.nan) for name, value in metrics.items()}

    def act(self, params, current: types.TopDownMap, goal: types.TopDownMap, truth: types.State) -> tuple[types.PickPlace, Heatmaps]:
        """Choose an action: the best object by the middle of its top, to the best goal pose, by the least turn that looks right."""
        del current, goal
        logits = self.model.apply({"params": params}, truth)
        index, where = argmax_index(logits)
        now, then, size = truth.poses[index], truth.goal[where], truth.size[index]
        yaw = transforms.yaw_from_quat(then[3:]) - transforms.yaw_from_quat(now[3:])
        action = types.PickPlace(
            pick=now[:3].at[2].add(size[2] / 2),
            place=then[:3].at[2].add(size[2] / 2),
            yaw=transforms.wrap_angle(yaw, truth.symmetry[index]),
        )
        return action, Heatmaps(self._drawn(truth.poses, logits.max(1)), self._drawn(truth.goal, logits[index])[None])

    def _drawn(self, poses, logits):
        """Put each object's logit on the cell under it, `[rows, cols]`."""
        cell = jnp.clip(types.index_from_world(self.spec, poses[:, :2]), 0, jnp.array([self.spec.rows - 1, self.spec.cols - 1]))
        low = jnp.full((self.spec.rows, self.spec.cols), logits.min() - 10.0)
        return low.at[cell[:, 0], cell[:, 1]].max(logits)
