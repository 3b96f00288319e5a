"""The default agent's network: match what is seen now with what the goal still lacks, then correlate where it fits.

Three steps, each dense over the map (see the README's design notes for why):

1. Match. Every occupied voxel of either map gets an embedding, one small network for both maps and all heights, so that an
   object looks the same at every level. A trunk over both maps at once says which goal voxels may be built next (`b`). The pick
   logits of a cell are `a(u) + logsumexp_t(b(t) + <E(u), F(t)>)` over goal voxels t: attention between the two maps' tokens.
2. Place. The picked cell's embedding selects its voxels in the goal; that mask joins the goal map in the key net, and the
   rotated crops about the pick are correlated with the key (Transporter Networks, equation 3).
3. Refine. The offset from the best cell and bin to the true place is regressed from the two patches laid over each other.

Everything is unbatched: vmap over examples.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from lala_jax import types
from lala_jax.models import correlation
from lala_jax.perception import image, topdown

POOL = 2  # map cells per token cell, each way
HEIGHT_SCALE = 5.0  # heights enter as metres times this, so that a tower is about 1
COLOR_MEAN = 0.5
FLOOR = 0.01  # metres: a goal column lower than this is bare table, nothing belongs there
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
class Place:
    """What one pick gives: logits over k rotations of every cell, and what the refinement reads."""

    logits: jax.Array  # [k, rows, cols]
    key_input: jax.Array  # [rows, cols, channels]
    crops: jax.Array  # [k, crop, crop, channels]


class ResidualBlock(nn.Module):
    """Normalise, convolve 3x3, mix 1x1, add."""

    @nn.compact
    def __call__(self, x):
        width = x.shape[-1]
        y = nn.Conv(width, (3, 3))(nn.LayerNorm()(x))
        return x + nn.Conv(width, (1, 1), kernel_init=nn.initializers.normal(1e-2))(nn.relu(y))


class VoxelEmbedding(nn.Module):
    """Embed voxels `[..., channels]` one by one, the same way in every map and slice, to unit vectors."""

    width: int
    embed: int

    @nn.compact
    def __call__(self, x):
        x = nn.relu(nn.Dense(self.width)(x))
        x = nn.relu(nn.Dense(self.width)(x))
        x = nn.Dense(self.embed)(x)
        return x * jax.lax.rsqrt((x * x).sum(-1, keepdims=True) + 1e-6)


class Trunk(nn.Module):
    """Look at both maps' columns `[R, C, channels]` at two resolutions and give `[R, C, width]`."""

    width: int
    blocks: int

    @nn.compact
    def __call__(self, x):
        x = nn.relu(nn.Conv(2 * self.width, (1, 1))(x))
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
        high = nn.relu(nn.Conv(self.width, (3, 3))(x))
        mid = nn.relu(nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(high))
        mid = ResidualBlock()(mid)
        low = nn.relu(nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(mid))
        low = ResidualBlock()(ResidualBlock()(low))
        mid = nn.relu(nn.Conv(self.width, (3, 3))(mid + _upsample(low, 2)))
        high = high + _upsample(mid, 2)
        high = nn.relu(nn.Conv(self.width, (3, 3))(high))
        return nn.Conv(self.out, (1, 1), kernel_init=nn.initializers.normal(0.1))(high)


class QueryNet(nn.Module):
    """Turn crops `[k, crop, crop, channels]` into kernels `[k, crop, crop, out]`."""

    width: int
    out: int

    @nn.compact
    def __call__(self, x):
        x = nn.relu(nn.Conv(self.width, (3, 3))(x))
        x = nn.relu(nn.Conv(self.width, (3, 3))(x))
        return nn.Conv(self.out, (3, 3))(x)


class RefineNet(nn.Module):
    """Regress `(row, col, yaw)` offsets, in cells and bins, from a stack of patches `[crop, crop, channels]`."""

    width: int

    @nn.compact
    def __call__(self, x):
        x = nn.relu(nn.Conv(self.width, (5, 5), strides=(2, 2))(x))
        x = nn.relu(nn.Conv(2 * self.width, (3, 3), strides=(2, 2))(x))
        x = nn.relu(nn.Conv(2 * self.width, (3, 3))(x))
        x = nn.relu(nn.Dense(4 * self.width)(x.ravel()))
        return nn.Dense(3, kernel_init=nn.initializers.normal(1e-3))(x)


class GoalAware(nn.Module):
    """The goal-aware Transporter; its fields are the ablations' switches and sizes."""

    spec: types.MapSpec
    rotations: int = 36
    crop: int = 24  # cells, must hold the largest object at any yaw
    tokens: int = 704  # goal voxels matched: a finished pallet of eight boxes shows about 520 that differ, a tower of six 300
    embed: int = 16
    trunk_width: int = 48
    trunk_blocks: int = 3
    fine_width: int = 24
    channels: int = 4  # of key and query

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
        self.refine_net = RefineNet(width=24)
        self.temperature = self.param("temperature", nn.initializers.constant(8.0), ())

    def match(self, current: types.TopDownMap, goal: types.TopDownMap) -> Match:
        """Look at both maps: pick logits, embeddings and the goal's tokens."""
        now_color, now_count = _pool(current)
        goal_color, goal_count = _pool(goal)
        now_seen, goal_seen = now_count > 0, goal_count > 0
        surface = self.voxel(_highest(_voxel_input(now_color, now_count), now_seen)) * self.temperature
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
        coarse = jnp.where(valid.any(), jax.nn.logsumexp(surface @ embedding.T + token_next, axis=-1), 0.0)
        pick = self._pick_fine(current, goal, context) + _upsample(coarse[..., None], POOL)[..., 0]
        return Match(pick, surface, token, valid, embedding, token_next)

    def _pick_fine(self, current, goal, context):
        x = _surface_input(current)
        lower = (goal.height - current.height)[..., None] * HEIGHT_SCALE
        x = jnp.concatenate([x, lower, _upsample(self.context_head(context), POOL)], axis=-1)
        x = nn.relu(self.pick_in(x))
        return self.pick_out(nn.relu(self.pick_mid(x)))[..., 0]

    def place(self, current: types.TopDownMap, goal: types.TopDownMap, match: Match, pick: jax.Array) -> Place:
        """Say where the object under the cell `pick` `[2]` (row, col) goes, for every rotation and cell."""
        target = self.target_mask(goal, match, pick)
        key_input = jnp.concatenate([_surface_input(goal), current.height[..., None] * HEIGHT_SCALE, target], axis=-1)
        surface = _surface_input(current)
        above = surface[..., 3:] - surface[pick[0], pick[1], 3]
        about = jnp.concatenate([surface, above, jnp.ones_like(above)], axis=-1)
        crops = image.rotate_crop(about, pick + 0.5, self.rotations, self.crop)
        key = self.key_net(key_input)
        kernels = self.query_net(crops)
        scale = (self.crop * self.crop * self.channels) ** -0.5
        logits = correlation.correlate(key[..., :-1], kernels * scale) + key[None, ..., -1]
        return Place(logits=logits, key_input=key_input, crops=crops)

    def target_mask(self, goal: types.TopDownMap, match: Match, pick: jax.Array) -> jax.Array:
        """Give `[rows, cols, 2]`: how much of the picked object is in each column of the goal, and its height there.

        No gradient flows through it: the matching losses teach the embeddings.
        """
        picked = match.current[pick[0] // POOL, pick[1] // POOL]
        score = jnp.where(match.token_valid, match.token_embedding @ picked, -1e9)
        share = jax.lax.stop_gradient(jnp.exp(score - score.max()))
        grid = (self.spec.rows // POOL, self.spec.cols // POOL, self.spec.slices)
        at = (match.token[:, 0], match.token[:, 1], match.token[:, 2])
        weight = jnp.zeros(grid).at[at].set(share * match.token_valid)
        fine = jnp.repeat(jnp.repeat(weight, POOL, 0), POOL, 1) * (goal.count > 0)
        height = (jnp.arange(self.spec.slices) + 0.5) * self.spec.slice_height * HEIGHT_SCALE
        return jnp.stack([fine.max(-1), (fine * height).max(-1)], axis=-1)

    def refine(self, place: Place, bin_index: jax.Array, cell: jax.Array) -> jax.Array:
        """Regress the offset `[3]` (rows, cols, bins) from the centre of a cell `[2]` and a bin to the true place."""
        before, after = self.crop // 2, self.crop - self.crop // 2
        padded = jnp.pad(place.key_input, ((before, after), (before, after), (0, 0)))
        patch = jax.lax.dynamic_slice(padded, (cell[0], cell[1], 0), (self.crop, self.crop, padded.shape[-1]))
        return self.refine_net(jnp.concatenate([patch, place.crops[bin_index]], axis=-1))

    def __call__(self, current: types.TopDownMap, goal: types.TopDownMap, pick: jax.Array):
        """Run every part once (to make the parameters): `(Match, Place, offset)`."""
        match = self.match(current, goal)
        place = self.place(current, goal, match, pick)
        return match, place, self.refine(place, jnp.int32(0), pick)


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


def _highest(values, seen):
    """Take each column's value in its highest occupied slice: `[R, C, slices, e]` to `[R, C, e]`."""
    slices = seen.shape[-1]
    top = slices - 1 - jnp.argmax(seen[..., ::-1], axis=-1)
    return jnp.take_along_axis(values, top[..., None, None], axis=2)[:, :, 0]


def _top_tokens(priority, tokens):
    """Give the indices `[M, 3]` of the voxels of highest priority, and which of them are above zero."""
    value, flat = jax.lax.top_k(priority.ravel(), min(tokens, priority.size))
    return jnp.stack(jnp.unravel_index(flat, priority.shape), axis=-1).astype(jnp.int32), value > 0


def _surface_input(topdown_map):
    """Give the picture from above, `[rows, cols, 4]`: centred colour and scaled height."""
    top = topdown.max_height(topdown_map)
    return jnp.concatenate([top[..., :3] - COLOR_MEAN, top[..., -1:] * HEIGHT_SCALE], axis=-1)


def _upsample(x, factor):
    return jnp.repeat(jnp.repeat(x, factor, axis=0), factor, axis=1)
