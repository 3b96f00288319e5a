"""Many of one thing: one after the other where caches matter, all at once where there are threads enough."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

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
