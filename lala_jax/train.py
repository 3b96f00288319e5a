"""Train a policy from demonstrations: `python -m lala_jax.train --config=configs/pallet.py --workdir=runs/pallet`.

Collects the demonstrations if there are none, trains, evaluates, and leaves in the work directory: `checkpoints/` (latest and best),
`metrics.jsonl` and TensorBoard events, `scores-val.json`, `episode-*.webp`. Started again, it goes on where it stopped, bit for bit.
"""

from __future__ import annotations

import pathlib
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich import progress

from lala_jax import build, checkpoint, dataset, options, recording, scoring, state, train_step, types, writers

step = jax.jit(train_step.train_step, static_argnums=0, donate_argnums=1)


class NonFiniteError(RuntimeError):
    """The training diverged: a metric that must be finite is not."""


def check_finite(number: int, metrics: Mapping[str, float]) -> None:
    """Raise NonFiniteError naming the step and the first loss (or gradient norm) that is not finite."""
    for name, value in metrics.items():
        if (name.startswith("loss") or name == "grad_norm") and not np.isfinite(value):
            raise NonFiniteError(f"step {number}: {name} is {value}; the last checkpoint is from before; try a lower optim.learning_rate")


def load_states(config: Mapping[str, Any]) -> types.State:
    """Read the demonstrations (collecting them first where there are none) as training states on the device, leaves `[M, ...]`."""
    directory = pathlib.Path(config["data"]["directory"])
    if not (directory / "meta.json").exists() or dataset.seeds(directory).size < config["data"]["demos"]:
        recording.collect(config)
    identity = {"task": config["task"]["name"], "task_options": build.task_options(config)}
    demos, _ = dataset.load(directory, count=config["data"]["demos"], **identity)
    return jax.tree.map(jnp.asarray, types.State(**dataset.stack(demos)))


def start_or_resume(recipe: train_step.Recipe, store: checkpoint.Checkpoints, seed: int) -> state.TrainState:
    """Make a fresh state, or restore the newest intact one of the same shapes."""
    key = jax.random.key(seed, impl="rbg")  # compiles four times faster than the default generator, once a layer
    fresh = jax.jit(lambda key: state.create(recipe.policy.init(key), recipe.optimizer))(key)
    found = store.restore_latest(fresh)
    return fresh if found is None else found[1]


def train_and_evaluate(config, workdir: str) -> dict[str, Any]:
    """Run everything a config describes; returns the final evaluation."""
    out = pathlib.Path(workdir)
    recipe = build.recipe(config)
    states = load_states(config)
    store = checkpoint.Checkpoints(out / "checkpoints")
    writers.write_json(out / "config.json", options.to_dict(config))
    run = start_or_resume(recipe, store, config.seed)
    count = state.parameter_count(run.params)
    print(f"{config.task.name}: {count:,} parameters, {states.size.shape[0]} states, step {int(run.step)}", flush=True)
    stored = {"config": options.to_dict(config), "input_spec": build.input_spec(config)}
    with writers.Writer(out) as writer, checkpoint.stop_signals() as stopped:
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
            run, metrics = step(recipe, run, states, key)
            seen.append(metrics)
            if number % config.train.log_every == 0 or number == total:
                values = mean_metrics(seen)
                check_finite(number, values)
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
                check_finite(number, mean_metrics([metrics]))
                store.save_latest(number, run, **stored)
            if leaving:
                break
            if number % config.train.eval_every == 0 or number == total:
                _validate(config, recipe, run, store, stored, writer)
                begin = time.time()
    return run


def mean_metrics(seen) -> dict[str, float]:
    """Average a list of metric dicts, leaving out NaN where a step did not define one of the accuracies."""
    host = jax.device_get(seen)
    out = {}
    for name in host[0]:
        values = np.array([float(metrics[name]) for metrics in host])
        strict = name.startswith("loss") or name == "grad_norm"
        out[name] = float(values.mean() if strict or np.isnan(values).all() else np.nanmean(values))
    return out


def _validate(config, recipe, run, store, stored, writer) -> None:
    """Score the averaged parameters on the first val episodes and keep them if they are the best."""
    seeds = build.split_seeds("val", 0, config.train.eval_episodes)
    result, _ = scoring.evaluate(
        recipe.policy, run.average, recipe.observer, seeds=seeds, parallel=min(config.eval.parallel, len(seeds)),
        threads=config.data.threads,
    )  # fmt: skip
    writer.scalars(int(run.step), {"val_score": result["score"], "val_complete_percent": result["complete_percent"]})
    store.save_best(int(run.step), run, result["score"], **stored)


def final_scores(config, recipe, params, out: pathlib.Path) -> dict[str, Any]:
    """Score the best checkpoint on the config's split, and write the scores and the pictures."""
    fields = config.eval
    seeds = build.split_seeds(fields.split, fields.start, fields.episodes)
    parallel = min(fields.parallel, len(seeds))
    result, strips = scoring.evaluate(
        recipe.policy, params, recipe.observer, seeds=seeds, parallel=parallel, threads=config.data.threads, strips=fields.strips
    )
    scoring.write_scores(config, result, strips, out, agent="policy", split=fields.split, seeds=seeds, source=str(out / "checkpoints"))
    return result


def main(config, workdir) -> None:
    """Train and evaluate."""
    train_and_evaluate(config, workdir)


if __name__ == "__main__":
    options.run(main, workdir="runs/train", user_errors=(dataset.DatasetError, checkpoint.CheckpointError, NonFiniteError))
