"""The benchmark: what it counts is right, every stage runs, targets are judged, and two files are compared by ratios."""

import io
import itertools
import json
import mmap
import sys
import time
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train_step import tiny_config

from experiments import benchmark, benchmark_stages, benchmark_targets, timing
from lala_jax import build, compiling, options, scoring
from lala_jax.sim import robot


@pytest.fixture
def clock(monkeypatch):
    """Time passes only where a test says so."""
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    return now


def test_medians_and_rates_are_of_one_thing(clock):
    taken = iter([3.0, 1.0, 1.0, 1.0, 4.0, 2.0, 9.0])  # the first three runs warm up

    def run():
        clock[0] += next(taken)

    found = timing.measured(timing.Work(run, count=2, facts={"flops": 30.0, "memory": 7.0}), repeats=3)
    assert (found["seconds"], found["lowest"], found["highest"], found["runs"], found["count"]) == (1.0, 0.5, 2.0, 3, 2)
    assert found["flops_per_second"] == 15.0 and found["memory"] == 7.0 and "bytes_per_second" not in found


@pytest.mark.parametrize("seconds, runs, calls", [(3.0, 7, 9), (15.0, 3, 4), (30.0, 3, 4), (70.0, 1, 1)])
def test_what_is_slow_is_not_repeated(clock, seconds, runs, calls):
    called = []

    def run():
        called.append(None)
        clock[0] += seconds

    found = timing.measured(timing.Work(run), repeats=9)
    assert found["runs"] == runs and found["seconds"] == seconds and len(called) == calls
    found = timing.measured(timing.Work(run, cold=True, more=run), repeats=9)
    assert found["runs"] == 1 and found["seconds"] == seconds and len(called) == calls + 2


def test_xla_counts_what_a_product_takes():
    x = jnp.ones((64, 64))
    work = timing.compiled(jnp.matmul, x, x, count=3)
    assert work.facts["flops"] == 2 * 64**3 and work.facts["bytes"] >= 3 * x.nbytes and work.facts["memory"] >= 3 * x.nbytes
    assert work.count == 3 and (work.run() == 64).all()
    looped = timing.compiled(lambda x: jax.lax.map(jnp.sin, x), x)  # of which XLA counts one round
    assert looped.facts["bytes"] == 2 * x.nbytes <= looped.facts["memory"]


def test_each_run_of_steps_goes_on_from_the_last():
    seen = []

    def step(run, by):
        jax.debug.callback(lambda now: seen.append(float(now)), run)
        return run + by, run

    work = timing.stepping(jax.jit(step), jnp.float32(1.0), jnp.float32(2.0), count=3)
    for _ in range(3):
        work.run()
    jax.effects_barrier()
    assert seen == [1.0, 3.0, 5.0] and work.count == 3


def test_what_is_compiled_again_is_counted():
    sizes, jitted = itertools.count(10), jax.jit(lambda x: x * 2)
    assert timing.measured(timing.Work(lambda: jitted(np.zeros(3))), 2)["recompiled"] == 0
    assert timing.measured(timing.Work(lambda: jitted(np.zeros(next(sizes)))), 2)["recompiled"] == 3
    cold = timing.Work(lambda: jitted(np.zeros(3)), cold=True, more=lambda: jitted(np.zeros(next(sizes))))
    assert timing.measured(cold, 2)["recompiled"] == 1


def test_a_process_of_its_own(monkeypatch):
    """The row comes back with what it took; what fails, takes too long or lacks a module is unavailable and says why."""
    config, stage = tiny_config(), benchmark_stages.STAGES["import"]
    row = timing.alone("import", stage, config, 1)
    assert row["seconds"] > 0 and row["runs"] == 1
    assert "process_memory" not in row  # of the Python that it starts
    grown = timing.alone("boxes=2", stage, small(config), 1)
    assert grown["seconds"] > 0 and grown["count"] == 1
    assert sys.platform != "linux" or 0 < grown["process_memory"] < 1 << 30
    with pytest.raises(timing.Unavailable, match="ended with status 1: KeyError: 'no-such'"):
        timing.alone("no-such", stage, config, 1)
    monkeypatch.setattr(timing, "LIMIT", 0.01)
    with pytest.raises(timing.Unavailable, match="not done after 0 s"):
        timing.alone("import", stage, config, 1)


def test_a_stage_runs_apart_from_the_others_where_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(timing, "alone", lambda name, stage, config, repeats: {"seconds": 3.0, "alone": name})
    stages = {"a": timing.Stage("a thing", "thing", lambda config: timing.Work(lambda: None))}
    assert timing.timed("a", stages, None, 1, apart=True)["alone"] == "a" and "alone" not in timing.timed("a", stages, None, 1)
    elsewhere = {"a": timing.Stage("a thing", "thing", pytest.fail, platform="tpu")}
    assert timing.timed("a", elsewhere, None, 1, apart=True)["unavailable"] == "needs a TPU"
    monkeypatch.setattr(benchmark_stages.pretrained, "names", lambda: ["pallet"])  # a user's task has none
    row = timing.timed("evaluate", benchmark_stages.STAGES, tiny_config(), 1)
    assert row["unavailable"] == "needs weights of tower in the package, which has pallet" and "failed" not in row
    monkeypatch.setattr(timing, "alone", lambda name, *_: {"seconds": 1.0, "name": name})
    found = benchmark_stages.grow("cells", None, 1, apart=True)
    assert [row["name"] for row in found["rows"]] == ["cells=80", "cells=160", "cells=320", "cells=640"]


def test_what_is_not_installed_is_named(monkeypatch, capsys):
    stage = timing.Stage("a thing", "thing", lambda config: None, alone=True, needs=("no_such_module",))
    request = {"name": "a", "config": options.to_dict(tiny_config()), "repeats": 1}
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(request)))
    timing.serve({"a": stage})
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["unavailable"].startswith("needs no_such_module: ")
    monkeypatch.setattr(timing.subprocess, "run", lambda *_, **__: types.SimpleNamespace(returncode=0, stdout=json.dumps(said)))
    assert timing.timed("a", {"a": stage}, tiny_config(), 1) == {"name": "a", "label": "a thing", "unit": "thing", **said}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says how much memory a process took")
def test_the_peak_is_what_came_after():
    """400 MB taken and given back before are not in it, 200 MB after are."""

    def take(size):
        with mmap.mmap(-1, size) as block:  # what malloc gives may be memory that the process has kept
            for place in range(0, size, mmap.PAGESIZE):
                block[place] = 1

    take(400_000_000)
    timing.forget_peak()
    base = timing.memory("VmRSS")
    take(200_000_000)
    assert 1.8e8 < timing.memory("VmHWM") - base < 3e8


def test_memory_of_the_device_is_told_where_it_counts(monkeypatch):
    assert timing.device_memory() == {} or jax.default_backend() != "cpu"
    monkeypatch.setattr(jax, "devices", lambda: [types.SimpleNamespace(memory_stats=lambda: {"peak_bytes_in_use": 5, "bytes_in_use": 3})])
    assert timing.device_memory() == timing.device_memory({"device_memory_peak": 4.0}) == {"device_memory_peak": 5.0}
    assert timing.device_memory({"device_memory_peak": 5.0}) == {}  # an earlier stage's


def test_mujoco_renders_the_arm_where_we_do(monkeypatch):
    """The arm is at home, as our renderer has it, and every camera is seen in colour and in depth."""
    seen = []

    class Renderer:
        def __init__(self, model, height, width):
            self.model, self.depth, self.size = model, None, (height, width)
            assert model.vis.quality.offsamples == 3

        def enable_depth_rendering(self):
            self.depth = True

        def disable_depth_rendering(self):
            self.depth = False

        def update_scene(self, data, camera):
            seen.append((camera, self.depth, self.size, data.qpos[robot.Arm(self.model).qpos].copy(), data.ncon))

        def render(self):
            return np.zeros(self.size)

        def close(self):
            pass

    monkeypatch.setattr(benchmark_stages.mujoco, "Renderer", Renderer)
    for task in ("tower", "pallet"):
        seen.clear()
        config = options.load(f"configs/{task}.py")
        benchmark_stages.render_mujoco(benchmark_stages.full_size(config), samples=3).run()
        assert [(camera, depth) for camera, depth, *_ in seen] == [(f"camera{i}", depth) for i in range(4) for depth in (False, True)]
        for _, _, size, joints, _ in seen:
            assert size == (480, 640)
            np.testing.assert_array_equal(joints, robot.HOME)


def small(config):
    """Give a config so small that a stage's time is that of compiling."""
    return options.override(config, ["camera.height=48", "camera.width=64", "map.cell=0.0125", "map.slices=7", "data.threads=1"])


# Of one size, whatever the config; the two methods of correlation are in test_correlation, PyTorch's in test_benchmark_torch.
FIXED = {"matmul", "copy", "correlate", "correlate-direct", "correlate-torch", "train-paper", "train-paper-network"}
FIXED |= {"train-paper-torch", "train-paper-torch-given-back"}
SLOW = {"first-step", "first-step-cached"}  # compile in processes of their own
NAMES = [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in benchmark_stages.STAGES if name not in FIXED]


@pytest.mark.parametrize("name", NAMES)
def test_every_stage_runs(name, monkeypatch):
    monkeypatch.setattr(benchmark_stages, "FULL", {})
    monkeypatch.setattr(benchmark_stages, "BATCH", 2)
    monkeypatch.setattr(benchmark_stages, "EPISODES", 4)
    monkeypatch.setattr(benchmark_stages.recording, "SHARD", 1)
    config = tiny_config()
    params = jax.eval_shape(build.build_policy(config).init, jax.random.key(0))
    monkeypatch.setattr(scoring, "check_checkpoint", lambda *_: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), params))
    row = timing.timed(name, benchmark_stages.STAGES, config, repeats=1)
    assert "unavailable" in row or row["seconds"] > 0 and row["runs"] == 1 and row["recompiled"] == 0
    elsewhere = benchmark_stages.STAGES[name].platform not in ("", jax.default_backend())
    assert name.startswith("render-mujoco") or row.get("unavailable") == ("needs a GPU" if elsewhere else None)
    assert benchmark.table([{**row, "share": {}}]).count("\n") == 2


@pytest.mark.parametrize("name, count", [("observe-many", 64), ("train-many", 64)])
def test_what_is_timed_on_a_gpu_runs_here_too(name, count, monkeypatch):
    monkeypatch.setattr(benchmark_stages, "FULL", {})
    config = tiny_config("model.name=graph", "model.width=8")  # which compiles fast
    row = timing.measured(benchmark_stages.STAGES[name].prepare(config), 1)
    assert row["count"] == count and row["seconds"] > 0


def test_the_papers_network_learns_from_several_examples_in_bfloat16():
    sizes = {"yaw_bins": 2, "crop": 4, "channels": 2, "width": 8, "stages": 1}
    works = [benchmark_stages.paper_network(None, rows=16, cols=8, batch=n, dtype=jnp.bfloat16, **sizes) for n in (1, 3)]
    assert [timing.measured(work, 1)["count"] for work in works] == [1, 3]
    assert works[1].facts["flops"] == pytest.approx(3 * works[0].facts["flops"], rel=0.05)


def test_the_papers_network_takes_adams_steps(monkeypatch):
    """What is timed trains: its first step moves every parameter that has a gradient by the learning rate, as Adam's does."""
    found = []
    monkeypatch.setattr(timing, "stepping", lambda step, run, *inputs, **_: found.append((run, step(run, *inputs)[0])))
    sizes = {"yaw_bins": 2, "crop": 4, "channels": 2, "width": 8, "stages": 1}
    monkeypatch.setattr(compiling, "jit_step", jax.jit)  # nothing donated: both are looked at
    benchmark_stages.paper_network(None, rows=16, cols=8, **sizes)
    (((before, _), (after, _)),) = found
    moved = np.concatenate([np.abs(a - b).ravel() for a, b in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True)])
    assert np.median(moved) == pytest.approx(1e-4, rel=1e-2) and moved.max() < 1.1e-4
    example = benchmark_stages.paper_example(16, 8)
    assert (example["current"][..., 3:] == example["current"][..., 3:4]).all() and example["goal"].shape == (16, 8, 6)


@pytest.mark.parametrize("name", ["views", "boxes", "cells", "episodes"])
def test_what_grows(name, monkeypatch):
    label, values, prepare = benchmark_stages.GROWTH[name]
    monkeypatch.setitem(benchmark_stages.GROWTH, name, (label, values[:2], prepare))
    found = benchmark_stages.grow(name, small(tiny_config()), repeats=1)
    assert [row["value"] for row in found["rows"]] == list(values[:2]) and all(row["seconds"] > 0 for row in found["rows"])
    assert f"{values[0]}: " in benchmark.growth_table([found])
    gone = {**found, "rows": [*found["rows"][:1], {"value": 7, "unavailable": "not done after 900 s"}]}
    assert benchmark.growth_table([gone]).endswith(", 7: not done after 900 s |")


def test_every_one_of_many_boxes_is_drawn(monkeypatch):
    seen = []
    monkeypatch.setattr(timing, "compiled", lambda function, *arguments: seen.append(function(*arguments).rgb))
    config = options.override(tiny_config(), ["camera.height=96", "camera.width=128"])
    for count in (1, 9):
        benchmark_stages.many_boxes(config, count)
    bright = [(image.max(-1) > 0.25).sum() for image in seen]  # the table is darker
    assert bright[0] > 40 and bright[1] == pytest.approx(9 * bright[0], rel=0.5)  # near the cameras and far away


def test_two_files_are_compared_by_ratio(monkeypatch, tmp_path, capsys):
    taken = {"a": 1.0, "b": 2.0}
    stages = {name: timing.Stage(name, "thing", lambda config, name=name: timing.Work(lambda: None)) for name in taken}
    ceilings = {name: benchmark_stages.STAGES[name] for name in benchmark_stages.CEILINGS}
    monkeypatch.setattr(benchmark_stages, "STAGES", {**ceilings, **stages})
    rates = {"flops_per_second": 1e9, "bytes_per_second": 1e9}

    def timed(name, stages, config, repeats, *, apart):
        assert apart == (jax.default_backend() == "cpu")
        row = {"name": name, "label": stages[name].label, "unit": stages[name].unit, "runs": repeats, "recompiled": 0}
        if name == "b" and taken["b"] == "stopped":
            raise KeyboardInterrupt
        if name == "b" and taken["b"] in (None, "broken"):
            return {**row, "unavailable": "no b here"} | ({"failed": True} if taken["b"] else {})
        seconds = taken.get(name, 1.0)
        return {
            **row,
            "seconds": seconds,
            "lowest": seconds,
            "highest": seconds,
            **(rates if name in ceilings else {"flops_per_second": 5e8}),
        }

    monkeypatch.setattr(timing, "timed", timed)
    first = benchmark.command(["--task=tower", f"--out={tmp_path}"])
    (path,) = tmp_path.glob("*-tower.json")
    stored = json.loads(path.read_text())
    assert stored == first and stored["versions"]["jax"] == jax.__version__ and stored["stages"][2]["share"] == {"flops": 0.5}
    said = capsys.readouterr().out
    assert "| a | 1 s a thing | 1 s to 1 s | 5 | 50% |  |" in said
    assert "| programs compiled again after a first run | 0 | at most 0 | yes |" in said and "render-mujoco was not timed" in said
    assert len(stored["targets"]) == len(benchmark_targets.TARGETS)
    earlier = tmp_path / "earlier.json"
    path.rename(earlier)
    taken |= {"a": 1.2, "b": 1.0}
    benchmark.command(["--task=tower", f"--out={tmp_path}", f"--against={earlier}"])
    assert "| a | 1.20 |" in capsys.readouterr().out
    taken["b"] = 3.0
    with pytest.raises(SystemExit, match="1"):
        benchmark.command(["--task=tower", f"--out={tmp_path / 'some'}", f"--against={earlier}", "--stages=b"])
    assert "more than 1.3 times as long: b" in capsys.readouterr().out
    worse, better = ({**stored, "growth": [{"name": "views", "rows": [{"value": 4, "seconds": s}]}]} for s in (3.0, 1.0))
    for name, file in (("worse", worse), ("better", better)):
        (tmp_path / f"{name}.json").write_text(json.dumps(file))
    both = ["--task=tower", f"--against={tmp_path / 'worse.json'}", f"--timed={tmp_path / 'better.json'}"]
    assert benchmark.command(both) == better and "| a | 1.00 |" in (said := capsys.readouterr().out) and "| views 4 | 0.33 |" in said
    with pytest.raises(SystemExit, match="1"):
        benchmark.command([*both[:1], f"--against={tmp_path / 'better.json'}", f"--timed={tmp_path / 'worse.json'}"])
    assert "more than 1.3 times as long: views 4" in capsys.readouterr().out
    (tmp_path / "other.json").write_text(json.dumps({**stored, "processor": "a slow one"}))
    with pytest.raises(SystemExit, match="2"):
        benchmark.command([*both[:2], f"--timed={tmp_path / 'other.json'}"])
    assert f"--against holds {stored['processor']}, --timed holds a slow one" in " ".join(capsys.readouterr().err.split())
    whole = path.read_bytes()
    for other, message in (
        ({"task": "pallet"}, "--against holds pallet on cpu, "),
        ({"processors": 96}, "--against holds tower on cpu, 96 processors, this is tower on cpu, "),
        ({"processor": "a slow one"}, f"--against holds a slow one, this is {stored['processor']}: their ratio says nothing"),
        ({"stages": stored["stages"][:2]}, "--against holds times of none of the stages b"),
    ):  # before anything is timed
        (tmp_path / "other.json").write_text(json.dumps({**stored, **other}))
        with pytest.raises(SystemExit, match="2"):
            benchmark.command(["--task=tower", f"--out={tmp_path / 'some'}", f"--against={tmp_path / 'other.json'}", "--stages=b"])
        said = capsys.readouterr()
        assert message in " ".join(said.err.split()) and not said.out
    with pytest.raises(SystemExit, match="2"):
        benchmark.command(["--task=tower", f"--out={tmp_path}", "--stages=b"])
    said = capsys.readouterr()
    assert f"{path} holds stages that --stages=b leaves out: a; give another --out" in said.err and not said.out
    assert path.read_bytes() == whole
    taken["b"] = None
    benchmark.command(["--task=tower", f"--out={tmp_path}", f"--against={earlier}"])
    assert "| b | no b here |" in capsys.readouterr().out
    taken["b"] = "broken"
    with pytest.raises(SystemExit, match="1"):
        benchmark.command(["--task=tower", f"--out={tmp_path}", f"--against={earlier}"])
    assert "b no longer runs: no b here" in capsys.readouterr().out
    whole, taken["b"] = path.read_bytes(), "stopped"
    with pytest.raises(SystemExit, match="130"):
        benchmark.command(["--task=tower", f"--out={tmp_path}"])
    part = path.with_suffix(".part.json")
    assert path.read_bytes() == whole and [row["name"] for row in json.loads(part.read_text())["stages"]] == [*ceilings, "a"]
    taken["b"] = 1.0
    assert benchmark.command(["--task=tower", f"--out={tmp_path}"]) == json.loads(path.read_text()) and not part.exists()
    path.write_text(json.dumps({**stored, "growth": [{"name": "views"}]}))
    with pytest.raises(SystemExit, match="2"):
        benchmark.command(["--task=tower", f"--out={tmp_path}"])
    assert f"{path} holds how cost grows, which this leaves out: give --growth=true or another --out" in capsys.readouterr().err
    assert json.loads(path.read_text())["growth"] == [{"name": "views"}]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--against=nothing.json"], "--against=nothing.json is no file of this benchmark"),
        (["--repeats=0"], "--repeats must be at least 1, got 0"),
        (["--timed=now.json"], "--timed=now.json is compared with --against=FILE, which is not given"),
        (["--stages=rendr"], "--stages must be one of .*'render', .*did you mean render"),
    ],
)
def test_a_wrong_request_ends_with_one_message(arguments, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        benchmark.command(arguments)
    text = " ".join(capsys.readouterr().err.split())
    assert message.split(".*")[0] in text and message.split(".*")[-1] in text


def judge(name, rows, task="tower", platform="cpu", *, label=""):
    """Judge the one target whose first stage is `name` and whose label has `label`, and give its line of the table, too."""
    (target,) = [target for target in benchmark_targets.TARGETS if target.stages[:1] == (name,) and label in target.label]
    found = benchmark_targets.judged(target, rows, task, platform)
    return found, benchmark_targets.table([found]).splitlines()[-1]


def rows_of(**seconds):
    return [{"name": name.replace("_", "-"), "seconds": value, "recompiled": 0} for name, value in seconds.items()]


def test_targets_are_met_or_missed_and_nothing_is_hidden():
    found, line = judge("render-mujoco", rows_of(render=0.01, render_mujoco=0.2))
    assert found["value"] == pytest.approx(20) and found["met"] and line.endswith("| 20 times | at least 10 times | yes |")
    found, line = judge("render-mujoco", rows_of(render=0.01, render_mujoco=0.05))
    assert not found["met"] and line.endswith("| 5 times | at least 10 times | MISSED |")
    found, line = judge("inputs", rows_of(inputs=0.03, train=0.1))
    assert not found["met"] and line.endswith("| 30.0% | at most 15.0% | MISSED |")
    found, line = judge("evaluate", rows_of(evaluate=1.5))
    assert found["met"] and line.endswith("| 150 s | at most 180 s | yes |")
    assert judge("collect", rows_of(collect=0.4))[0]["met"] and not judge("collect", rows_of(collect=0.6))[0]["met"]
    again = [*rows_of(render=1.0), {"name": "act", "seconds": 1.0, "recompiled": 2}, {"name": "save", "unavailable": "why"}]
    (target,) = [target for target in benchmark_targets.TARGETS if not target.stages]
    found = benchmark_targets.judged(target, again, "tower", "cpu")
    assert found["value"] == 2 and not found["met"]


def test_a_target_that_cannot_be_judged_says_why():
    gone = [*rows_of(render=0.01), {"name": "render-mujoco", "unavailable": "no OpenGL"}]
    assert judge("render-mujoco", gone)[1].endswith("| render-mujoco: no OpenGL | at least 10 times | unknown |")
    assert judge("observe", [])[0]["unavailable"] == "observe was not timed"
    assert judge("collect", rows_of(collect=0.1), "pallet")[0]["unavailable"] == "measured with --task=tower"
    paper = rows_of(train_paper_torch=8.0, train_paper_torch_given_back=7.0, train_paper_network=1.0)
    both = [target for target in benchmark_targets.TARGETS if "train-paper-torch" in target.stages]
    speed, size = (benchmark_targets.judged(target, paper, "tower", "cpu") for target in both)
    assert speed["met"] and size["unavailable"] == "this machine does not tell 'process_memory'" and "met" not in size
    assert speed["value"] == 7.0  # the better of PyTorch's two ways
    for row, memory in zip(paper, (5e9, 4e9, 4.2e9), strict=True):
        row["process_memory"] = memory
    assert not benchmark_targets.judged(both[1], paper, "tower", "cpu")["met"]


def test_some_targets_are_about_one_kind_of_machine():
    rows = rows_of(train_paper_bfloat16=0.009)
    assert judge("train-paper-bfloat16", rows, platform="gpu", label="a sample")[1].endswith("| 9 ms | at most 10 ms | yes |")
    assert judge("train-paper-bfloat16", rows, platform="gpu", label="20,000")[1].endswith("| 180 s | at most 240 s | yes |")
    assert judge("train-paper-bfloat16", rows, label="a sample")[1].endswith("| about a GPU | at most 10 ms | unknown |")
    assert judge("render-mujoco", [], platform="gpu")[0]["unavailable"] == "about a CPU"
    fast = [{"name": name, "flops_per_second": value} for name, value in (("train-paper-bfloat16", 3.0), ("matmul-bfloat16", 10.0))]
    assert judge("train-paper-bfloat16", fast, platform="gpu", label="rate")[1].endswith("| 30.0% | at least 35.0% | MISSED |")


def test_a_stage_that_breaks_down_leaves_the_others(monkeypatch, capsys):
    """In this process, as on a GPU: what takes more memory than there is. In one of its own: what ends badly or late."""

    def broken(config):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: too much\nand more")

    def no_start(config):
        raise timing.Unavailable("a first training step ended with status 1: no device", failed=True)

    stages = {"a": timing.Stage("a", "thing", broken), "b": timing.Stage("b", "thing", no_start)}
    row = {"name": "a", "label": "a", "unit": "thing", "failed": True}
    request = {"name": "b", "config": options.to_dict(tiny_config()), "repeats": 1}
    monkeypatch.setattr(sys, "stdin", io.StringIO(json.dumps(request)))
    timing.serve(stages)
    said = capsys.readouterr().out.splitlines()[-1]
    with monkeypatch.context() as own:
        own.setattr(timing.subprocess, "run", lambda *_, **__: types.SimpleNamespace(returncode=0, stdout=said))
        assert timing.timed("b", stages, tiny_config(), 1, apart=True)["failed"]
    assert timing.timed("a", stages, None, 1) == {**row, "unavailable": "RESOURCE_EXHAUSTED: too much"}
    done = types.SimpleNamespace(returncode=-9, stderr="")
    monkeypatch.setattr(timing.subprocess, "run", lambda *_, **__: done)
    assert timing.timed("a", stages, tiny_config(), 1, apart=True) == {**row, "unavailable": "ended with status -9: "}


def test_a_stage_for_another_kind_of_machine_is_left_out():
    stages = {"a": timing.Stage("a", "thing", pytest.fail, platform="tpu")}
    assert timing.timed("a", stages, None, 1)["unavailable"] == "needs a TPU"


def test_the_machines_own_rate_is_its_fastest():
    """A stage in bfloat16 is compared with a product in bfloat16, where that was timed; no share is above all."""
    rows = [{"name": name, "unit": "", "recompiled": 0, "seconds": 1.0, "flops_per_second": rate} for name, rate in
            (("matmul", 50.0), ("matmul-bfloat16", 700.0), ("train-paper-bfloat16", 350.0))]  # fmt: skip
    assert [row["share"]["flops"] for row in benchmark.judged(rows, "tower")["stages"]] == [50 / 700, 1.0, 0.5]
    assert benchmark.judged(rows[::2], "tower")["stages"][1]["share"]["flops"] == 7.0


def test_ceilings_are_compared_but_not_judged(capsys):
    before, after = ({"stages": rows_of(copy=value, render=1.0)} for value in (1.0, 2.0))
    assert benchmark.slower(before, after, 1.3) == [] and "| copy | 2.00 |" in capsys.readouterr().out


def test_targets_name_stages_that_there_are():
    for target in benchmark_targets.TARGETS:
        assert set(target.stages) <= set(benchmark_stages.STAGES) and target.unit in benchmark_targets.UNITS


def test_times_read_well():
    assert [benchmark_targets.seconds_text(s) for s in (12.34, 0.0123, 4.56e-5, 1e-9)] == ["12.3 s", "12.3 ms", "45.6 us", "0.001 us"]
