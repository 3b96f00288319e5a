"""Pre-train the backbone in a task's scenes: `python -m lala_jax.pretrain --config=configs/tower.py --workdir=runs/pretrain-tower`.

Leaves in the work directory `checkpoints/`, `metrics.jsonl` and TensorBoard events, and `backbone.npz`, the averaged weights, for
`--config.camera.backbone=runs/pretrain-tower/backbone.npz`. No demonstrations are needed. Started again, it goes on where it stopped, bit
for bit.
"""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax import backbone, build, checkpoint, compiling, loop, options, parallel, pretrain_step, state, types, writers
from lala_jax.models import resnet
from lala_jax.sim import oracle
from lala_jax.sim.tasks import base

WORKDIR = "runs/pretrain-<task>"  # the default of --workdir


@functools.cache
def step():
    """Jit the step of pre-training, once for a process."""
    return compiling.jit_step(pretrain_step.pretrain_step, state=1, static_argnums=0)


def draw_states(config: Mapping[str, Any]) -> types.State:
    """Assemble the scenes of the first `pretrain.scenes` train seeds, in random orders that hold: states on the device, leaves `[M, ...]`.

    Each scene gives its start, its goal and all between. Seeds whose scene has no free pose are passed over.
    """
    task, found = build.task(config), []
    for seed, scene in task.roomy(build.split_seeds("train", 0, config["pretrain"]["scenes"])):
        rng, poses = np.random.default_rng(seed), scene.start.copy()
        while True:
            ready = oracle.ready(task, scene, poses)
            facts = {name: getattr(scene, name) for name in ("size", "color", "base", "goal", "symmetry")}
            found.append(types.State(**facts, poses=poses.copy(), placed=oracle.placed(task, scene, poses), ready=ready))
            if not ready.any():
                break
            chosen = rng.choice(np.flatnonzero(ready))
            poses[chosen] = scene.goal[chosen]
    if not found:
        raise base.NoFreePose(f"none of the {config['pretrain']['scenes']} scenes of pretrain.scenes has a free pose for every object")
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *found)


def start(config: Mapping[str, Any], recipe: pretrain_step.Recipe, states: types.State) -> tuple[state.TrainState, dict[str, Any]]:
    """Give a fresh state, and the encoder's stored means and variances; the encoder starts at `pretrain.start`, or at random without."""
    shapes = jax.eval_shape(functools.partial(pretrain_step.batch, recipe), jax.random.key(0), states)
    one = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:], leaf.dtype), shapes)
    variables = compiling.draw(recipe.model.init, config["seed"], *one)
    if name := config["pretrain"]["start"]:
        _, loaded = backbone.load(name, stage=recipe.model.stage)
        variables = {kind: {**tree, "encoder": loaded[kind]} for kind, tree in variables.items()}
    return loop.begin(variables["params"], recipe.optimizer), variables["batch_stats"]


def trunk(recipe: pretrain_step.Recipe, params: Mapping[str, Any], frozen: Mapping[str, Any]) -> tuple[resnet.ResNet50, dict[str, Any]]:
    """Give what stays of a model, as `backbone.load` does: the module and its variables."""
    module = resnet.ResNet50(recipe.model.flavour, recipe.model.stage)
    return module, {"params": params["encoder"], "batch_stats": frozen["encoder"]}


def pretrain(config, workdir: str) -> pathlib.Path:
    """Run what the config's `pretrain` group describes; returns the file of weights. Waits as training does."""
    out, recipe = pathlib.Path(workdir), build.on_devices(build.pretrain_recipe(config), config, group="pretrain")
    with loop.alone(out):
        return _pretrain(config, recipe, out)


def _pretrain(config, recipe: pretrain_step.Recipe, out: pathlib.Path) -> pathlib.Path:
    states = draw_states(config)
    fresh, frozen = start(config, recipe, states)
    if recipe.mesh is not None:
        states, frozen = parallel.place((states, frozen), recipe.mesh)
    store, key = checkpoint.Checkpoints(out / "checkpoints"), jax.random.key(config.seed)
    run = loop.start_or_resume(fresh, store, config, build.pretrain_settings, mesh=recipe.mesh, shard=recipe.shard_state)
    parallel.first(lambda: writers.write_json(out / "config.json", options.to_dict(config)))
    kept, all_ = (state.parameter_count(tree) for tree in (run.params["encoder"], run.params))
    parallel.say(f"{config.task.name}: {kept:,} of {all_:,} parameters to keep, {len(states.size)} states, step {int(run.step)}")
    stored = {"config": options.to_dict(config), "input_spec": {"encoder": recipe.model.stage}}
    with loop.session(out) as (writer, stopped):
        run = loop.run(
            lambda run: loop.compiled(step(), recipe, run, states, frozen, key), run, total=config.pretrain.steps,
            log_every=config.train.log_every, save_every=config.train.save_every,
            save=lambda number, run: store.save_latest(number, run, **stored), writer=writer,
            note=lambda mean: f"loss {mean['loss']:.3f}, {mean['explained']:.1%} explained", stopped=stopped,
        )  # fmt: skip
    if int(run.step) < config.pretrain.steps:
        raise SystemExit(f"stopped at step {int(run.step)}; the same command goes on from there")
    average, frozen = parallel.here((run.average, frozen), recipe.mesh)
    parallel.first(lambda: backbone.save(out / "backbone.npz", *trunk(recipe, average, frozen)))
    return out / "backbone.npz"


def main(config, workdir) -> None:
    """Pre-train, and say where the weights are."""
    parallel.initialize()
    parallel.say(f"weights for --config.camera.backbone are in {pretrain(config, build.workdir(config, workdir))}")


if __name__ == "__main__":
    compiling.keep()
    options.run(main, workdir=WORKDIR, user_errors=(*build.USER_ERRORS, loop.NonFiniteError))
