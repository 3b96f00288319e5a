"""A run that can be stopped and goes on: what training and pre-training share."""

from __future__ import annotations

import contextlib
import pathlib
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
import optax
from rich import progress

from lala_jax import checkpoint, cluster, compiling, options, parallel, state, writers

Metrics = Mapping[str, jax.Array]
Step = Callable[[state.TrainState], tuple[state.TrainState, Metrics]]


class NonFiniteError(RuntimeError):
    """The training diverged: a metric that must be finite is not."""


def check_finite(number: int, metrics: Mapping[str, float]) -> None:
    """Raise NonFiniteError naming the step and the first loss (or gradient norm) that is not finite."""
    for name, value in metrics.items():
        if (name.startswith("loss") or name == "grad_norm") and not np.isfinite(value):
            raise NonFiniteError(f"step {number}: {name} is {value}; the last checkpoint is from before; try a lower learning_rate")


def mean_metrics(seen: Sequence[Metrics], *, last: int) -> dict[str, float]:
    """Average the metrics of the steps up to `last`, leaving out NaN where a step did not define one of the accuracies.

    Raises NonFiniteError naming the first step with a loss or gradient norm that is not finite.
    """
    host = [{name: float(value) for name, value in metrics.items()} for metrics in jax.device_get(list(seen))]
    for number, metrics in enumerate(host, last - len(host) + 1):
        check_finite(number, metrics)
    columns = {name: np.array([metrics[name] for metrics in host]) for name in host[0]}
    return {name: float(np.nan if np.isnan(values).all() else np.nanmean(values)) for name, values in columns.items()}


def alone(out: pathlib.Path) -> contextlib.AbstractContextManager[None]:
    """Hold a run's work directory: another command that would write there waits. Of a run's processes the first does it for all."""
    return cluster.exclusive(out) if parallel.is_first() else contextlib.nullcontext()


@contextlib.contextmanager
def session(out: pathlib.Path) -> Iterator[tuple[writers.Writer | None, Callable[[], bool]]]:
    """Give the writer of a run's curves (None in all processes but the first), and whether a signal has asked the run to stop."""
    opened = writers.Writer(out) if parallel.is_first() else contextlib.nullcontext()
    with opened as writer, checkpoint.stop_signals((signal.SIGTERM, signal.SIGINT)) as stopped:
        yield writer, stopped


def begin(params: Any, optimizer: optax.GradientTransformation) -> state.TrainState:
    """Give the state of a run that begins with these parameters; quickly, as `compiling.step_by_step` does it."""
    return compiling.step_by_step(lambda params: state.create(params, optimizer), params)


def start_or_resume(
    fresh: state.TrainState,
    store: checkpoint.Checkpoints,
    config,
    settings: Callable[[Mapping[str, Any]], dict[str, Any]],
    frozen: Mapping[str, Any] | None = None,
    *,
    mesh: jax.sharding.Mesh | None = None,
    shard: bool = False,
) -> state.TrainState:
    """Give the newest intact state of the store, or `fresh`, on the devices of `mesh`, or the one there is (`parallel.place`).

    Raises CheckpointError where what is stored is of a run with other `settings`. `frozen` are entries of the input spec that must be
    those of the run, too.
    """
    frozen = frozen or {}
    fresh = parallel.place(fresh, mesh, shard=shard)  # committed, as what is restored: both then run one compiled step

    def check(stored: Mapping[str, Any]) -> None:
        there = settings(stored["config"]) | options.fields({name: stored["input_spec"].get(name, {}) for name in frozen})
        here = settings(writers.plain(options.to_dict(config))) | options.fields(frozen)
        if changed := options.differences(there, here):
            raise checkpoint.CheckpointError(f"{store.directory} holds a run with another {', '.join(changed)}: choose another --workdir")

    try:
        found = store.restore_latest(fresh)
    except checkpoint.MismatchError:  # the settings say in the user's terms why leaves do not fit
        check(checkpoint.describe(store.directory, which="latest"))
        raise
    if found is None:
        return fresh
    check(checkpoint.describe(store.directory / "latest" / str(found[0])))
    return found[1]


def compiled(jitted, recipe: Any, current: state.TrainState, *inputs: Any) -> Step:
    """Compile `jitted(recipe, state, *inputs)`, whose recipe is static, say what a step needs, and give it as a function of the state."""
    parallel.say("compiling the training step")
    program, facts = compiling.build(jitted, recipe, current, *inputs)
    memory = f"{facts['memory'] / 2**20:,.0f} MiB" if "memory" in facts else "an unknown amount"
    parallel.say(f"compiled in {facts['compile_seconds']:.0f} s; a step needs {memory} of memory")
    return lambda current: program(current, *inputs)


def estimate(steps: int, seconds: float) -> str:
    """Say how long the `steps` left will take, by one that took `seconds`."""
    whole = steps * seconds
    scale, unit = next((one for one in ((3600, "hours"), (60, "minutes")) if whole >= 1.5 * one[0]), (1, "seconds"))
    return f"{steps} more steps of {seconds:.2g} s take about {whole / scale:.3g} {unit}; validation and saving come on top"


def run(
    prepare: Callable[[state.TrainState], Step],
    current: state.TrainState,
    *,
    total: int,
    log_every: int,
    save_every: int,
    save: Callable[[int, state.TrainState], None],
    note: Callable[[Mapping[str, float]], str],
    writer: writers.Writer | None,
    stopped: Callable[[], bool],
    after: Callable[[int, state.TrainState], bool] = lambda *_: False,
) -> state.TrainState:
    """Take steps up to `total`, log means and save now and then; leave early, saved, once `stopped()`.

    `prepare` gives the step for states like `current`; it is called once, if there are steps to take, and its time is theirs. `note`
    puts the means into a few words. `save` and `after` get a step's number and state; `after`, called past every step that did not
    leave, says whether it did anything, the time of which is then not the steps'. Of several processes all run the loop, and leave it at
    the step at which one is `stopped()`; a process without a `writer` says nothing.
    """
    seen, begin, setup = [], time.time(), 0.0
    columns = (*progress.Progress.get_default_columns(), progress.MofNCompleteColumn(), progress.TextColumn("{task.fields[note]}"))
    with progress.Progress(*columns, speed_estimate_period=600, disable=writer is None) as bar:
        plain = not bar.console.is_terminal  # a log file gets a line now and then instead of a bar
        first = int(current.step) + 1
        shown = bar.add_task("training", total=total, completed=first - 1, note="compiling")
        step = None
        for number in range(first, total + 1):
            start = time.time()
            if step is None:
                step = prepare(current)
                setup, start = time.time() - start, time.time()
            current, metrics = step(current)
            seen.append(metrics)
            if number <= first + 1:  # the second one says how long they take: the first may have had something to set up
                jax.block_until_ready((current, metrics))
            if number == first + 1 < total and writer is not None:
                print(estimate(total - number, time.time() - start), flush=True)
            leaving = parallel.anywhere(stopped())
            if number % log_every == 0 or number == total or leaving:
                values = mean_metrics(seen, last=number)
                took, count, seen, begin = time.time() - begin, len(seen), [], time.time()
                values |= {"seconds": took, "seconds_per_step": took / count}
                bar.update(shown, note=note(values))
                if writer is not None:
                    writer.scalars(number, values)
                if writer is not None and plain:
                    left = (total - number) * (took - setup) / count / 60
                    print(f"step {number} of {total}: {note(values)}; {left:.0f} minutes left", flush=True)
                setup = 0.0
            bar.update(shown, completed=number)
            if number % save_every == 0 or number == total or leaving:
                mean_metrics([metrics], last=number)
                save(number, current)
            if leaving:
                break
            pause = time.time()
            if after(number, current):
                begin += time.time() - pause
    return current
