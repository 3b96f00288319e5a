"""CLIP's towers, frozen: features and embeddings of images and sentences, for weights that were trained elsewhere.

Radford et al., Learning Transferable Visual Models From Natural Language Supervision, 2021; the arithmetic is that of OpenAI's
`clip/model.py`, with a ResNet for the images. The defaults are RN50's, which CLIPort takes; `sized` gives any other's. `lala_jax.clip_file`
reads its files.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import traverse_util

from lala_jax.models import bert, convolution, resnet

FLAVOUR = resnet.Flavour("pool", (0, 1, 2), 1.0, (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711), 1e-5)

_norm = functools.partial(nn.LayerNorm, epsilon=1e-5, use_fast_variance=False)  # the fast one cancels digits

# From the path of a variable to OpenAI's name of its tensor: patterns, replaced in this order.
_PUBLISHED = {
    r"^\w+/(text/)?": "",  # `params` or `batch_stats`; the text's tensors have no prefix of their own
    r"^pool/": "visual/attnpool/",
    r"^layer": "transformer/resblocks/",
    r"layer(\d)_": r"layer\1/",
    r"stem(\d)/(conv|norm)": r"\2\1",
    "reduce/(conv|norm)": r"\g<1>1",
    "middle/(conv|norm)": r"\g<1>2",
    "expand/(conv|norm)": r"\g<1>3",
    "shortcut/conv": "downsample/0",
    "shortcut/norm": "downsample/1",
    r"norm(\d)": r"bn\1",
    r"(resblocks/\d+)/(in|out)_proj": r"\1/attn/\2_proj",
    r"(resblocks/\d+)/c_": r"\1/mlp/c_",
    r"/(kernel|scale|embedding)$": "/weight",
    r"/(mean|var)$": r"/running_\1",
    r"/in_proj/": "/in_proj_",
    "/": ".",
}
# How names end that OpenAI's files and their conversions may have besides, and that nothing here needs.
_ASIDE = ("num_batches_tracked", "input_resolution", "context_length", "vocab_size")


class Visual(nn.Module):
    """Give a colour image's features at four strides: CLIP's `ModifiedResNet` without its attention pool, as CLIPort uses it.

    Three convolutions are the stem, and 2x2 means halve, as `resnet.Bottleneck` has them. So feature `[i, j]` at stride `s` is
    centred on pixel `[s * i + s / 2 - 1, s * j + s / 2 - 1]`, where `resnet.ResNet50` has `[s * i, s * j]`.
    """

    blocks: tuple[int, ...] = (3, 4, 6, 3)  # of each stage
    width: int = 64  # channels of the stem
    dtype: jnp.dtype = jnp.float32  # what the layers compute in

    @property
    def stride(self) -> int:
        """Give the stride of the coarsest features, cells: 32 with all four stages."""
        return 2 << len(self.blocks)

    @nn.compact
    def __call__(self, rgb: jax.Array) -> list[jax.Array]:
        """Map RGB in 0..1, `[..., H, W, 3]`, to float32 `[..., (H + 1) // s, (W + 1) // s, width * s]`, `s` of 4, 8, 16 and 32 in turn."""
        x, features = FLAVOUR.prepare(rgb).astype(self.dtype), []
        for index, (out, stride) in enumerate(((self.width // 2, 2), (self.width // 2, 1), (self.width, 1)), 1):
            x = convolution.relu(resnet.ConvNorm(out, 3, stride, FLAVOUR.epsilon, self.dtype, name=f"stem{index}")(x))
        x = nn.avg_pool(x, (2, 2), (2, 2))
        for stage, blocks in enumerate(self.blocks):
            for block in range(blocks):
                shape = self.width << stage, 2 if stage and not block else 1, not block
                x = resnet.Bottleneck(*shape, FLAVOUR, self.dtype, name=f"layer{stage + 1}_{block}")(x)
            features.append(x.astype(jnp.float32))
        return features


class Pool(nn.Module):
    """Pool the coarsest features by the attention of their mean to itself and to every cell: CLIP's `AttentionPool2d`."""

    side: int = 7  # cells: of an image with sides of 224
    heads: int = 32
    out: int = 1024
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map `[..., side, side, D]` to `[..., out]`, float32. Raises ValueError for other sides, which have no learnt positions."""
        if x.shape[-3:-1] != (self.side, self.side):
            raise ValueError(f"CLIP pools features of {self.side} x {self.side} cells, got {x.shape[-3]} x {x.shape[-2]}")
        x, width = x.reshape(*x.shape[:-3], -1, x.shape[-1]).astype(self.dtype), x.shape[-1]
        x = jnp.concatenate([x.mean(-2, keepdims=True), x], -2)
        positions = self.param("positional_embedding", nn.initializers.normal(width**-0.5), (self.side**2 + 1, width))
        x += positions.astype(self.dtype)
        inputs = {"q_proj": x[..., :1, :], "k_proj": x, "v_proj": x}
        query, key, value = (nn.Dense(width, dtype=self.dtype, name=name)(seen) for name, seen in inputs.items())
        pooled = bert.attend(query, key, value, heads=self.heads)[..., 0, :]
        return nn.Dense(self.out, dtype=self.dtype, name="c_proj")(pooled).astype(jnp.float32)


class Layer(nn.Module):
    """One layer of the text's transformer: attention, then two dense layers, each of the normalised input and added to it."""

    heads: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map `[..., T, D]` to the same; a token sees itself and those before."""
        dense, norm, width = functools.partial(nn.Dense, dtype=self.dtype), functools.partial(_norm, dtype=self.dtype), x.shape[-1]
        query, key, value = jnp.split(dense(3 * width, name="in_proj")(norm(name="ln_1")(x)), 3, -1)
        causal = jnp.tril(jnp.ones((x.shape[-2], x.shape[-2]), bool))
        x += dense(width, name="out_proj")(bert.attend(query, key, value, causal, heads=self.heads))
        y = dense(4 * width, name="c_fc")(norm(name="ln_2")(x))
        return x + dense(width, name="c_proj")(y * nn.sigmoid(1.702 * y))  # QuickGELU


class Text(nn.Module):
    """Encode sentences of CLIP's token ids, with any leading dimensions or none."""

    vocab: int = 49408
    positions: int = 77  # the most tokens a sentence may have
    width: int = 512
    layers: int = 12
    heads: int = 8
    out: int = 1024
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, ids: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Map ids `[..., T]` to embeddings `[..., out]`, of any length, and to features of every token `[..., T, width]`, float32.

        A sentence's embedding is read off its last token, the highest id there is; what follows it, padding, changes nothing.
        Raises ValueError for more tokens than there are positions.
        """
        length = ids.shape[-1]
        if length > self.positions:
            raise ValueError(f"CLIP takes at most {self.positions} tokens, got {length}")
        x = nn.Embed(self.vocab, self.width, dtype=self.dtype, name="token_embedding")(ids)
        positions = self.param("positional_embedding", nn.initializers.normal(0.01), (self.positions, self.width))
        x += positions[:length].astype(self.dtype)
        for index in range(self.layers):
            x = Layer(self.heads, self.dtype, name=f"layer{index}")(x)
        x = _norm(dtype=self.dtype, name="ln_final")(x)
        last = jnp.take_along_axis(x, jnp.argmax(ids, -1)[..., None, None], -2)[..., 0, :]
        projection = self.param("text_projection", nn.initializers.normal(self.width**-0.5), (self.width, self.out))
        return (last @ projection.astype(self.dtype)).astype(jnp.float32), x.astype(jnp.float32)


class Clip(nn.Module):
    """CLIP with a ResNet: by default RN50 with its 102,007,137 parameters, besides the statistics of its normalisation.

    `net.bind(variables)` gives the towers with their weights: `.visual(rgb)`, `.image(rgb)`, `.text(ids)`.
    """

    visual: Visual = Visual()
    pool: Pool = Pool()
    text: Text = Text()

    def setup(self):
        self.logit_scale = self.param("logit_scale", nn.initializers.constant(math.log(1 / 0.07)), ())

    def image(self, rgb: jax.Array) -> jax.Array:
        """Embed RGB in 0..1, `[..., 32 * side, 32 * side, 3]`, as `[..., out]` of any length."""
        return self.pool(self.visual(rgb)[-1])

    def __call__(self, rgb: jax.Array, ids: jax.Array) -> jax.Array:
        """Score images `[N, 32 * side, 32 * side, 3]` against sentences `[S, T]`: `[N, S]`, one softmax a row, as in the paper."""
        image, text = (x / jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (self.image(rgb), self.text(ids)[0]))
        return jnp.exp(self.logit_scale) * image @ text.T


def sized(arrays: Mapping[str, np.ndarray]) -> Clip:
    """Give the CLIP with a ResNet (RN50, RN50x4, ...) that arrays called as in OpenAI's state dicts are of, sizes read off their shapes.

    As in OpenAI's `build_model`. No shape says how many heads there are: theirs have 64 channels each. Raises ValueError naming a
    tensor that is missing or has another number of dimensions; `from_published` checks the rest.
    """

    def shape(name: str, dimensions: int) -> tuple[int, ...]:
        found = arrays.get(name)
        if found is None or found.ndim != dimensions:
            there = "none" if found is None else f"one of shape {found.shape}"
            raise ValueError(f"CLIP with a ResNet has a tensor {name} of {dimensions} dimensions, got {there}")
        return found.shape

    def count(pattern: str) -> int:
        return len({match[1] for match in (re.match(pattern, name) for name in arrays) if match})

    width, (cells, _), (_, out) = (
        shape("visual.layer1.0.conv1.weight", 4)[0],
        shape("visual.attnpool.positional_embedding", 2),
        shape("text_projection", 2),
    )
    (vocab, text_width), (positions, _) = shape("token_embedding.weight", 2), shape("positional_embedding", 2)
    blocks = tuple(count(rf"visual\.layer{stage}\.(\d+)\.") for stage in (1, 2, 3, 4))
    layers = count(r"transformer\.resblocks\.(\d+)\.")
    return Clip(
        Visual(blocks, width),
        Pool(math.isqrt(max(cells - 1, 0)), max(1, width // 2), out),
        Text(vocab, positions, text_width, layers, max(1, text_width // 64), out),
    )


def tensors(net: Clip) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Give the path in the variables and the published shape of every tensor of `net`, by its published name."""
    side = 32 * net.pool.side
    inputs = jax.ShapeDtypeStruct((1, side, side, 3), jnp.float32), jax.ShapeDtypeStruct((1, 1), jnp.int32)
    found = {}
    for path, leaf in traverse_util.flatten_dict(jax.eval_shape(net.init, jax.random.key(0), *inputs), sep="/").items():
        name = functools.reduce(lambda name, rule: re.sub(*rule, name), _PUBLISHED.items(), path)
        *window, inside, out = leaf.shape if path.endswith("kernel") else (*leaf.shape, None, None)
        found[name] = path, leaf.shape if out is None else (out, inside, *window)
    return found


def from_published(arrays: Mapping[str, np.ndarray], net: Clip) -> dict[str, Any]:
    """Turn arrays called and laid out as in OpenAI's state dicts into the variables of `net`: nested dicts of float32 NumPy arrays.

    Raises ValueError naming an array that is missing or unknown, that has another shape or no floats, or whose values no
    training gives: not finite, or a negative variance.
    """
    wanted = tensors(net)
    for name, array in arrays.items():
        if name not in wanted and not name.endswith(_ASIDE):
            raise ValueError(f"CLIP of these sizes has no tensor {name}, got one of shape {array.shape}")
    variables = {}
    for name, (path, shape) in wanted.items():
        array = arrays.get(name)
        if array is None or array.shape != shape or not jnp.issubdtype(array.dtype, jnp.floating):
            found = "none" if array is None else f"{array.dtype.name} {array.shape}"
            raise ValueError(f"CLIP needs a tensor {name} of floats and shape {shape}, got {found}")
        array = np.asarray(array, np.float32)
        if not np.isfinite(array).all() or (name.endswith("running_var") and array.min() < 0):
            raise ValueError(f"tensor {name} of CLIP has values that are not finite, or negative variances")
        stored = (*range(2, array.ndim), 1, 0)  # out, in, height, width: dense layers and convolutions alike
        variables[path] = np.ascontiguousarray(array.transpose(stored)) if path.endswith("kernel") else array
    return traverse_util.unflatten_dict(variables, sep="/")
