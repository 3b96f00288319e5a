"""What a policy is, a network with its loss and its action behind one interface, and what policies share. Pure and unbatched.

A policy is a static, hashable object; its parameters travel beside it. All that training and evaluation know of it is in `Policy`. The
policies themselves are in `policy_goal_aware`, `policy_transporter`, `policy_cliport` and `policy_graph`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from lala_jax import losses, types
from lala_jax.models import transporter
from lala_jax.perception import topdown

SURFACE_RADIUS = 2  # cells about a point within which its height is the highest seen
MIDDLE = 0.5  # share of a face's sides within which a pick is taught, as the oracle picks


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
    drawn as the demonstrations pick, about the middle of the face. The paper's are the recorded action's, here each visit draws anew:
    over many visits of a state in which several objects may go next, they teach all of these.
    """
    key_object, key_cell = jax.random.split(key)
    state = jax.tree.map(jnp.asarray, state)  # outside jit it may be as a data set has it
    whole, middle = (losses.pick_valid(state, spec=spec, share=share) for share in (1.0, MIDDLE))
    cells = whole if multi_action else middle
    candidates = candidates & cells.any((1, 2))
    index = jax.random.categorical(key_object, jnp.where(candidates, 0.0, -1e9))
    flat = jax.random.categorical(key_cell, jnp.where(cells[index].ravel(), 0.0, -1e9))
    pick = jnp.stack([flat // spec.cols, flat % spec.cols]).astype(jnp.int32)
    label = losses.place_label(state, index, types.world_from_index(spec, pick))
    bins, places, valid = losses.place_index(label, spec=spec, rotations=rotations)
    drawn = candidates.any()
    pick_valid, pick_best = ((each & state.ready[:, None, None]).any(0) for each in (whole, middle))
    if not multi_action:
        least = jnp.argmin(jnp.where(valid, jnp.abs(jnp.mod(label.yaw + math.pi, 2 * math.pi) - math.pi), jnp.inf))
        valid = valid & (jnp.arange(valid.size) == least)
        pick_valid = pick_best = jnp.zeros_like(pick_valid).at[pick[0], pick[1]].set(drawn)
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
