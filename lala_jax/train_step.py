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

from lala_jax import augment, observe, parallel, policy, state, types
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
    mesh: jax.sharding.Mesh | None = None  # of devices that share the batch; None: one device
    shard_state: bool = False  # split the parameters and what goes with them over the devices, too


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


def sensor_keys(key: jax.Array, size: int) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
    """Split a key into one for what all pictures are drawn from, and `[B]` each for the cameras, the pictures now and at the goal."""
    key_noise, key_errors, key_look = jax.random.split(key, 3)
    noise = jax.random.split(key_noise, 2 * size)
    return key_look, (jax.random.split(key_errors, size), noise[:size], noise[size:])


def observations(recipe: Recipe, key: jax.Array, examples: types.State) -> tuple[types.TopDownMap, types.TopDownMap]:
    """Render and fuse B examples and their goals, seen with the same errors of the cameras: maps with leaves `[B, ...]`."""
    return _observe(recipe, *sensor_keys(key, examples.color.shape[0]), examples)


def _observe(recipe, key_look, keys, examples, whole=None):
    size = examples.color.shape[0]
    facts, color, stand = (jnp.concatenate([x, x]) for x in (examples.size, examples.color, examples.base))
    poses = jnp.concatenate([examples.poses, examples.goal])
    observer, (key_errors, *key_noise) = recipe.observer, keys
    views = observer.look(facts, color, stand, poses, key=key_look, whole=whole)
    if recipe.sensors:
        pair = jnp.concatenate([key_errors, key_errors])
        views = augment.sensors_batch(pair, jnp.concatenate(key_noise), views, recipe.sensors, disparity=observer.disparity)
    maps = observer.fuse(views)
    return jax.tree.map(lambda x: x[:size], maps), jax.tree.map(lambda x: x[size:], maps)


def gradients(recipe: Recipe, common: tuple[Any, ...], batch: tuple[Any, ...]) -> tuple[Any, dict[str, jax.Array]]:
    """Augment, render, fuse and learn from examples, or from a device's share of them: the mean gradients and metrics of all.

    `common` are the parameters, what is frozen and a key for all pictures; `batch`, leaves `[B, ...]`, are the examples as they were
    drawn and each one's keys: to augment it, for its sensors (`sensor_keys`) and its loss.
    """
    (params, frozen, key_look), (examples, key_augment, key_sensors, key_loss) = common, batch
    how = {"observer": recipe.observer, "recolor": recipe.recolor, "mix": recipe.mix, "rigid": recipe.rigid}
    examples = jax.vmap(functools.partial(augmented, **how))(key_augment, examples)
    whole = functools.partial(parallel.whole, mesh=recipe.mesh, parts=2)
    current, goal = _observe(recipe, key_look, key_sensors, examples, whole)

    def mean_loss(params):
        losses, metrics = jax.vmap(lambda *example: recipe.policy.loss(params | frozen, *example))(key_loss, examples, current, goal)
        return losses.mean(), metrics

    (_, metrics), grads = jax.value_and_grad(mean_loss, has_aux=True)(params)
    return parallel.mean(grads, recipe.mesh), jax.tree.map(functools.partial(parallel.nanmean, mesh=recipe.mesh), metrics)


def train_step(
    recipe: Recipe, run: state.TrainState, states: types.State, key: jax.Array, frozen: Mapping[str, Any]
) -> tuple[state.TrainState, dict[str, Any]]:
    """Draw a batch from `states` (leaves `[M, ...]`), augment, render, fuse and take one optimiser step; metrics are batch means.

    A pure function of its arguments: the randomness of step n is `fold_in(key, n)`. `frozen` is the policy's; as an argument, since what
    a program closes over is compiled into it. Metrics that an example does not define are NaN there and left out of the mean. The
    examples, and to rounding all that is learnt from them, do not depend on how many devices `recipe.mesh` shares the batch among.
    """
    size = recipe.batch_size
    key_batch, key_augment, key_noise, key_loss = jax.random.split(jax.random.fold_in(key, run.step), 4)
    index = jax.random.randint(key_batch, (size,), 0, states.size.shape[0])
    examples = jax.tree.map(lambda leaf: leaf[index], states)
    key_look, key_sensors = sensor_keys(key_noise, size)
    batch = (examples, jax.random.split(key_augment, size), key_sensors, jax.random.split(key_loss, size))
    learn = parallel.over_batch(functools.partial(gradients, recipe), recipe.mesh)
    grads, metrics = learn((run.params, frozen, key_look), batch)
    metrics["grad_norm"] = optax.tree.norm(grads)
    run = state.update(run, grads, recipe.optimizer, average_decay=recipe.average_decay)
    return parallel.constrain(run, recipe.mesh, shard=recipe.shard_state), metrics
