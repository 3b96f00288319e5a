"""Train a policy from demonstrations: `python -m lala_jax.train --config=configs/pallet.py --workdir=runs/pallet`.

Collects the demonstrations if there are none, trains, evaluates, and leaves in the work directory `checkpoints/` (latest and best),
`metrics.jsonl` and TensorBoard events, `scores-policy-val.json`, `episode-val-*.webp`. Started again, it goes on where it stopped, bit
for bit.
"""

from __future__ import annotations

import pathlib
import signal
import time
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich import progress

from lala_jax import build, checkpoint, compiling, dataset, options, recording, scoring, state, train_step, types, writers

step = compiling.jit(train_step.train_step, static_argnums=0, donate_argnums=1)


class NonFiniteError(RuntimeError):
    """The training diverged: a metric that must be finite is not."""


def check_finite(number: int, metrics: Mapping[str, float]) -> None:
    """Raise NonFiniteError naming the step and the first loss (or gradient norm) that is not finite."""
    for name, value in metrics.items():
        if (name.startswith("loss") or name == "grad_norm") and not np.isfinite(value):
            raise NonFiniteError(f"step {number}: {name} is {value}; the last checkpoint is from before; try a lower optim.learning_rate")


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
    fresh = jax.device_put(fresh, jax.devices()[0])  # committed to it, as what is restored: both then run one compiled step
    found = store.restore_latest(fresh)
    if found is None:
        return fresh
    there = build.run_settings(checkpoint.describe(store.directory / "latest" / str(found[0]))["config"])
    here = build.run_settings(writers.plain(options.to_dict(config)))
    if changed := options.differences(there, here):
        raise checkpoint.CheckpointError(f"{store.directory} holds a run with another {', '.join(changed)}: choose another --workdir")
    return found[1]


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
    key, total, seen, begin = jax.random.key(config.seed), config.train.steps, [], time.time()
    columns = (*progress.Progress.get_default_columns(), progress.MofNCompleteColumn(), progress.TextColumn("{task.fields[note]}"))
    with progress.Progress(*columns, speed_estimate_period=600) as bar:
        plain = not bar.console.is_terminal  # a log file gets a line now and then instead of a bar
        shown = bar.add_task("training", total=total, completed=int(run.step), note="compiling")
        for number in range(int(run.step) + 1, total + 1):
            run, metrics = step(recipe, run, states, key, recipe.policy.frozen)
            seen.append(metrics)
            if number % config.train.log_every == 0 or number == total:
                values = mean_metrics(seen, last=number)
                values["seconds_per_step"], seen, begin = (time.time() - begin) / len(seen), [], time.time()
                writer.scalars(number, values)
                note = f"loss {values['loss']:.2f}, pick {values['pick_right']:.2f}, place {values['place_right']:.2f}"
                bar.update(shown, note=note)
                if plain:
                    left = (total - number) * values["seconds_per_step"] / 60
                    print(f"step {number} of {total}: {note}; {left:.0f} minutes left", flush=True)
            bar.update(shown, completed=number)
            leaving = stopped()
            if number % config.train.save_every == 0 or number == total or leaving:
                mean_metrics([metrics], last=number)
                store.save_latest(number, run, **stored)
            if leaving:
                break
            if validation_due(config, number):
                _validate(config, recipe, run, store, stored, writer)
                begin = time.time()
    return run


def validation_due(config, number: int) -> bool:
    """Say whether the parameters after step `number` are scored on the val split."""
    return number % config.train.eval_every == 0 or number == config.train.steps


def was_validated(out: pathlib.Path, number: int) -> bool:
    """Say whether the metrics hold a validation of step `number`."""
    return any(row["step"] == number and "val_score" in row for row in writers.read_metrics(out / "metrics.jsonl"))


def mean_metrics(seen: Sequence[Mapping[str, jax.Array]], *, last: int) -> dict[str, float]:
    """Average the metrics of the steps up to `last`, leaving out NaN where a step did not define one of the accuracies.

    Raises NonFiniteError naming the first step with a loss or gradient norm that is not finite.
    """
    host = [{name: float(value) for name, value in metrics.items()} for metrics in jax.device_get(list(seen))]
    for number, metrics in enumerate(host, last - len(host) + 1):
        check_finite(number, metrics)
    columns = {name: np.array([metrics[name] for metrics in host]) for name in host[0]}
    return {name: float(np.nan if np.isnan(values).all() else np.nanmean(values)) for name, values in columns.items()}


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
    options.run(main, workdir=build.WORKDIR, user_errors=(*build.USER_ERRORS, NonFiniteError))
