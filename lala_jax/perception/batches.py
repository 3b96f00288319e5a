"""Many of one thing: one after the other where caches matter, all at once where there are threads enough."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

METHODS = ("auto", "map", "vmap")


def each(function: Callable[[Any], Any], items: Any, *, method: str = "auto") -> Any:
    """Apply a function to every item of a pytree with leaves `[B, ...]`, giving leaves `[B, ...]`.

    `method` is "map" (one item after the other), "vmap" (all at once) or "auto": map on a CPU, which keeps an item in its caches
    and takes only the branches that are asked for, vmap elsewhere. Raises ValueError for another method.
    """
    if method not in METHODS:
        raise ValueError(f"method must be one of {METHODS}, got {method!r}")
    if method == "auto":
        method = "map" if jax.default_backend() == "cpu" else "vmap"
    return jax.lax.map(function, items) if method == "map" else jax.vmap(function)(items)
