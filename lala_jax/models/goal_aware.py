"""The default agent's network: match what is seen now with what the goal still lacks, then correlate where it fits.

Three steps, each dense over the map (why: see the README, "The default agent"):

1. Match. Every occupied voxel of either map gets an embedding, one small network for both maps and all heights, so that an
   object looks the same at every level. A trunk over both maps at once says which goal voxels may be built next (`b`). The pick
   logits of a cell are `a(u) + logsumexp_t(b(t) + <E(u), F(t)>)` over goal voxels t: attention between the two maps' tokens.
2. Place. The picked cell's embedding selects its voxels in the goal; that mask joins the goal map in the key net, and the
   rotated crops about the pick are correlated with the key (Transporter Networks, equation 3).
3. Refine. Guesses that differ by quarter turns are laid over the goal, and a small network says for each how well it fits and how far
   it is off. A box whose sides differ by millimetres is told from its quarter turn here.

Everything is unbatched: vmap over examples.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from lala_jax import types
from lala_jax.models import convolution, correlation
from lala_jax.perception import image, topdown

POOL = 2  # map cells per token cell, each way
HEIGHT_SCALE = 5.0  # heights enter as metres times this, so that a tower is about 1
COLOR_MEAN = 0.5
FLOOR = 0.01  # metres: a goal column lower than this is bare table, nothing belongs there
FACE = 0.01  # metres: what is as high as the pick, to within this, is the face that was picked
MISFIT = 0.006  # metres of difference between two sides that count as one in a fit
SAME = 0.05  # colours (RGB distance, 0..1) closer than this are the same thing, seen with another rounding


@struct.dataclass
class Match:
    """What one look at both maps gives; R = rows // 2, C = cols // 2, M tokens of the goal, e embedding channels."""

    pick: jax.Array  # [rows, cols] pick logits
    current: jax.Array  # [R, C, e] unit embeddings of the surface now, times the temperature
    token: jax.Array  # [M, 3] int32 (row, col, slice) of the goal voxels that differ most from the current map
    token_valid: jax.Array  # [M] bool
    token_embedding: jax.Array  # [M, e] unit embeddings
    token_next: jax.Array  # [M] logits: this voxel's object may be placed next


@struct.dataclass
class Layout:
    """What the place step and the refinement read of both maps, whatever is picked."""

    now: jax.Array  # [rows, cols, 8] the surface now: colour, offset, height, how much of the cell its top face covers; 1
    goal: jax.Array  # [rows, cols, 8] the surface of the goal, and the height now
    levels: jax.Array  # [rows, cols, slices, 7] sums over the goal's points: colour, offset, number of points; and whether there are any


@struct.dataclass
class Target:
    """What in the goal is the picked object."""

    weight: jax.Array  # [R, C, slices] 0..1: how much a voxel of the goal looks like it
    level: jax.Array  # [slices] shares of the slices it is in


class ResidualBlock(nn.Module):
    """Normalise, convolve 3x3, mix 1x1, add."""

    @nn.compact
    def __call__(self, x):
        width = x.shape[-1]
        y = nn.Conv(width, (3, 3))(nn.LayerNorm()(x))
        return x + nn.Conv(width, (1, 1), kernel_init=nn.initializers.normal(1e-2))(convolution.relu(y))


class VoxelEmbedding(nn.Module):
    """Embed voxels `[..., channels]` one by one, the same way in every map and slice, to unit vectors."""

    width: int
    embed: int

    @nn.compact
    def __call__(self, x):
        x = convolution.relu(nn.Dense(self.width)(x))
        x = convolution.relu(nn.Dense(self.width)(x))
        x = nn.Dense(self.embed)(x)
        return x * jax.lax.rsqrt((x * x).sum(-1, keepdims=True) + 1e-6)


class Trunk(nn.Module):
    """Look at both maps' columns `[R, C, channels]` at two resolutions and give `[R, C, width]`."""

    width: int
    blocks: int

    @nn.compact
    def __call__(self, x):
        x = convolution.relu(nn.Conv(2 * self.width, (1, 1))(x))
        x = nn.Conv(self.width, (1, 1))(x)
        x = ResidualBlock()(x)
        low = nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(x)
        for _ in range(self.blocks):
            low = ResidualBlock()(low)
        x = x + _upsample(nn.Conv(self.width, (1, 1))(low), 2)
        return nn.LayerNorm()(ResidualBlock()(x))


class KeyNet(nn.Module):
    """A small hourglass over `[rows, cols, channels]` that gives `[rows, cols, out]`."""

    width: int
    out: int

    @nn.compact
    def __call__(self, x):
        high = convolution.relu(nn.Conv(self.width, (3, 3))(x))
        mid = convolution.relu(nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(high))
        mid = ResidualBlock()(mid)
        low = convolution.relu(nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(mid))
        low = ResidualBlock()(ResidualBlock()(low))
        mid = convolution.relu(nn.Conv(self.width, (3, 3))(mid + _upsample(low, 2)))
        high = high + _upsample(mid, 2)
        high = convolution.relu(nn.Conv(self.width, (3, 3))(high))
        return nn.Conv(self.out, (1, 1), kernel_init=nn.initializers.normal(0.1))(high)


class QueryNet(nn.Module):
    """Turn crops `[k, crop, crop, channels]` into kernels `[k, crop, crop, out]`."""

    width: int
    out: int

    @nn.compact
    def __call__(self, x):
        x = convolution.relu(nn.Conv(self.width, (3, 3))(x))
        x = convolution.relu(nn.Conv(self.width, (3, 3))(x))
        return nn.Conv(self.out, (3, 3))(x)


class RefineNet(nn.Module):
    """Say of a stack of patches `[crop, crop, channels]` the offset `(row, col, yaw)`, in cells and bins, and a logit of their fit."""

    width: int

    @nn.compact
    def __call__(self, x):
        x = convolution.relu(nn.Conv(self.width, (3, 3))(x))
        x = convolution.relu(nn.Conv(self.width, (5, 5), strides=(2, 2), conv_general_dilated=convolution.blocked)(x))
        x = convolution.relu(nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(x))
        x = convolution.relu(nn.Conv(2 * self.width, (3, 3))(x))
        x = convolution.relu(nn.Dense(4 * self.width)(x.ravel()))
        offset = nn.Dense(3, kernel_init=nn.initializers.normal(1e-3))(x)
        return offset, nn.Dense(1, kernel_init=nn.initializers.zeros)(x)[0]


class GoalAware(nn.Module):
    """The goal-aware Transporter; its fields are the ablations' switches and sizes."""

    spec: types.MapSpec
    rotations: int = 36
    crop: int = 24  # cells, must hold the largest object at any yaw
    tokens: int = 704  # goal voxels matched: a finished pallet of eight boxes shows up to 660 that are not there yet, a tower of six 200
    embed: int = 16
    trunk_width: int = 48
    trunk_blocks: int = 3
    fine_width: int = 24
    channels: int = 4  # of key and query
    matching: bool = True  # False: neither pick nor place is told which voxels of the two maps look alike

    def setup(self):
        self.voxel = VoxelEmbedding(width=32, embed=self.embed)
        self.trunk = Trunk(width=self.trunk_width, blocks=self.trunk_blocks)
        self.next_head = nn.Conv(self.spec.slices, (1, 1), kernel_init=nn.initializers.normal(1e-2))
        self.context_head = nn.Conv(16, (1, 1))
        self.pick_in = nn.Conv(self.fine_width, (3, 3))
        self.pick_mid = nn.Conv(self.fine_width, (3, 3))
        self.pick_out = nn.Conv(1, (1, 1), kernel_init=nn.initializers.normal(1e-2))
        self.key_net = KeyNet(width=self.fine_width, out=self.channels + 1)
        self.query_net = QueryNet(width=16, out=self.channels)
        self.refine_net = RefineNet(width=32)
        self.temperature = self.param("temperature", nn.initializers.constant(8.0), ())

    def match(self, current: types.TopDownMap, goal: types.TopDownMap) -> Match:
        """Look at both maps: pick logits, embeddings and the goal's tokens."""
        now_color, now_count = _pool(current)
        goal_color, goal_count = _pool(goal)
        now_seen, goal_seen = now_count > 0, goal_count > 0
        surface = self.voxel(topdown.highest(_voxel_input(now_color, now_count), now_seen)) * self.temperature
        differs = jnp.linalg.norm(goal_color - now_color, axis=-1) * now_seen
        lacks = (goal_seen & ~now_seen).astype(jnp.float32)
        context = self.trunk(_columns(now_color, now_seen, goal_color, goal_seen, lacks, differs))
        upcoming = self.next_head(context)
        built = _max_pool(goal.height) > FLOOR
        priority = goal_seen * built[..., None] * (lacks + jnp.where(differs > SAME, differs, 0.0))
        token, valid = _top_tokens(priority, self.tokens)
        at = (token[:, 0], token[:, 1], token[:, 2])
        embedding = self.voxel(_voxel_input(goal_color, goal_count)[at])
        token_next = jnp.where(valid, upcoming[at], -1e9)
        alike = jax.nn.logsumexp(surface @ embedding.T + token_next, axis=-1)
        coarse = jnp.where(valid.any(), alike, 0.0) * float(self.matching)
        pick = self._pick_fine(current, goal, context) + _upsample(coarse[..., None], POOL)[..., 0]
        return Match(pick, surface, token, valid, embedding, token_next)

    def _pick_fine(self, current, goal, context):
        x = _surface_input(current)
        lower = (goal.height - current.height)[..., None] * HEIGHT_SCALE
        x = jnp.concatenate([x, lower, _upsample(self.context_head(context), POOL)], axis=-1)
        x = convolution.relu(self.pick_in(x))
        return self.pick_out(convolution.relu(self.pick_mid(x)))[..., 0]

    def layout(self, current: types.TopDownMap, goal: types.TopDownMap) -> Layout:
        """Arrange both maps for `place` and `refine`."""
        surface = jnp.concatenate([_surface_input(goal), current.height[..., None] * HEIGHT_SCALE], axis=-1)
        seen = (goal.count > 0).astype(jnp.float32)[..., None]
        points = goal.count[..., None]
        levels = jnp.concatenate([(goal.features[..., :3] - COLOR_MEAN) * points, goal.offset * points, points, seen], axis=-1)
        on_map = jnp.ones((self.spec.rows, self.spec.cols, 1))
        return Layout(now=jnp.concatenate([_surface_input(current), on_map], axis=-1), goal=surface, levels=levels)

    def place(self, layout: Layout, target: Target, pick: jax.Array) -> jax.Array:
        """Say where the object under the cell `pick` `[2]` (row, col) goes: logits `[k, rows, cols]` over rotations and cells."""
        around, centre = self._around(layout, pick)
        crops = image.rotate_crop(around, centre, self.rotations, self.crop)
        turns = jnp.arange(self.rotations) * (2 * math.pi / self.rotations)
        key = self.key_net(self._picture(layout.goal, layout.levels, _upsample(target.weight, POOL), target))
        kernels = self.query_net(_turn_offsets(crops, turns[:, None, None]))
        scale = (self.crop * self.crop * self.channels) ** -0.5
        return correlation.correlate(key[..., :-1], kernels * scale) + key[None, ..., -1]

    def target(self, match: Match, pick: jax.Array) -> Target:
        """Find the object under the cell `pick` `[2]` in the goal.

        No gradient flows through it: the matching losses teach the embeddings.
        """
        picked = match.current[pick[0] // POOL, pick[1] // POOL]
        score = jnp.where(match.token_valid, match.token_embedding @ picked, -1e9)
        share = jax.lax.stop_gradient(jnp.exp(score - score.max())) * match.token_valid * float(self.matching)
        grid = (self.spec.rows // POOL, self.spec.cols // POOL, self.spec.slices)
        weight = jnp.zeros(grid).at[match.token[:, 0], match.token[:, 1], match.token[:, 2]].set(share)
        level = weight.max((0, 1))
        return Target(weight=weight, level=level / jnp.maximum(level.sum(), 1e-9))

    def refine(self, layout: Layout, target: Target, pick: jax.Array, cell: jax.Array, turn: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Lay what hangs from `pick` `[2]`, turned by `turn` (bins, any fraction), over the cell `[2]` of the goal.

        Gives the offset `[3]` (rows, cols, bins) from there to the true place, and how well it fits: minus the metres by which
        its sides disagree with the goal's, over `MISFIT`.
        """
        rows, cols = (cell[axis] - self.crop // 2 + jnp.arange(self.crop) for axis in (0, 1))
        weight = _window(target.weight, rows // POOL, cols // POOL)
        patch = self._picture(_window(layout.goal, rows, cols), _window(layout.levels, rows, cols), weight, target)
        around, centre = self._around(layout, pick)
        yaw = turn * (2 * math.pi / self.rotations)
        crop = _turn_offsets(image.turned_crop(around, centre, yaw, self.crop), yaw)
        return self.refine_net(jnp.concatenate([patch, crop, patch[..., -1:] - crop[..., -1:]], axis=-1))

    def _around(self, layout, pick):
        """Give the part of the present `[n, n, 10]` that any turn of the crop about `pick` shows, and the pick's place in it.

        Channels: the surface, 1 on the map, how high it is over the pick, and the share of the cell that the picked face covers.
        """
        half = math.ceil(self.crop * math.sqrt(0.5)) + 1
        around = _window(layout.now, *(pick[axis] - half + jnp.arange(2 * half + 1) for axis in (0, 1)))
        above = (around[..., 5:6] - layout.now[pick[0], pick[1], 5]) * around[..., 7:8]
        face = around[..., 6:7] * (jnp.abs(above) < FACE * HEIGHT_SCALE)
        return jnp.concatenate([around, above, face], axis=-1), (half + 0.5, half + 0.5)

    def _picture(self, goal, levels, weight, target):
        """Show the picked object's place in the goal, `[r, c, 17]`, for layers `[r, c, ...]` of the layout and weights `[r, c, slices]`.

        Channels: the goal's surface and the height now; where the object is and how high; the goal at its level: colour, offset,
        how much of a column is seen; the share of the cell that its top face covers.
        """
        fine = weight * levels[..., -1]
        height = (jnp.arange(self.spec.slices) + 0.5) * self.spec.slice_height * HEIGHT_SCALE
        level = jnp.einsum("rcsf,s->rcf", levels, target.level)
        mean = level[..., :5] / jnp.maximum(level[..., 5:6], 1e-6)
        face = topdown.highest(fine[..., None], levels[..., -1] > 0) * goal[..., 6:7]
        return jnp.concatenate([goal, fine.max(-1)[..., None], (fine * height).max(-1)[..., None], mean, level[..., 6:], face], axis=-1)

    def __call__(self, current: types.TopDownMap, goal: types.TopDownMap, pick: jax.Array):
        """Run every part once (to make the parameters): `(Match, place logits, (offset, fit))`."""
        match = self.match(current, goal)
        layout = self.layout(current, goal)
        target = self.target(match, pick)
        return match, self.place(layout, target, pick), self.refine(layout, target, pick, pick, jnp.float32(0))


def _pool(topdown_map):
    """Sum voxels over POOL x POOL cells: mean colour `[R, C, slices, 3]` and count `[R, C, slices]`."""
    rows, cols, slices, _ = topdown_map.features.shape
    total = topdown_map.features[..., :3] * topdown_map.count[..., None]
    total = jnp.concatenate([total, topdown_map.count[..., None]], axis=-1)
    total = total.reshape(rows // POOL, POOL, cols // POOL, POOL, slices, 4).sum((1, 3))
    return total[..., :3] / jnp.maximum(total[..., 3:], 1.0), total[..., 3]


def _max_pool(height):
    """Give the highest of POOL x POOL cells: `[rows, cols]` to `[R, C]`."""
    rows, cols = height.shape
    return height.reshape(rows // POOL, POOL, cols // POOL, POOL).max((1, 3))


def _voxel_input(color, count):
    """Say what is in a voxel, right above it, right below it, and around it at its height: `[R, C, slices, 16]`."""
    seen = (count > 0)[..., None].astype(jnp.float32)
    own = jnp.concatenate([(color - COLOR_MEAN) * seen, seen], axis=-1)
    above = jnp.pad(own[:, :, 1:], ((0, 0), (0, 0), (0, 1), (0, 0)))
    below = jnp.pad(own[:, :, :-1], ((0, 0), (0, 0), (1, 0), (0, 0)))
    total = jnp.concatenate([color * count[..., None], count[..., None]], axis=-1)
    total = jax.lax.reduce_window(total, 0.0, jax.lax.add, (3, 3, 1, 1), (1, 1, 1, 1), "SAME")
    near = (total[..., 3:] > 0).astype(jnp.float32)
    around = jnp.concatenate([(total[..., :3] / jnp.maximum(total[..., 3:], 1.0) - COLOR_MEAN) * near, near], axis=-1)
    return jnp.concatenate([own, above, below, around], axis=-1)


def _columns(now_color, now_seen, goal_color, goal_seen, lacks, differs):
    """Lay the slices of both maps and of their difference side by side as channels."""
    parts = [(now_color - COLOR_MEAN) * now_seen[..., None], (goal_color - COLOR_MEAN) * goal_seen[..., None]]
    flat = [part.reshape(*part.shape[:2], -1) for part in parts]
    flat += [now_seen.astype(jnp.float32), goal_seen.astype(jnp.float32), lacks, goal_seen * differs]
    return jnp.concatenate(flat, axis=-1)


def _top_tokens(priority, tokens):
    """Give the indices `[M, 3]` of the voxels of highest priority, and which of them are above zero."""
    value, flat = jax.lax.top_k(priority.ravel(), min(tokens, priority.size))
    return jnp.stack(jnp.unravel_index(flat, priority.shape), axis=-1).astype(jnp.int32), value > 0


def _surface_input(topdown_map):
    """Give the picture from above, `[rows, cols, 7]`: centred colour, offset, scaled height, share of the cell that the top face covers."""
    top = topdown.highest(topdown_map.features[..., :3] - COLOR_MEAN, topdown_map.count > 0)
    covered = jnp.prod(1 - 2 * jnp.abs(topdown_map.skin), axis=-1, keepdims=True)
    return jnp.concatenate([top, topdown_map.skin, topdown_map.height[..., None] * HEIGHT_SCALE, covered], axis=-1)


def _window(values, rows, cols):
    """Read the cells of some rows `[r]` and columns `[c]` of `[rows, cols, ...]`, zero outside: `[r, c, ...]`."""
    return values.at[rows[:, None], cols].get(mode="fill", fill_value=0, wrap_negative_indices=False)


def _turn_offsets(crops, yaw):
    """Turn the offsets (row, col) of the points in a turned crop `[..., crop, crop, 10]` as well, by `yaw` `[...]` radians."""
    row, col = crops[..., 3], crops[..., 4]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return crops.at[..., 3].set(cos * row + sin * col).at[..., 4].set(cos * col - sin * row)


def _upsample(x, factor):
    return jnp.repeat(jnp.repeat(x, factor, axis=0), factor, axis=1)
