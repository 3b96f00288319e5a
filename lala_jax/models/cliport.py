"""CLIPort's two-stream Transporter, told by a sentence what to do: its forms with lateral connections, "RN50 + BERT" and CLIP's own.

A spatial stream sees the map. A semantic stream sees what frozen encoders made of the map's colours and of the sentence;
they stay outside, their outputs are inputs here. From CLIPort: `ResNet45_10s`, `RN50BertLingUNetLat` and `CLIPLingUNetLat`, `Up`,
`FusionConvLat`, `TwoStreamAttentionLangFusionLat` and `TwoStreamTransportLangFusionLat`, fused by "mult", "add" and "conv" as its
`train.yaml` says. The semantic stream is as deep as the features reach: a ResNet-50 to 1/32 is CLIPort's, shorter ones do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, ArrayLike, Float, Int

from lala_jax.models import blocks, convolution, correlation, streams, transporter
from lala_jax.perception import image


class SpatialStream(nn.Module):
    """Predict `out` values a cell of a map with an hourglass that ends at twice the map's size: CLIPort's `ResNet45_10s`.

    `stages` pairs going down, then up by as many doublings, of which the last one goes beyond the map; there are
    `width * s` channels at stride `s`, at the map's size and on the way up. As in `blocks`, doubling keeps cells over
    cells, so the way back to the map's size takes every other cell. Raises ValueError for sides that the strides do not divide.
    """

    out: int
    width: int = 64
    stages: int = 5
    dtype: jnp.dtype = jnp.float32
    head_dtype: jnp.dtype | None = None  # of the last pair, `dtype` unless given

    @nn.compact
    def __call__(self, x: jax.Array) -> tuple[jax.Array, list[jax.Array]]:
        """Map `[..., H, W, C]` to `[..., H, W, out]`, and give what entered each layer on the way up, coarse to fine, besides."""
        blocks.check_sides(x.shape, self.stages)
        x = convolution.relu(nn.Conv(self.width, (3, 3), padding=1, dtype=self.dtype, name="stem")(x))
        for stage in range(self.stages):
            x = blocks.residual_pair(x, self.width << stage, f"down{stage}", stride=2 if stage else 1, dtype=self.dtype)
        laterals = [x]
        for stage in reversed(range(self.stages)):
            width = max(self.width << stage >> 1, blocks.MIN_HEAD)
            laterals.append(x := blocks.upsample(blocks.residual_pair(x, width, f"up{stage}", dtype=self.dtype)))
        head = max(self.width // 4, blocks.MIN_HEAD)
        x = blocks.residual_pair(x, head, "head", self.out, last_relu=False, dtype=self.head_dtype or self.dtype)
        return x[..., ::2, ::2, :], laterals


class SemanticStream(nn.Module):
    """Predict `out` values a cell from frozen features, a sentence and the spatial stream: CLIPort's `RN50BertLingUNetLat`.

    Without a `text_layer`, a dense layer that the sentence passes before all else, it is `CLIPLingUNetLat`.

    From the coarsest features up: multiply by the sentence, double, join the next finer features, convolve twice, join the
    spatial stream's; past the finest features, a residual pair, double and join the spatial stream's. There are `width * s / 2`
    channels at stride `s`, down to twice the map's size; the way back takes every other cell.

    CLIPort batch-normalises the convolutions after each join. With its batches of one that is by the mean and variance of
    each channel over all cells (and crops), and so it is here, in acting too, where CLIPort takes running means. The biases
    before it, which it cancels, are left out.
    """

    out: int
    width: int = 64
    dtype: jnp.dtype = jnp.float32
    text_layer: bool = True
    head_dtype: jnp.dtype | None = None  # of the last layer, `dtype` unless given

    @nn.compact
    def __call__(self, features: Sequence[jax.Array], laterals: Sequence[jax.Array], sentence: jax.Array) -> jax.Array:
        """Map features `[..., H / s, W / s, c]`, fine to coarse, laterals and a sentence `[e]` to `[..., H, W, out]`."""
        *skips, x = features
        level = int(math.log2(laterals[-1].shape[-2] // x.shape[-2]))  # doublings to go
        x = convolution.relu(self._conv(self._width(level), 3, "stem")(x))
        text = nn.Dense(16 * self.width, dtype=self.dtype, name="text")(sentence) if self.text_layer else sentence
        for skip in reversed(skips):
            gate = nn.Dense(x.shape[-1], dtype=self.dtype, bias_init=nn.initializers.ones, name=f"language{level}")
            x = x * gate(text)
            level -= 1
            x = jnp.concatenate([skip.astype(x.dtype), blocks.upsample(x)], -1)
            for index, width in enumerate((2 * self._width(level), self._width(level))):
                x = self._conv(width, 3, f"up{level}_conv{index}")(x)
                x = convolution.relu(self._norm(x.ndim, f"up{level}_norm{index}")(x))
            x = self._lateral(x, laterals, level)
        while level:
            level -= 1
            x = blocks.upsample(blocks.residual_pair(x, self._width(level), f"up{level}", dtype=self.dtype))
            x = self._lateral(x, laterals, level)
        return nn.Conv(self.out, (1, 1), dtype=self.head_dtype or self.dtype, name="head")(x)[..., ::2, ::2, :]

    def _width(self, level: int) -> int:
        return max(self.width << level >> 2, blocks.MIN_HEAD)

    def _conv(self, width: int, size: int, name: str) -> nn.Conv:
        return nn.Conv(width, (size, size), padding=size // 2, use_bias=False, dtype=self.dtype, name=name)

    def _norm(self, ndim: int, name: str) -> nn.LayerNorm:
        axes = tuple(range(ndim - 1))
        return nn.LayerNorm(1e-5, self.dtype, reduction_axes=axes, use_fast_variance=False, name=name)

    def _lateral(self, x: jax.Array, laterals: Sequence[jax.Array], level: int) -> jax.Array:
        """Join the spatial stream's features and restore the width; both are past a ReLU, CLIPort's other one changes nothing."""
        both = jnp.concatenate([x, laterals[-1 - level].astype(x.dtype)], -1)
        return self._conv(x.shape[-1], 1, f"lateral{level}")(both)


class TwoStream(nn.Module):
    """Both streams, and their sum ("add", CLIPort's pick) or a 1x1 convolution of both behind a ReLU ("conv", its key and query).

    Raises ValueError for another fusion.
    """

    out: int
    fusion: str
    width: int = 64
    stages: int = 5
    dtype: jnp.dtype = jnp.float32
    text_layer: bool = True
    head_dtype: jnp.dtype | None = None  # of both streams' last layers, `dtype` unless given

    def __post_init__(self):
        if self.fusion not in streams.FUSIONS:
            raise ValueError(f"TwoStream.fusion must be one of {streams.FUSIONS}, got {self.fusion!r}")
        super().__post_init__()

    @nn.compact
    def __call__(self, maps: jax.Array, features: Sequence[jax.Array], sentence: jax.Array) -> jax.Array:
        """Map a map `[..., H, W, C]`, features of it `[..., H / s, W / s, c]` and a sentence `[e]` to float32 `[..., H, W, out]`."""
        spatial, laterals = SpatialStream(self.out, self.width, self.stages, self.dtype, self.head_dtype, name="spatial")(maps)
        semantic_net = SemanticStream(self.out, self.width, self.dtype, self.text_layer, self.head_dtype, name="semantic")
        semantic = semantic_net(features, laterals, sentence)
        if self.fusion == "add":
            return spatial.astype(jnp.float32) + semantic.astype(jnp.float32)
        both = convolution.relu(jnp.concatenate([spatial, semantic], -1))
        return nn.Conv(self.out, (1, 1), use_bias=False, dtype=self.dtype, name="fuse")(both).astype(jnp.float32)


class Cliport(nn.Module):
    """CLIPort for one sentence and one map; unbatched, float32 logits as `transporter.Transporter` gives them.

    `maps` `[rows, cols, c]` is a max-height map as `transporter.normalise` gives it. `features` are a frozen backbone's of
    its colours, `[rows / s, cols / s, c_s]`, fine to coarse, each stride twice the one before: two or more. Feature `[i, j]`
    lies over cell `[s * i, s * j]`, as padded strided convolutions put it. `sentence` `[e]` is a frozen encoder's, with entries of
    about one: what it says is multiplied in, so an embedding of length one (MiniLM's) times `sqrt(e)`, or it is hardly heard.
    CLIPort's own are ResNet-50's at strides 4, 8, 16 and 32 with 256 to 2048 channels, and DistilBERT's mean of 768, or CLIP's
    features of the same sizes and its 1024, without a `text_layer`. CLIP's features lie up to `s / 2 - 1` cells further on
    (`clip.Visual`), in CLIPort too: the layers after them are left to learn that.

    CLIPort pads a map's picture before the backbone sees it, here its features are padded. Raises ValueError for an unknown
    `method`, for fewer than one rotation, for a crop that the strides do not divide, for features that are not as above, and
    for more doublings of them than the `stages` of the spatial stream have laterals for.
    """

    yaw_bins: int = 36
    crop: int = 64  # cells
    channels: int = 3  # of key and query
    width: int = 64  # channels of the spatial stream's first stage
    stages: int = 5  # of the spatial stream
    method: str = "auto"  # one of correlation.METHODS
    dtype: jnp.dtype = jnp.float32  # what the networks compute in
    text_layer: bool = True  # between the sentence and what it multiplies; CLIPort has none where the sentence is CLIP's

    def __post_init__(self):
        if self.method not in correlation.METHODS:
            raise ValueError(f"Cliport.method must be one of {correlation.METHODS}, got {self.method!r}")
        if self.yaw_bins < 1:
            raise ValueError(f"Cliport.yaw_bins must be at least 1, got {self.yaw_bins}")
        super().__post_init__()

    def setup(self):
        shared = self.width, self.stages, self.dtype, self.text_layer
        self.pick_net = TwoStream(1, "add", *shared, head_dtype=jnp.float32)
        self.key_net = TwoStream(self.channels, "conv", *shared)
        self.query_net = TwoStream(self.channels, "conv", *shared)

    def __call__(
        self,
        maps: Float[Array, "rows cols c"],
        features: Sequence[jax.Array],
        sentence: Float[Array, " e"],
        pick_cell: Int[ArrayLike, 2] | None = None,
    ) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
        """Score every pick and, for the pick at integer `(row, col)`, every place: `(logits, intermediates)`.

        `logits` has `pick` `[rows, cols]` and `place` `[yaw_bins, rows, cols]`, each for one softmax over all its entries.
        Without a `pick_cell` the best pick is taken; `intermediates` names the cell, the key map and the query crops.
        """
        pick = self.pick(maps, features, sentence)
        if pick_cell is None:
            pick_cell = jnp.stack(jnp.unravel_index(jnp.argmax(pick), pick.shape))
        place, intermediates = self.place(maps, features, sentence, jnp.asarray(pick_cell))
        return {"pick": pick, "place": place}, intermediates

    def pick(
        self, maps: Float[Array, "rows cols c"], features: Sequence[jax.Array], sentence: Float[Array, " e"]
    ) -> Float[Array, "rows cols"]:
        """Score every cell as a pick; the map is padded to a square, about evenly, as in CLIPort."""
        rows, cols = maps.shape[:2]
        step = self._step(maps, features)
        side = _round_up(max(rows, cols), step)
        top, left = ((side - size) // 2 // step * step for size in (rows, cols))
        padded = _pad([maps, *features], (top, side - rows - top), (left, side - cols - left))
        return self.pick_net(padded[0], padded[1:], sentence)[top : top + rows, left : left + cols, 0]

    def place(
        self,
        maps: Float[Array, "rows cols c"],
        features: Sequence[jax.Array],
        sentence: Float[Array, " e"],
        pick_cell: Int[Array, 2],
        crop_features: Sequence[jax.Array] | None = None,
    ) -> tuple[Float[Array, "k rows cols"], dict[str, jax.Array]]:
        """Score every place of what is at `pick_cell`: `([yaw_bins, rows, cols], intermediates)`.

        CLIPort's backbone sees the turned crops; give `crop_features` `[k, crop / s, crop / s, c_s]` of
        `transporter.pick_crops` of the picture for that. Without, the features of the upright map are turned and cut.
        """
        how = {"yaw_bins": self.yaw_bins, "crop": self.crop}
        if crop_features is None:
            crop_features = [turned_features(x, pick_cell, stride=_stride(maps, x), **how) for x in features]
        query = self.query(transporter.pick_crops(maps, pick_cell, **how), crop_features, sentence)
        key = self.key(maps, features, sentence)
        logits = transporter.place_logits(key, query, scale=(self.crop * self.crop * self.channels) ** -0.5, method=self.method)
        return logits, {"pick_cell": pick_cell, "key": key, "query": query}

    def key(
        self, maps: Float[Array, "rows cols c"], features: Sequence[jax.Array], sentence: Float[Array, " e"]
    ) -> Float[Array, "padded_rows padded_cols d"]:
        """Give the key map, `crop // 2` cells larger on each side so that places at the border see whole kernels."""
        (rows, cols), step, margin = maps.shape[:2], self._step(maps, features), self.crop // 2
        before = _round_up(margin, step)
        after = (_round_up(size + margin, step) - size for size in (rows, cols))
        padded = _pad([maps, *features], *((before, size) for size in after))
        key, cut = self.key_net(padded[0], padded[1:], sentence), before - margin
        return key[cut : cut + rows + 2 * margin, cut : cut + cols + 2 * margin]

    def query(
        self, crops: Float[Array, "k crop crop c"], features: Sequence[jax.Array], sentence: Float[Array, " e"]
    ) -> Float[Array, "k crop crop d"]:
        """Give the query kernels of rotated crops of the map and of its features."""
        self._step(crops, features)
        return self.query_net(crops, features, sentence)

    def _step(self, maps: jax.Array, features: Sequence[jax.Array]) -> int:
        """Give what sides must be multiples of, having checked that the features are the map's."""
        strides = [_stride(maps, x) for x in features]
        if len(strides) < 2 or any(after != 2 * before for before, after in zip(strides, strides[1:], strict=False)):
            raise ValueError(f"Cliport needs features at two or more strides, each twice the one before, got strides {strides}")
        spatial = 2 ** (self.stages - 1)
        if strides[-2] > spatial:
            raise ValueError(f"features at strides {strides} need a Cliport of {int(math.log2(strides[-1]))} stages, got {self.stages}")
        step = max(spatial, strides[-1])
        if self.crop < 1 or self.crop % step:
            raise ValueError(f"Cliport.crop must be a positive multiple of {step} here, got {self.crop}")
        return step


def turned_features(
    features: Float[Array, "rows cols c"], pick_cell: Int[Array, 2], *, yaw_bins: int, crop: int, stride: int
) -> Float[Array, "k side side c"]:
    """Cut `yaw_bins` crops of features at a stride, turned as `transporter.pick_crops` turns the map; `side` is `crop / stride`."""
    offsets = image.whole_turn_offsets(yaw_bins, crop)[:, ::stride, ::stride]
    return image.sample(features, (pick_cell + offsets) / stride + 0.5)


def _stride(maps: jax.Array, features: jax.Array) -> int:
    """Say by how many cells of a map `[..., H, W, C]` its features `[..., H / s, W / s, c]` step: a power of two."""
    sides, ours = maps.shape[-3:-1], features.shape[-3:-1]
    stride = max(1, sides[0] // max(1, ours[0]))
    if stride & (stride - 1) or tuple(side * stride for side in ours) != sides:
        raise ValueError(f"features must have the map's sides {sides} divided by a power of two, got {ours}")
    return stride


def _pad(images: Sequence[jax.Array], rows: tuple[int, int], cols: tuple[int, int]) -> list[jax.Array]:
    """Pad a map, and its features by as much, with zeros."""
    padded = []
    for one in images:
        stride = _stride(images[0], one)
        padded.append(jnp.pad(one, (*(tuple(cells // stride for cells in side) for side in (rows, cols)), (0, 0))))
    return padded


def _round_up(cells: int, step: int) -> int:
    return -(-cells // step) * step
