"""The benchmark: what it counts is right, every stage runs, and two files are compared by ratios."""

import json
import time

import jax
import jax.numpy as jnp
import pytest
from test_train_step import tiny_config

from experiments import benchmark
from lala_jax import build, options, scoring


@pytest.fixture
def clock(monkeypatch):
    """Time passes only where a test says so."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def test_medians_and_rates_are_of_one_thing(clock):
    taken = iter([50.0, 1.0, 4.0, 2.0, 9.0])  # the first run warms up

    def run():
        clock[0] += next(taken)

    found = benchmark.measured(benchmark.Work(run, count=2, facts={"flops": 30.0, "memory": 7.0}), repeats=3)
    assert (found["seconds"], found["lowest"], found["highest"], found["runs"], found["count"]) == (1.0, 0.5, 2.0, 3, 2)
    assert found["flops_per_second"] == 15.0 and found["memory"] == 7.0 and "bytes_per_second" not in found
    slow = benchmark.measured(benchmark.Work(lambda: clock.__setitem__(0, clock[0] + 15.0)), repeats=9)
    assert slow["runs"] == 2 and slow["seconds"] == 15.0


def test_xla_counts_what_a_product_takes():
    x = jnp.ones((64, 64))
    work = benchmark.compiled(jnp.matmul, x, x, count=3)
    assert work.facts["flops"] == 2 * 64**3 and work.facts["bytes"] >= 3 * x.nbytes and work.facts["memory"] >= 3 * x.nbytes
    assert work.count == 3 and (work.run() == 64).all()


def small(config):
    """Give a config so small that a stage's time is that of compiling."""
    return options.override(config, ["camera.height=48", "camera.width=64", "map.cell=0.0125", "map.slices=7", "data.threads=1"])


# Of one size, whatever the config; the two methods of correlation are in test_correlation.
SLOW = {"correlate", "correlate-direct", "train-paper", "matmul", "copy"}


@pytest.mark.parametrize("name", [name for name in benchmark.STAGES if name not in SLOW])
def test_every_stage_runs(name, monkeypatch):
    monkeypatch.setattr(benchmark, "FULL", {})
    monkeypatch.setattr(benchmark, "BATCH", 2)
    monkeypatch.setattr(benchmark.recording, "SHARD", 1)
    config = tiny_config()
    params = jax.eval_shape(build.build_policy(config).init, jax.random.key(0))
    monkeypatch.setattr(scoring, "check_checkpoint", lambda *_: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), params))
    row = benchmark.timed(name, benchmark.STAGES[name], config, repeats=1)
    assert "unavailable" in row or row["seconds"] > 0 and row["runs"] == 1
    assert name == "render-mujoco" or "unavailable" not in row
    assert benchmark.table([{**row, "share": {}}]).count("\n") == 2


@pytest.mark.parametrize("name", ["views", "boxes", "cells", "episodes"])
def test_what_grows(name, monkeypatch):
    label, values, prepare = benchmark.GROWTH[name]
    monkeypatch.setitem(benchmark.GROWTH, name, (label, values[:2], prepare))
    found = benchmark.grow(name, small(tiny_config()), repeats=1)
    assert [row["value"] for row in found["rows"]] == list(values[:2]) and all(row["seconds"] > 0 for row in found["rows"])
    assert f"{values[0]}: " in benchmark.growth_table([found])


def test_every_one_of_many_boxes_is_drawn(monkeypatch):
    seen = []
    monkeypatch.setattr(benchmark, "compiled", lambda function, *arguments: seen.append(function(*arguments).rgb))
    config = options.override(tiny_config(), ["camera.height=96", "camera.width=128"])
    for count in (1, 9):
        benchmark.many_boxes(config, count)
    bright = [(image.max(-1) > 0.25).sum() for image in seen]  # the table is darker
    assert bright[0] > 40 and bright[1] == pytest.approx(9 * bright[0], rel=0.5)  # near the cameras and far away


def test_two_files_are_compared_by_ratio(monkeypatch, tmp_path, capsys):
    taken = {"a": 1.0, "b": 2.0}
    stages = {name: benchmark.Stage(name, "thing", lambda config, name=name: benchmark.Work(lambda: None)) for name in taken}
    ceilings = {name: benchmark.STAGES[name] for name in benchmark.CEILINGS}
    monkeypatch.setattr(benchmark, "STAGES", {**ceilings, **stages})
    rates = {"flops_per_second": 1e9, "bytes_per_second": 1e9}

    def timed(name, stage, config, repeats):
        row = {"name": name, "label": stage.label, "unit": stage.unit, "runs": repeats}
        if name == "b" and taken["b"] is None:
            return {**row, "unavailable": "no b here"}
        seconds = taken.get(name, 1.0)
        return {
            **row,
            "seconds": seconds,
            "lowest": seconds,
            "highest": seconds,
            **(rates if name in ceilings else {"flops_per_second": 5e8}),
        }

    monkeypatch.setattr(benchmark, "timed", timed)
    first = benchmark.command(["--task=tower", f"--out={tmp_path}"])
    (path,) = tmp_path.glob("*-tower.json")
    stored = json.loads(path.read_text())
    assert stored == first and stored["versions"]["jax"] == jax.__version__ and stored["stages"][2]["share"] == {"flops": 0.5}
    assert "| a | 1 s a thing | 1 s to 1 s | 5 | 50% |  |" in capsys.readouterr().out
    earlier = tmp_path / "earlier.json"
    path.rename(earlier)
    taken |= {"a": 1.2, "b": 1.0}
    benchmark.command(["--task=tower", f"--out={tmp_path}", f"--against={earlier}"])
    assert "| a | 1.20 |" in capsys.readouterr().out
    taken["b"] = 3.0
    with pytest.raises(SystemExit, match="1"):
        benchmark.command(["--task=tower", f"--out={tmp_path}", f"--against={earlier}", "--stages=b"])
    assert "more than 1.3 times as long: b" in capsys.readouterr().out
    taken["b"] = None
    benchmark.command(["--task=tower", f"--out={tmp_path}", f"--against={earlier}"])
    assert "| b | no b here |" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--against=nothing.json"], "--against=nothing.json is no file of this benchmark"),
        (["--stages=rendr"], "--stages must be one of .*'render', .*did you mean render"),
    ],
)
def test_a_wrong_request_ends_with_one_message(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        benchmark.command(arguments)
    text = " ".join(capsys.readouterr().err.split())
    assert message.split(".*")[0] in text and message.split(".*")[-1] in text


def test_times_read_well():
    assert [benchmark.seconds_text(s) for s in (12.34, 0.0123, 4.56e-5, 1e-9)] == ["12.3 s", "12.3 ms", "45.6 us", "0.001 us"]
