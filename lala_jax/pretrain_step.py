"""One step of pre-training, from drawn states to new weights, as one pure function: augment, render, cover, predict."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax

from lala_jax import observe, parallel, state, train_step, types
from lala_jax.models import cross_view
from lala_jax.perception import camera as cameras

WANDER = 0.03  # metres, the deviation of the point that the windows are cut about from an object's middle


@dataclasses.dataclass(frozen=True)
class Recipe:
    """The static facts of a step; hashable."""

    model: cross_view.CrossView
    observer: observe.Observer
    optimizer: optax.GradientTransformation
    batch_size: int
    window: int = 64  # pixels, the sides of what is cut out of every view
    mask: float = 0.9  # share of a view's patches that is covered
    recolor: bool = True
    mix: float = 0.5  # as in `train_step.Recipe`
    rigid: bool = True
    average_decay: float = 0.998
    mesh: jax.sharding.Mesh | None = None  # as in `train_step.Recipe`
    shard_state: bool = False


def draw(recipe: Recipe, key: jax.Array, views: types.Views, poses: jax.Array) -> tuple[types.Views, jax.Array, jax.Array]:
    """Cut windows about one of the objects at `poses` `[N, 7]`, and draw which view is covered, and where: what the model takes. Unbatched.

    The covered view is one of those whose picture the point is in.
    """
    key_object, key_point, key_view, key_cover = jax.random.split(key, 4)
    point = jax.random.choice(key_object, poses[:, :3]) + WANDER * jax.random.normal(key_point, (3,))
    inside = jax.vmap(lambda one: cameras.in_image(*cameras.project(point, one), one))(views.camera)
    which = jax.random.categorical(key_view, jnp.where(inside, 0.0, -1e9))
    hidden = cross_view.cover(key_cover, recipe.window // recipe.model.patch, recipe.mask)
    return cross_view.windows(views, point, recipe.window), which, hidden


def batch(recipe: Recipe, key: jax.Array, states: types.State) -> tuple[types.Views, jax.Array, jax.Array]:
    """Draw from `states` (leaves `[M, ...]`), augment and render: what the model takes, leaves `[B, ...]`."""
    return _look(recipe, *_drawn(recipe, key, states))


def _drawn(recipe, key, states):
    """Draw the examples: a key for all pictures, and `[B, ...]` each one's state and keys, to augment it and to cover it."""
    key_batch, key_augment, key_look, key_draw = jax.random.split(key, 4)
    index = jax.random.randint(key_batch, (recipe.batch_size,), 0, states.size.shape[0])
    examples = jax.tree.map(lambda leaf: leaf[index], states)
    return key_look, (examples, jax.random.split(key_augment, recipe.batch_size), jax.random.split(key_draw, recipe.batch_size))


def _look(recipe, key_look, drawn, whole=None):
    examples, key_augment, key_draw = drawn
    disturb = functools.partial(train_step.augmented, observer=recipe.observer, recolor=recipe.recolor, mix=recipe.mix, rigid=recipe.rigid)
    examples = jax.vmap(disturb)(key_augment, examples)
    views = recipe.observer.look(examples.size, examples.color, examples.base, examples.poses, key=key_look, whole=whole)
    return jax.vmap(functools.partial(draw, recipe))(key_draw, views, examples.poses)


def gradients(recipe: Recipe, common: tuple[Any, ...], drawn: tuple[Any, ...]) -> tuple[Any, dict[str, jax.Array]]:
    """Augment, render, cover and learn from examples, or from a device's share of them: the mean gradients and metrics of all.

    `common` are the parameters, what is frozen and a key for all pictures; `drawn`, leaves `[B, ...]`, the examples and their keys.
    """
    params, frozen, key_look = common
    examples = _look(recipe, key_look, drawn, functools.partial(parallel.whole, mesh=recipe.mesh))

    def mean_loss(params):
        def one(views, which, hidden):
            predicted = recipe.model.apply({"params": params, "batch_stats": frozen}, views, which, hidden)
            return cross_view.errors(predicted, cross_view.targets(views.rgb[which], recipe.model.patch), hidden)

        error, variance = (values.mean() for values in jax.vmap(one)(*examples))
        return error, (error, variance)

    (_, means), grads = jax.value_and_grad(mean_loss, has_aux=True)(params)
    grads, (error, variance) = parallel.mean((grads, means), recipe.mesh)
    return grads, {"loss": error, "explained": 1.0 - error / variance}


def pretrain_step(
    recipe: Recipe, run: state.TrainState, states: types.State, frozen: Any, key: jax.Array
) -> tuple[state.TrainState, dict[str, jax.Array]]:
    """Take one optimiser step on a batch from `states`; `frozen` are the encoder's stored means and variances (`batch_stats`).

    A pure function of its arguments: the randomness of step n is `fold_in(key, n)`. `explained` is the share of the covered patches'
    variance about their means that the prediction explains.
    """
    key_look, drawn = _drawn(recipe, jax.random.fold_in(key, run.step), states)
    learn = parallel.over_batch(functools.partial(gradients, recipe), recipe.mesh)
    grads, metrics = learn((run.params, frozen, key_look), drawn)
    metrics["grad_norm"] = optax.tree.norm(grads)
    run = state.update(run, grads, recipe.optimizer, average_decay=recipe.average_decay)
    return parallel.constrain(run, recipe.mesh, shard=recipe.shard_state), metrics
