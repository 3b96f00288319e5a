"""One training step, from demonstrated states to new parameters, as one pure function: augment, render, fuse, learn."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from lala_jax import augment, observe, policy, state, types
from lala_jax.sim.tasks import base


@dataclasses.dataclass(frozen=True)
class Recipe:
    """The static facts of a training step; hashable."""

    policy: policy.Policy
    observer: observe.Observer
    optimizer: optax.GradientTransformation
    batch_size: int
    recolor: bool = True
    mix: float = 0.5  # share of recoloured examples whose colours are not the palette's
    rigid: bool = True
    sensors: augment.Sensors = augment.Sensors()
    average_decay: float = 0.998


def palette(task: base.Task) -> np.ndarray:
    """Give the colours `[P, 3]` in 0..1 that the task draws from, the paper's for a task of any colours."""
    return np.asarray(base.palette(task.colors if task.colors in base.PALETTES else "paper"), np.float32)


def augmented(key: jax.Array, example: types.State, *, observer: observe.Observer, recolor: bool, mix: float, rigid: bool) -> types.State:
    """Recolour and move one example, scene and goal alike. Unbatched."""
    key_color, key_rigid = jax.random.split(key)
    if recolor:
        colors = palette(observer.task)
        example = augment.recolor(key_color, example, palette=jnp.asarray(colors), apart=base.closest(colors), mix=mix)
    if rigid:
        radius = float(np.linalg.norm(observer.task.base_size[:2])) / 2
        example = augment.rigid(key_rigid, example, spec=observer.spec, base_radius=radius)
    return example


def observations(recipe: Recipe, key: jax.Array, examples: types.State) -> tuple[types.TopDownMap, types.TopDownMap]:
    """Render and fuse B examples and their goals, seen with the same errors of the cameras: maps with leaves `[B, ...]`."""
    size = examples.color.shape[0]
    facts, color, stand = (jnp.concatenate([x, x]) for x in (examples.size, examples.color, examples.base))
    poses = jnp.concatenate([examples.poses, examples.goal])
    observer, (key_noise, key_errors, key_look) = recipe.observer, jax.random.split(key, 3)
    views = observer.look(facts, color, stand, poses, key=key_look)
    if recipe.sensors:
        pair = jax.random.split(key_errors, size)

        def err(key, key_noise, one):
            return augment.sensors(key, key_noise, one, recipe.sensors, disparity=observer.disparity)

        views = jax.vmap(err)(jnp.concatenate([pair, pair]), jax.random.split(key_noise, 2 * size), views)
    maps = observer.fuse(views)
    return jax.tree.map(lambda x: x[:size], maps), jax.tree.map(lambda x: x[size:], maps)


def train_step(
    recipe: Recipe, run: state.TrainState, states: types.State, key: jax.Array, frozen: Mapping[str, Any]
) -> tuple[state.TrainState, dict[str, Any]]:
    """Draw a batch from `states` (leaves `[M, ...]`), augment, render, fuse and take one optimiser step; metrics are batch means.

    A pure function of its arguments: the randomness of step n is `fold_in(key, n)`. `frozen` is the policy's; as an argument, since what
    a program closes over is compiled into it. Metrics that an example does not define are NaN there and left out of the mean.
    """
    key_batch, key_augment, key_noise, key_loss = jax.random.split(jax.random.fold_in(key, run.step), 4)
    index = jax.random.randint(key_batch, (recipe.batch_size,), 0, states.size.shape[0])
    examples = jax.tree.map(lambda leaf: leaf[index], states)
    how = {"observer": recipe.observer, "recolor": recipe.recolor, "mix": recipe.mix, "rigid": recipe.rigid}
    disturb = functools.partial(augmented, **how)
    examples = jax.vmap(disturb)(jax.random.split(key_augment, recipe.batch_size), examples)
    current, goal = observations(recipe, key_noise, examples)
    keys = jax.random.split(key_loss, recipe.batch_size)

    def mean_loss(params):
        losses, metrics = jax.vmap(lambda *example: recipe.policy.loss(params | frozen, *example))(keys, examples, current, goal)
        return losses.mean(), jax.tree.map(jnp.nanmean, metrics)

    (_, metrics), grads = jax.value_and_grad(mean_loss, has_aux=True)(run.params)
    metrics["grad_norm"] = optax.tree.norm(grads)
    return state.update(run, grads, recipe.optimizer, average_decay=recipe.average_decay), metrics
