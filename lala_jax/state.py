"""The training state: everything a run needs to go on bit for bit. Randomness is `fold_in(key, step)` and not part of it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct


@struct.dataclass
class TrainState:
    """One run's parameters at one step."""

    step: jax.Array  # [] int32, optimiser steps taken
    params: Any
    average: Any  # exponential moving average of params, what is evaluated
    opt_state: optax.OptState


def create(params: Any, optimizer: optax.GradientTransformation) -> TrainState:
    """Start at step 0; the average starts at the parameters."""
    return TrainState(step=jnp.int32(0), params=params, average=jax.tree.map(jnp.array, params), opt_state=optimizer.init(params))


def update(state: TrainState, grads: Any, optimizer: optax.GradientTransformation, *, average_decay: float) -> TrainState:
    """Take one optimiser step; the average forgets faster at the start: decay min(average_decay, (1 + step) / (10 + step))."""
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    decay = jnp.minimum(average_decay, (1.0 + state.step) / (10.0 + state.step))
    average = jax.tree.map(lambda old, new: old + (1.0 - decay) * (new - old), state.average, params)
    return TrainState(step=state.step + 1, params=params, average=average, opt_state=opt_state)


def parameter_count(params: Any) -> int:
    """Count the numbers in a pytree of parameters."""
    return sum(leaf.size for leaf in jax.tree.leaves(params))
