"""The loop of a run, on a step that counts: what is logged, saved and seen, and that a stop loses nothing."""

import itertools
import json
import os
import re
import signal
import threading
import types

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from experiments import common
from lala_jax import checkpoint, loop, options, pretrain, state, train, writers

CONFIG = options.from_dict({"train": {"rate": 0.5, "log_every": 2}})
STORED = {"config": options.to_dict(CONFIG), "input_spec": {}}


def settings(config):
    return {name: value for name, value in options.fields(config).items() if not name.endswith("every")}


def fresh():
    return state.create({"w": jnp.float32(8.0)}, optax.sgd(0.5))


def go(directory, total, *, signal_at=None, nan_at=None, after=lambda *_: False, prepared=None):
    """Run `w -= w / 2`, each step's loss the step's number; gives the state and the numbers of the steps saved.

    The number of the step it begins after is added to the list `prepared` when the step is asked for.
    """
    store, saved, prepared = checkpoint.Checkpoints(directory), [], [] if prepared is None else prepared

    def step(run):
        number = int(run.step) + 1
        if number == signal_at:
            os.kill(os.getpid(), signal.SIGTERM)
        return state.update(run, run.params, optax.sgd(0.5), average_decay=0.5), {"loss": jnp.nan if number == nan_at else number}

    def save(number, run):
        saved.append(number)
        store.save_latest(number, run, **STORED)

    def prepare(run):
        prepared.append(int(run.step))
        return step

    run = loop.start_or_resume(fresh(), store, CONFIG, settings)
    with writers.Writer(directory, tensorboard=False) as writer, checkpoint.stop_signals() as stopped:
        run = loop.run(
            prepare, run, total=total, log_every=2, save_every=3, save=save, note=str, writer=writer, stopped=stopped, after=after
        )
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


def test_a_step_is_prepared_once_and_only_where_one_is_taken(tmp_path):
    prepared = []
    for total in (2, 5, 5):
        go(tmp_path, total, prepared=prepared)
    assert prepared == [0, 2]


def clocked(monkeypatch, *, compiling, between):
    """Let nothing take time but compiling and what comes between two steps: `prepared` and `after` for `go`."""
    now = [0.0]
    monkeypatch.setattr(loop, "time", types.SimpleNamespace(time=lambda: now[0]))

    class Slow(list):
        def append(self, number):
            now[0] += compiling

    def wait(number, run):
        now[0] += between
        return False

    return Slow(), wait


def test_every_second_of_a_step_is_in_the_curve_however_often_it_was_stopped(tmp_path, monkeypatch):
    """Compiling takes ten minutes; the steps before a stop, and the few after it, are neither lost nor counted twice."""
    slow, wait = clocked(monkeypatch, compiling=600.0, between=1.0)
    for total, stop in ((7, 3), (7, 4), (7, None)):
        go(tmp_path, total, signal_at=stop, prepared=slow, after=wait)
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [(row["step"], row["loss"]) for row in rows] == [(2, 1.5), (3, 3), (4, 4), (6, 5.5), (7, 7)]
    assert common.train_seconds(tmp_path) == 3 * 600.0 + 4  # a second after each step but the last before a stop


def test_what_is_left_is_told_after_two_steps(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(loop, "time", types.SimpleNamespace(time=itertools.count(0, 30).__next__))
    go(tmp_path / "long", 8)
    assert re.findall(r"\d+ more steps of .*?(?=;)", capsys.readouterr().out) == ["6 more steps of 30 s take about 3 minutes"]
    go(tmp_path / "short", 2)
    assert "more steps" not in capsys.readouterr().out
    assert loop.estimate(1000, 0.05).startswith("1000 more steps of 0.05 s take about 50 seconds;")
    assert "about 5.56 hours" in loop.estimate(20_000, 1.0)


def test_compiling_is_not_taken_for_the_pace(tmp_path, capsys, monkeypatch):
    slow, wait = clocked(monkeypatch, compiling=6000.0, between=60.0)
    go(tmp_path, 6, prepared=slow, after=wait)
    assert re.findall(r"step (\d) .*; (\d+) minutes left", capsys.readouterr().out) == [("2", "2"), ("4", "2"), ("6", "0")]
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["seconds_per_step"] for row in rows] == [3030.0, 60.0, 60.0]


def test_the_pace_counts_steps_and_not_what_comes_between_them(tmp_path, monkeypatch):
    """Steps of a second, a validation of a hundred between two logs."""
    clock = itertools.count()
    now = [0.0]
    monkeypatch.setattr(loop.time, "time", lambda: now[0])

    def step_time(run):
        now[0] += 1.0
        return state.update(run, run.params, optax.sgd(0.5), average_decay=0.5), {"loss": float(next(clock))}

    def after(number, _):
        now[0] += 100.0 if number in (3, 4) else 0.0
        return number in (3, 4)

    with writers.Writer(tmp_path, tensorboard=False) as writer:
        loop.run(
            lambda _: step_time, fresh(), total=8, log_every=2, save_every=100, save=lambda *_: None, note=str, writer=writer,
            stopped=lambda: False, after=after,
        )  # fmt: skip
    paces = [json.loads(line)["seconds_per_step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert paces == [1.0] * 4


def test_a_compiled_step_is_one_program_that_says_what_it_needs(capsys):
    traced = []

    def step(rate, run, scale):
        traced.append(rate)
        return run.replace(step=run.step + 1, params=jax.tree.map(lambda w: w - rate * scale * w, run.params)), {}

    take = loop.compiled(jax.jit(step, static_argnums=0), 0.5, fresh(), jnp.float32(1.0))
    run, _ = take(take(fresh())[0])
    assert traced == [0.5] and int(run.step) == 2 and float(run.params["w"]) == 2.0
    assert re.search(r"compiled in \d+ s; a step needs \d+ MiB of memory", capsys.readouterr().out)


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


@pytest.mark.parametrize(
    ("module", "function", "first"), [(train, "train_and_evaluate", "load_states"), (pretrain, "pretrain", "draw_states")]
)
def test_a_second_command_on_a_work_directory_waits(module, function, first, tmp_path, monkeypatch):
    """Until the first lets it go, and reads nothing before."""
    began = threading.Event()

    def begin(*_):
        began.set()
        raise RuntimeError("far enough")

    monkeypatch.setattr(module, first, begin)
    monkeypatch.setattr(train, "weights_to_start", lambda *_: None)
    monkeypatch.setattr(module.build, "recipe", lambda _: None)
    monkeypatch.setattr(module.build, "pretrain_recipe", lambda _: None)
    monkeypatch.setattr(module.build, "on_devices", lambda *_, **__: types.SimpleNamespace(mesh=None))

    def second():
        with pytest.raises(RuntimeError, match="far enough"):
            getattr(module, function)(None, str(tmp_path / "run"))

    thread = threading.Thread(target=second)
    with loop.alone(tmp_path / "run"):
        thread.start()
        assert not began.wait(0.3)
    thread.join(60)
    assert began.is_set() and not list(tmp_path.iterdir())
