"""Sentences as vectors: a BERT encoder, mean pooling and normalisation, as sentence-transformers' all-MiniLM-L6-v2 has them.

BERT is Devlin et al. 2019 with the encoder of Vaswani et al. 2017; the pooling is Reimers and Gurevych 2019. There is no
dropout: the weights are used as they are.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import traverse_util

_norm = functools.partial(nn.LayerNorm, epsilon=1e-12, use_fast_variance=False)  # the fast one cancels digits

# What Hugging Face's `BertModel` calls the modules; those of layer i are below `encoder.layer.i`.
_PUBLISHED = {
    "words": "embeddings.word_embeddings",
    "positions": "embeddings.position_embeddings",
    "types": "embeddings.token_type_embeddings",
    "norm": "embeddings.LayerNorm",
    "query": "attention.self.query",
    "key": "attention.self.key",
    "value": "attention.self.value",
    "attended": "attention.output.dense",
    "attended_norm": "attention.output.LayerNorm",
    "hidden": "intermediate.dense",
    "output": "output.dense",
    "output_norm": "output.LayerNorm",
}


def attend(query: jax.Array, key: jax.Array, value: jax.Array, mask: jax.Array | None = None, *, heads: int) -> jax.Array:
    """Mix values `[..., S, D]` for queries `[..., T, D]`, each head a part of D, where `mask`, cast to `[..., heads, T, S]`, is true."""
    split = (x.reshape(*x.shape[:-1], heads, -1) for x in (query, key, value))
    return nn.dot_product_attention(*split, mask=mask).reshape(query.shape)


class Layer(nn.Module):
    """One encoder layer: attention among the tokens, then two dense layers, each added to its input and normalised after."""

    heads: int
    hidden: int  # features between the dense layers
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """Map `[..., T, D]` to the same, attending to tokens where `mask` `[..., T]` is true."""
        dense = functools.partial(nn.Dense, dtype=self.dtype)
        width = x.shape[-1]
        query, key, value = (dense(width, name=name)(x) for name in ("query", "key", "value"))
        y = dense(width, name="attended")(attend(query, key, value, mask[..., None, None, :], heads=self.heads))
        x = _norm(dtype=self.dtype, name="attended_norm")(x + y)
        y = nn.gelu(dense(self.hidden, name="hidden")(x), approximate=False)
        return _norm(dtype=self.dtype, name="output_norm")(x + dense(width, name="output")(y))


class Bert(nn.Module):
    """Encode sentences of token ids, with any leading dimensions or none.

    The defaults are all-MiniLM-L6-v2's: 22,565,376 parameters, and 147,840 more with its pooler, which nothing uses. Raises
    ValueError for a width that the heads do not divide.
    """

    vocab: int = 30522
    positions: int = 512  # the most tokens a sentence may have
    types: int = 2  # of token: BERT takes pairs of sentences, here all are of the first
    width: int = 384
    layers: int = 6
    heads: int = 12
    hidden: int = 1536
    dtype: jnp.dtype = jnp.float32  # what the layers compute in

    def __post_init__(self):
        if self.width % self.heads:
            raise ValueError(f"Bert.width must be a multiple of its {self.heads} heads, got {self.width}")
        super().__post_init__()

    def __call__(self, ids: jax.Array, mask: jax.Array) -> jax.Array:
        """Give embeddings `[..., width]` of unit length: the mean of `tokens` over the mask; zero where that is empty."""
        total = jnp.where(mask.astype(bool)[..., None], self.tokens(ids, mask), 0.0).sum(-2)  # what the mean divides by cancels
        return total * jax.lax.rsqrt(jnp.maximum(jnp.square(total).sum(-1, keepdims=True), 1e-24))

    @nn.compact
    def tokens(self, ids: jax.Array, mask: jax.Array) -> jax.Array:
        """Give the last layer's features `[..., T, width]`, float32, of token `ids` `[..., T]`.

        `mask` `[..., T]` is false (or 0) on padding, which no other token sees and whose own features mean nothing. Raises
        ValueError where the two shapes differ and for more tokens than there are positions.
        """
        if ids.shape != mask.shape:
            raise ValueError(f"token ids and mask must have one shape [..., T], got {ids.shape} and {mask.shape}")
        if ids.shape[-1] > self.positions:
            raise ValueError(f"Bert takes at most {self.positions} tokens, got {ids.shape[-1]}")
        x = nn.Embed(self.vocab, self.width, name="words")(ids)
        x += nn.Embed(self.positions, self.width, name="positions")(jnp.arange(ids.shape[-1]))
        x += nn.Embed(self.types, self.width, name="types")(jnp.zeros((), jnp.int32))
        x = _norm(dtype=self.dtype, name="norm")(x)
        for index in range(self.layers):
            x = Layer(self.heads, self.hidden, self.dtype, name=f"layer{index}")(x, mask.astype(bool))
        return x.astype(jnp.float32)


def from_published(tensors: Mapping[str, np.ndarray], net: Bert) -> dict[str, Any]:
    """Turn tensors called and laid out as in Hugging Face's `BertModel` into the parameters of `net`, NumPy leaves.

    What `net` does not have, such as the pooler, is left out. Raises ValueError for a tensor that is missing or of another shape.
    """
    tokens = jax.ShapeDtypeStruct((1,), jnp.int32)
    params = traverse_util.flatten_dict(jax.eval_shape(net.init, jax.random.key(0), tokens, tokens), sep="/")
    for path, leaf in params.items():
        _, *modules, kind = str(path).split("/")
        name = ".".join(_PUBLISHED.get(module, module.replace("layer", "encoder.layer.")) for module in modules)
        name += ".bias" if kind == "bias" else ".weight"
        shape = leaf.shape[::-1] if kind == "kernel" else leaf.shape  # dense layers are stored [out, in]
        if name not in tensors or tensors[name].shape != shape:
            found = tensors[name].shape if name in tensors else "none"
            raise ValueError(f"Bert needs a tensor {name} of shape {shape}, got {found}")
        params[path] = np.asarray(tensors[name].T if kind == "kernel" else tensors[name], leaf.dtype)
    return traverse_util.unflatten_dict(params, sep="/")
