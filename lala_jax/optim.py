"""The optimiser, from the config's `optim` group."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import optax

SCHEDULES = ("cosine", "constant")


def schedule(name: str, *, peak: float, warmup: int, steps: int) -> optax.Schedule:
    """Give the learning rate over optimiser steps: a linear warm-up, if any, then constant or a cosine down to 1% at `steps`."""
    if name not in SCHEDULES:
        raise ValueError(f"optim.schedule must be one of {SCHEDULES}, got {name!r}")
    if name == "constant":
        return optax.linear_schedule(0.0, peak, warmup) if warmup else optax.constant_schedule(peak)
    start = 0.0 if warmup else peak
    return optax.warmup_cosine_decay_schedule(start, peak, warmup, max(steps, warmup + 2), end_value=peak * 0.01)


def create(config: Mapping[str, Any], *, steps: int) -> optax.GradientTransformation:
    """Build AdamW with global-norm clipping from `schedule`, `learning_rate`, `warmup`, `weight_decay` and `clip`."""
    rate = schedule(config["schedule"], peak=config["learning_rate"], warmup=config["warmup"], steps=steps)
    return optax.chain(
        optax.clip_by_global_norm(config["clip"]),
        optax.adamw(rate, weight_decay=config["weight_decay"]),
    )
