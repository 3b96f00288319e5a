"""Many of one thing: one after the other where caches matter, all at once where there are threads enough."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

METHODS = ("auto", "map", "vmap")


def each(function: Callable[[Any], Any], items: Any, *, method: str = "auto", at_once: int | None = None) -> Any:
    """Apply a function to every item of a pytree with leaves `[B, ...]`, giving leaves `[B, ...]`.

    `method` is "map" (one item after the other), "vmap" (all at once, or `at_once`, where each takes much memory) or "auto": map on a
    CPU, which keeps an item in its caches and takes only the branches that are asked for, vmap elsewhere. Raises ValueError for another
    method.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
    if method == "auto":
        method = "map" if jax.default_backend() == "cpu" else "vmap"
    if method == "map":
        return jax.lax.map(function, items)
    count = len(jax.tree.leaves(items)[0])
    return jax.vmap(function)(items) if at_once is None or count <= at_once else jax.lax.map(function, items, batch_size=at_once)


def stretch(function: Callable[[Any], Any], items: Any, start: int | jax.Array, count: int | jax.Array, *, most: int) -> Any:
    """Apply a function to `count` items from `start` on, of a pytree with leaves `[B, ...]`, one after the other: leaves `[most, ...]`.

    The rest is zeros, or False, and costs nothing. One program for every `start` and `count`; no reverse-mode derivative.
    """
    function = jax.jit(function)  # traced once for both

    def item(i):
        return jax.tree.map(lambda leaf: leaf[i], items)

    blank = jax.tree.map(lambda leaf: jnp.zeros((most, *leaf.shape), leaf.dtype), jax.eval_shape(function, item(0)))

    def put(i, done):
        return jax.tree.map(lambda all_, one: all_.at[i].set(one), done, function(item(start + i)))

    return jax.lax.fori_loop(0, count, put, blank)
