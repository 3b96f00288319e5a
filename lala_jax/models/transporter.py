"""The paper's policy and its rivals: pick map, query of rotated crops about the pick, key map, and their correlation.

The rotation and the correlation have no parameters and are plain functions; the module only composes them. As in the
paper, the query sees the goal image *at the pick cell*, which in these tasks is bare table once the goal is reached.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from lala_jax.models import blocks, correlation, streams
from lala_jax.perception import batches, image

VARIANTS = (*streams.VARIANTS, "transporter", "image_goal", "goal_split")

# CLIPort's constants for a tabletop: colours in 0..1, heights in metres.
COLOR_MEAN, COLOR_STD = 0.18877631, 0.07276466
HEIGHT_MEAN, HEIGHT_STD = 0.00509261, 0.00903967


def normalise(max_height: Float[Array, "rows cols c"]) -> Float[Array, "rows cols c"]:
    """Normalise a max-height map, channels (r, g, b, any fused features, height in metres), by CLIPort's statistics.

    Colour and height get about zero mean and unit deviation over a tabletop scene; fused features pass as they are.
    """
    color, features, height = jnp.split(max_height, (3, max_height.shape[-1] - 1), axis=-1)
    color, height = (color - COLOR_MEAN) / COLOR_STD, (height - HEIGHT_MEAN) / HEIGHT_STD
    return jnp.concatenate([color, features, height], axis=-1)


def normalise_slices(
    color: Float[Array, "rows cols slices 3"], seen: Bool[Array, "rows cols slices"], height: Float[Array, "rows cols"]
) -> Float[Array, "rows cols c"]:
    """Lay the height slices of a map side by side as channels, normalised as in `normalise`: r, g, b and seen of each, then the height.

    What nothing was seen in is 0 in all four.
    """
    values = jnp.where(seen[..., None], (color - COLOR_MEAN) / COLOR_STD, 0.0)
    flat = jnp.concatenate([values, seen[..., None].astype(values.dtype)], axis=-1).reshape(*height.shape, -1)
    return jnp.concatenate([flat, (height[..., None] - HEIGHT_MEAN) / HEIGHT_STD], axis=-1)


def pick_crops(maps: Float[Array, "rows cols c"], pick_cell: Int[Array, 2], *, yaw_bins: int, crop: int) -> Float[Array, "k crop crop c"]:
    """Cut `yaw_bins` crops about the cell with integer `(row, col)`, crop `b` turned by `+2 pi b / yaw_bins` about world z.

    The cell lands on index `crop // 2`, where `correlation.correlate` looks for a kernel's centre.
    """
    offsets = image.whole_turn_offsets(yaw_bins, crop)
    return batches.each(lambda offset: image.sample(maps, pick_cell.astype(jnp.float32) + 0.5 + offset), offsets)


def place_logits(
    key: Float[Array, "padded_rows padded_cols d"], query: Float[Array, "k crop crop d"], *, scale: float, method: str = "auto"
) -> Float[Array, "k rows cols"]:
    """Correlate a key map that was padded by `crop // 2` on each side with the query crops, cut to the map, times `scale`.

    `out[b, i, j]` is the score of putting the pick cell onto cell `(i, j)`, turned by `2 pi b / k`.
    """
    margin = query.shape[1] // 2
    scores = correlation.correlate(key, query, method=method)
    return scale * scores[:, margin : scores.shape[1] - margin, margin : scores.shape[2] - margin]


class Transporter(nn.Module):
    """Goal-conditioned Transporter: LALA in its three variants, and what it is compared with; unbatched, float32 logits.

    Of pick, key and query net, those of `streams.VARIANTS` (LALA) each take both images. The others are one hourglass each,
    and one more for the goal, `g`, where there is one:

    - "transporter" ignores the goal: Transporter Networks, the control.
    - "image_goal" picks from the product of both images, `pick(both)`, and adds: `key(current) + g(goal)`, `query(crops) + g(goal crops)`
      (CLIPort, `AttentionImageGoal` and `TransportImageGoal`). The product must be of raw images and normalised afterwards: a normalised
      table is about zero, and times that nothing is left of what lies where the goal is bare. CLIPort normalises a product by what one
      image has; `policy.picture` takes its root first, so that these numbers fit.
    - "goal_split" picks without the goal and multiplies: `key(current) * g(goal)`, and `query(current) * g(goal)` of the whole
      map, of which the crops are cut (Ravens, `TransportGoal`; its hourglass also has biases, and strides in the first 1x1).

    The defaults are the paper's: 64 x 64 crops, 36 rotations, three channels of key and query. A smaller `width`,
    `stages` and `crop` make a compact one. Raises ValueError for an unknown `variant`, for a crop that the strides do
    not divide and for fewer than one rotation. Its parameters are quickest drawn by `lala_jax.compiling.draw`; `init` as it is runs the
    networks, too.
    """

    variant: str = "two_stream"  # one of VARIANTS
    yaw_bins: int = 36
    crop: int = 64  # cells
    channels: int = 3  # of key and query
    width: int = 64  # channels of the first stage
    stages: int = 4
    method: str = "auto"  # one of correlation.METHODS
    dtype: jnp.dtype = jnp.float32  # what the networks compute in

    def __post_init__(self):
        for name, valid in (("variant", VARIANTS), ("method", correlation.METHODS)):
            if getattr(self, name) not in valid:
                raise ValueError(f"Transporter.{name} must be one of {valid}, got {getattr(self, name)!r}")
        step = 2 ** (self.stages - 1)
        if self.crop < 1 or self.crop % step:
            raise ValueError(f"Transporter.crop must be a positive multiple of {step} for {self.stages} stages, got {self.crop}")
        if self.yaw_bins < 1:
            raise ValueError(f"Transporter.yaw_bins must be at least 1, got {self.yaw_bins}")
        super().__post_init__()

    def setup(self):
        self.pick_net = self._net(1, "add", jnp.float32)  # in bfloat16 many neighbours have equal logits, and the first of them wins
        self.key_net = self._net(self.channels, "conv")
        self.query_net = self._net(self.channels, "conv")
        if self.variant in ("image_goal", "goal_split"):
            self.goal_net = self._net(self.channels, "conv")

    def _net(self, out: int, fusion: str, head_dtype: jnp.dtype | None = None) -> nn.Module:
        if self.variant in streams.VARIANTS:
            return streams.Streams(out, self.variant, fusion, self.width, self.stages, self.dtype, head_dtype)
        return blocks.ResNet43_8s(out, self.width, self.stages, self.dtype, head_dtype)

    def __call__(
        self,
        current: Float[Array, "rows cols c"],
        goal: Float[Array, "rows cols c"],
        pick_cell: Int[ArrayLike, 2] | None = None,
        both: Float[Array, "rows cols c"] | None = None,
    ) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """Score every pick and, for the pick at integer `(row, col)`, every place: `(logits, intermediates)`.

        Only "image_goal" looks at `both`, the product of the two images, and needs it.

        `logits` has `pick` `[rows, cols]` and `place` `[yaw_bins, rows, cols]`, each for one softmax over all its entries.
        Without a `pick_cell` the best pick is taken; `intermediates` names the cell, the key map and the query crops.
        """
        pick = self.pick(current, goal, both)
        if pick_cell is None:
            pick_cell = jnp.stack(jnp.unravel_index(jnp.argmax(pick), pick.shape))
        place, intermediates = self.place(current, goal, jnp.asarray(pick_cell))
        return {"pick": pick, "place": place}, intermediates

    def pick(
        self, current: Float[Array, "rows cols c"], goal: Float[Array, "rows cols c"], both: Float[Array, "rows cols c"] | None = None
    ) -> Float[Array, "rows cols"]:
        """Score every cell as a pick; the maps are padded to a square, as in the paper. Raises ValueError where `both` is missing."""
        if self.variant == "image_goal" and both is None:
            raise ValueError('Transporter of variant "image_goal" picks from the product of both images: give both')
        rows, cols = current.shape[:2]
        side = self._round_up(max(rows, cols))
        top, left = (side - rows) // 2, (side - cols) // 2
        pads = (top, side - rows - top), (left, side - cols - left)
        if self.variant in streams.VARIANTS:
            logits = self.pick_net(_pad(current, *pads), _pad(goal, *pads))
        else:
            logits = self._alone(self.pick_net, _pad(both if self.variant == "image_goal" else current, *pads))
        return logits[top : top + rows, left : left + cols, 0]

    def place(
        self, current: Float[Array, "rows cols c"], goal: Float[Array, "rows cols c"], pick_cell: Int[Array, 2]
    ) -> tuple[Float[Array, "k rows cols"], dict[str, jax.Array]]:
        """Score every place of what is at `pick_cell`: `([yaw_bins, rows, cols], intermediates)`."""
        turns = {"yaw_bins": self.yaw_bins, "crop": self.crop}
        if self.variant == "goal_split":
            key, features = self._on_map(current, goal, self.key_net, self.query_net)
            query = pick_crops(features, pick_cell + self.crop // 2, **turns)
        else:
            # Not the maps to be padded: XLA folds the padding of what needs no conversion into the convolution, whose kernel gradient on
            # a GPU is then no longer recognised as one.
            maps = pick_crops(jnp.concatenate([current, goal], -1).astype(self.dtype), pick_cell, **turns)
            query = self.query(*jnp.split(maps, 2, axis=-1))
            key = self.key(current, goal)
        scale = (self.crop * self.crop * self.channels) ** -0.5  # all crops' logits start alike; public code has 1 or crop**-2
        logits = place_logits(key, query, scale=scale, method=self.method)
        return logits, {"pick_cell": pick_cell, "key": key, "query": query}

    def key(self, current: Float[Array, "rows cols c"], goal: Float[Array, "rows cols c"]) -> Float[Array, "padded_rows padded_cols d"]:
        """Give the key map, `crop // 2` cells larger on each side so that places at the border see whole kernels."""
        return self._on_map(current, goal, self.key_net)[0]

    def query(self, current: Float[Array, "... rows cols c"], goal: Float[Array, "... rows cols c"]) -> Float[Array, "... rows cols d"]:
        """Give the query features of both images: kernels of rotated crops, or for "goal_split" what kernels are cut of."""
        return self._features(current, goal, self.query_net)[0]

    def _on_map(self, current: jax.Array, goal: jax.Array, *nets: nn.Module) -> list[jax.Array]:
        """Give each net's features of the maps with `crop // 2` cells of zeros on each side."""
        rows, cols = current.shape[:2]
        margin = self.crop // 2
        extra = self._round_up(rows) - rows, self._round_up(cols) - cols
        padded = (_pad(x, (margin, margin + extra[0]), (margin, margin + extra[1])) for x in (current, goal))
        return [x[: rows + 2 * margin, : cols + 2 * margin] for x in self._features(*padded, *nets)]

    def _features(self, current: jax.Array, goal: jax.Array, *nets: nn.Module) -> list[jax.Array]:
        if self.variant in streams.VARIANTS:
            return [net(current, goal) for net in nets]
        own = [self._alone(net, current) for net in nets]
        if self.variant == "transporter":
            return own
        goal = self._alone(self.goal_net, goal)
        return [x + goal if self.variant == "image_goal" else x * goal for x in own]

    def _alone(self, net: nn.Module, image: jax.Array) -> jax.Array:
        return net(image)[0].astype(jnp.float32)

    def _round_up(self, cells: int) -> int:
        step = 2 ** (self.stages - 1)
        return -(-cells // step) * step


def _pad(x: jax.Array, rows: tuple[int, int], cols: tuple[int, int]) -> jax.Array:
    return jnp.pad(x, (rows, cols, (0, 0)))
