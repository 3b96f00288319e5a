"""Train a policy from demonstrations: `python -m lala_jax.train --config=configs/pallet.py --workdir=runs/pallet`.

Collects the demonstrations if there are none, trains, evaluates, and leaves in the work directory `checkpoints/` (latest and best),
`metrics.jsonl` and TensorBoard events, `scores-policy-val.json`, `episode-val-*.webp`. Started again, it goes on where it stopped, bit
for bit.
"""

from __future__ import annotations

import pathlib
import signal
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from lala_jax import build, checkpoint, compiling, dataset, loop, options, recording, scoring, state, train_step, types, writers

step = compiling.jit(train_step.train_step, static_argnums=0, donate_argnums=1)


def load_states(config: Mapping[str, Any]) -> types.State:
    """Read the demonstrations (collecting them first where there are none) as training states on the device, leaves `[M, ...]`."""
    directory = recording.collect(config)
    identity = {"task": config["task"]["name"], "task_options": build.task_options(config)}
    demos, _ = dataset.load(directory, count=config["data"]["demos"], **identity)
    return jax.tree.map(jnp.asarray, types.State(**dataset.stack(demos)))


def start_or_resume(config: Mapping[str, Any], recipe: train_step.Recipe, store: checkpoint.Checkpoints) -> state.TrainState:
    """Make a fresh state, or restore the newest intact one; raises CheckpointError where it is of a run with other settings."""
    key = jax.random.key(config["seed"], impl="rbg")  # compiles four times faster than the default generator, once a layer
    fresh = jax.jit(lambda key: state.create(recipe.policy.init(key), recipe.optimizer))(key)
    return loop.start_or_resume(fresh, store, config, build.run_settings, build.clip_identity(config))


def train_and_evaluate(config, workdir: str) -> dict[str, Any]:
    """Run everything a config describes; returns the final evaluation."""
    out = pathlib.Path(workdir)
    recipe = build.recipe(config)
    states = load_states(config)
    store = checkpoint.Checkpoints(out / "checkpoints")
    run = start_or_resume(config, recipe, store)
    writers.write_json(out / "config.json", options.to_dict(config))
    count = state.parameter_count(run.params)
    print(f"{config.task.name}: {count:,} parameters, {states.size.shape[0]} states, step {int(run.step)}", flush=True)
    stored = {"config": options.to_dict(config), "input_spec": build.input_spec(config)}
    with writers.Writer(out) as writer, checkpoint.stop_signals((signal.SIGTERM, signal.SIGINT)) as stopped:
        if run.step > 0 and validation_due(config, int(run.step)) and not was_validated(out, int(run.step)):
            _validate(config, recipe, run, store, stored, writer)  # the last run was stopped between saving and scoring
        run = _loop(config, recipe, run, states, store, stored, writer, stopped)
        if int(run.step) < config.train.steps:
            raise SystemExit(f"stopped at step {int(run.step)}; the same command goes on from there")
    params = scoring.check_checkpoint(str(store.directory), config, recipe.policy)
    return final_scores(config, recipe, params, out)


def _loop(config, recipe, run, states, store, stored, writer, stopped) -> state.TrainState:
    key = jax.random.key(config.seed)

    def validate(number, run):
        due = validation_due(config, number)
        if due:
            _validate(config, recipe, run, store, stored, writer)
        return due

    return loop.run(
        lambda run: loop.compiled(step, recipe, run, states, key, recipe.policy.frozen), run, total=config.train.steps,
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
    result, _ = scoring.evaluate(
        recipe.policy, run.average, recipe.observer, seeds=seeds, parallel=config.eval.parallel,
        threads=config.data.threads,
    )  # fmt: skip
    store.save_best(int(run.step), run, result["score"], **stored)
    writer.scalars(int(run.step), {"val_score": result["score"], "val_complete_percent": result["complete_percent"]})


def final_scores(config, recipe, params, out: pathlib.Path) -> dict[str, Any]:
    """Score the best checkpoint on the config's split, and write the scores and the pictures."""
    fields = config.eval
    seeds = build.split_seeds(fields.split, fields.start, fields.episodes)
    result, strips = scoring.evaluate(
        recipe.policy, params, recipe.observer, seeds=seeds, parallel=fields.parallel, threads=config.data.threads, strips=fields.strips,
        seed=config.seed,
    )  # fmt: skip
    scoring.write_scores(config, result, strips, out, agent="policy", split=fields.split, seeds=seeds, source=str(out / "checkpoints"))
    return result


def main(config, workdir) -> None:
    """Train and evaluate."""
    train_and_evaluate(config, build.workdir(config, workdir))


if __name__ == "__main__":
    compiling.keep()
    options.run(main, workdir=build.WORKDIR, user_errors=(*build.USER_ERRORS, loop.NonFiniteError))
