"""Train a policy from demonstrations: `python -m lala_jax.train --config=configs/pallet.py --workdir=runs/pallet`.

Collects the demonstrations if there are none, trains, evaluates, and leaves in the work directory `checkpoints/` (latest and best),
`metrics.jsonl` and TensorBoard events, `scores-policy-val.json`, `episode-val-*.webp`. Started again, it goes on where it stopped, bit
for bit. Several devices share every batch, and the processes that a scheduler starts are one run (`parallel`).
"""

from __future__ import annotations

import functools
import json
import pathlib
from collections.abc import Mapping
from typing import Any

import jax

from lala_jax import (
    build,
    checkpoint,
    compiling,
    dataset,
    loop,
    options,
    parallel,
    pretrained,
    recording,
    scoring,
    state,
    train_step,
    types,
    writers,
)


@functools.cache
def step():
    """Jit the training step, once for a process."""
    return compiling.jit_step(train_step.train_step, state=1, static_argnums=0)


def load_states(config: Mapping[str, Any], mesh: jax.sharding.Mesh | None = None) -> types.State:
    """Read the demonstrations (collecting them first where there are none) as training states on every device, leaves `[M, ...]`."""
    directory = parallel.first(lambda: recording.collect(config))
    demos, _ = dataset.load(directory, count=config["data"]["demos"], **build.data_identity(config))
    return parallel.place(types.State(**dataset.stack(demos)), mesh)


def data_fingerprint(states: types.State) -> dict[str, int]:
    """Say in numbers which training states these are: how many, and the checksum of their bytes."""
    return {"states": len(states.size), "crc32": pretrained.checksum(states)}


def _note_start(config, out: pathlib.Path, learnt: Mapping[str, int], *, resumed: bool) -> None:
    """Write the config and what is learnt from; raises CheckpointError where a run that is `resumed` has learnt from something else."""
    path = out / "demonstrations.json"
    if resumed and path.exists() and json.loads(path.read_text()) != learnt:
        text = f"{out} holds a run that learnt from other demonstrations than those in {config.data.directory}: choose another --workdir"
        raise checkpoint.CheckpointError(text)
    writers.write_json(path, learnt)
    writers.write_json(out / "config.json", options.to_dict(config))


def fresh(recipe: train_step.Recipe, seed: int) -> state.TrainState:
    """Draw the parameters of a run that begins."""
    return loop.begin(compiling.draw(recipe.policy.init, seed), recipe.optimizer)


def weights_to_start(config: Mapping[str, Any], recipe: train_step.Recipe) -> Any:
    """Read the parameters at `train.start`, checked against the policy; None where the config names none."""
    path = build.newer(config, "train.start")
    return scoring.check_checkpoint(path, config, recipe.policy) if path else None


def start_or_resume(
    config: Mapping[str, Any], recipe: train_step.Recipe, store: checkpoint.Checkpoints, weights: Any = None
) -> state.TrainState:
    """Make a fresh state, of `weights` where there are any, or restore the newest intact one.

    Raises CheckpointError where that is of a run with other settings. Files of pretrained weights may have been moved meanwhile: what is
    in them counts.
    """
    begun = fresh(recipe, config["seed"]) if weights is None else loop.begin(weights, recipe.optimizer)
    frozen = build.clip_identity(config) | build.backbone_identity(config)
    files = {field for name in frozen for field in build.FILES[name]}

    def settings(config: Mapping[str, Any]) -> dict[str, Any]:
        return {name: value for name, value in build.run_settings(config).items() if name not in files}

    return loop.start_or_resume(begun, store, config, settings, frozen, mesh=recipe.mesh, shard=recipe.shard_state)


def train_and_evaluate(config, workdir: str) -> dict[str, Any]:
    """Run everything a config describes; returns the final evaluation. Waits for another command that has the same work directory."""
    out = pathlib.Path(workdir)
    recipe = build.on_devices(build.recipe(config), config, group="train")
    weights = weights_to_start(config, recipe)  # before hours of recording, whether they will do
    with loop.alone(out):
        return _train_and_evaluate(config, recipe, out, weights)


def _train_and_evaluate(config, recipe: train_step.Recipe, out: pathlib.Path, weights: Any) -> dict[str, Any]:
    states = load_states(config, recipe.mesh)
    store = checkpoint.Checkpoints(out / "checkpoints")
    run = start_or_resume(config, recipe, store, weights)
    learnt = data_fingerprint(parallel.here(states, recipe.mesh))
    parallel.first(lambda: _note_start(config, out, learnt, resumed=int(run.step) > 0))
    count = state.parameter_count(run.params)
    shared = "" if recipe.mesh is None else f", {recipe.mesh.size} devices"
    parallel.say(f"{config.task.name}: {count:,} parameters, {states.size.shape[0]} states, step {int(run.step)}{shared}")
    stored = {"config": options.to_dict(config), "input_spec": build.input_spec(config)}
    with loop.session(out) as (writer, stopped):
        if run.step > 0 and validation_due(config, int(run.step)) and not parallel.first(lambda: was_validated(out, int(run.step))):
            _validate(config, recipe, run, store, stored, writer)  # the last run was stopped between saving and scoring
        run = _loop(config, recipe, run, states, store, stored, writer, stopped)
        if int(run.step) < config.train.steps or parallel.anywhere(stopped()):  # in the last step the state is there, its validation not
            raise SystemExit(f"stopped at step {int(run.step)}; the same command goes on from there")
    params = scoring.check_checkpoint(str(store.directory), config, recipe.policy)
    return parallel.first(lambda: final_scores(config, recipe, params, out))


def _loop(config, recipe, run, states, store, stored, writer, stopped) -> state.TrainState:
    key, frozen = jax.random.key(config.seed), recipe.policy.frozen
    if recipe.mesh is not None:
        frozen = parallel.place(frozen, recipe.mesh)

    def validate(number, run):
        due = validation_due(config, number)
        if due:
            _validate(config, recipe, run, store, stored, writer)
        return due

    return loop.run(
        lambda run: loop.compiled(step(), recipe, run, states, key, frozen), run, total=config.train.steps,
        log_every=config.train.log_every, save_every=config.train.save_every,
        save=lambda number, run: store.save_latest(number, run, **stored), writer=writer,
        note=lambda mean: f"loss {mean['loss']:.2f}, pick {mean['pick_right']:.2f}, place {mean['place_right']:.2f}",
        stopped=stopped, after=validate,
    )  # fmt: skip


def validation_due(config, number: int) -> bool:
    """Say whether the parameters after step `number` are scored on the val split."""
    return number % config.train.eval_every == 0 or number == config.train.steps


def was_validated(out: pathlib.Path, number: int) -> bool:
    """Say whether the metrics hold a validation of step `number`."""
    return any(row["step"] == number and "val_score" in row for row in writers.read_metrics(out / "metrics.jsonl"))


def _validate(config, recipe, run, store, stored, writer) -> None:
    """Score the averaged parameters on val episodes set apart for this and keep them if they are the best."""
    seeds = build.split_seeds("val", build.SELECTION_START, config.train.eval_episodes)
    average = parallel.here(run.average, recipe.mesh)
    result, _ = parallel.first(lambda: scoring.evaluate(
        recipe.policy, average, recipe.observer, seeds=seeds, parallel=config.eval.parallel,
        threads=config.data.threads,
    ))  # fmt: skip
    store.save_best(int(run.step), run, result["score"], **stored)
    if writer is not None:
        writer.scalars(int(run.step), {"val_score": result["score"], "val_complete_percent": result["complete_percent"]})


def final_scores(config, recipe, params, out: pathlib.Path) -> dict[str, Any]:
    """Score the best checkpoint on the config's split, and write the scores and the pictures."""
    fields = config.eval
    seeds = build.split_seeds(fields.split, fields.start, fields.episodes)
    result, strips = scoring.evaluate(
        recipe.policy, params, recipe.observer, seeds=seeds, parallel=fields.parallel, threads=config.data.threads, strips=fields.strips,
        seed=config.seed,
    )  # fmt: skip
    source = str(out / "checkpoints")
    weights = pretrained.fingerprint(source, params)
    scoring.write_scores(config, result, strips, out, agent="policy", split=fields.split, seeds=seeds, source=source, weights=weights)
    return result


def main(config, workdir) -> None:
    """Train and evaluate."""
    parallel.initialize()
    train_and_evaluate(config, build.workdir(config, workdir))


if __name__ == "__main__":
    compiling.keep()
    options.run(main, workdir=build.WORKDIR, user_errors=(*build.USER_ERRORS, loop.NonFiniteError))
