"""The loop of a run, on a step that counts: what is logged, saved and seen, and that a stop loses nothing."""

import json
import os
import signal

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from lala_jax import checkpoint, loop, options, state, writers

CONFIG = options.from_dict({"train": {"rate": 0.5, "log_every": 2}})
STORED = {"config": options.to_dict(CONFIG), "input_spec": {}}


def settings(config):
    return {name: value for name, value in options.fields(config).items() if not name.endswith("every")}


def fresh():
    return state.create({"w": jnp.float32(8.0)}, optax.sgd(0.5))


def go(directory, total, *, signal_at=None, nan_at=None, after=lambda *_: False):
    """Run `w -= w / 2`, each step's loss the step's number; gives the state and the numbers of the steps saved."""
    store, saved = checkpoint.Checkpoints(directory), []

    def step(run):
        number = int(run.step) + 1
        if number == signal_at:
            os.kill(os.getpid(), signal.SIGTERM)
        return state.update(run, run.params, optax.sgd(0.5), average_decay=0.5), {"loss": jnp.nan if number == nan_at else number}

    def save(number, run):
        saved.append(number)
        store.save_latest(number, run, **STORED)

    run = loop.start_or_resume(fresh(), store, CONFIG, settings)
    with writers.Writer(directory, tensorboard=False) as writer, checkpoint.stop_signals() as stopped:
        run = loop.run(step, run, total=total, log_every=2, save_every=3, save=save, note=str, writer=writer, stopped=stopped, after=after)
    return run, saved


def test_logs_means_saves_and_shows_every_step(tmp_path):
    shown = []
    run, saved = go(tmp_path, 5, after=lambda number, run: shown.append((number, int(run.step))))
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [(row["step"], row["loss"]) for row in rows] == [(2, 1.5), (4, 3.5), (5, 5.0)]
    assert saved == [3, 5] and shown == [(number, number) for number in range(1, 6)]
    assert int(run.step) == 5 and float(run.params["w"]) == 8 / 32


def test_a_signal_saves_and_the_same_call_goes_on(tmp_path):
    shown = []
    run, saved = go(tmp_path, 5, signal_at=2, after=lambda number, _: shown.append(number))
    assert int(run.step) == 2 and saved == [2] and shown == [1]
    run, saved = go(tmp_path, 5)
    assert int(run.step) == 5 and saved == [3, 5] and float(run.params["w"]) == 8 / 32
    assert go(tmp_path, 5)[1] == []


def test_what_is_not_finite_is_named_and_not_saved(tmp_path):
    with pytest.raises(loop.NonFiniteError, match="step 3: loss is nan.*before.*lower learning_rate"):
        go(tmp_path, 5, nan_at=3)
    assert checkpoint.Checkpoints(tmp_path).restore_latest(fresh()) is None


def test_only_settings_that_count_are_compared(tmp_path):
    store = checkpoint.Checkpoints(tmp_path)
    store.save_latest(0, fresh(), **STORED)
    found = loop.start_or_resume(fresh(), store, options.override(CONFIG, ["train.log_every=9"]), settings)
    np.testing.assert_array_equal(found.params["w"], 8.0)
    with pytest.raises(checkpoint.CheckpointError, match=r"another train.rate \(0.5 there, 0.25 here\): choose another --workdir"):
        loop.start_or_resume(fresh(), store, options.override(CONFIG, ["train.rate=0.25"]), settings)
