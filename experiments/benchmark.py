"""What every stage costs, alone and together: `python -m experiments.benchmark --task=pallet`.

Times the stages of `STAGES` at the sizes of `configs/<task>.py`, and with `--growth=true` those of `GROWTH` over a range of sizes; a matrix
product and a copy of the same run say how much of the machine's own rate a stage reaches. Writes `<device>-<task>.json` to `--out` and
prints its tables. `--stages=render,fuse` times only these (and the two ceilings). `--against=FILE` compares with an earlier file by
ratios of medians, and ends with status 1 where a stage takes more than `--limit` times as long.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.metadata
import itertools
import json
import os
import pathlib
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from experiments import common
from lala_jax import build, checkpoint, compiling, options, policy, recording, rollout, scoring, state, train_step, types, writers
from lala_jax.models import correlation
from lala_jax.perception import topdown
from lala_jax.sim import oracle, physics, render, scene

BATCH = 8  # observations at a time, where a stage takes several
SECONDS = 20.0  # after so long a stage is not repeated again
FULL = {"camera.height": 480, "camera.width": 640}  # the cameras' own resolution
LIBRARIES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")
FLAGS = {
    "task": "pallet",
    "stages": "",
    "growth": False,
    "repeats": 5,
    "against": "",
    "limit": 1.3,
    "out": "experiments/results/benchmark",
}


class Unavailable(RuntimeError):
    """What a stage needs is not on this machine."""


@dataclasses.dataclass(frozen=True)
class Work:
    """Something to time."""

    run: Callable[[], Any]  # does it once and waits for the result
    count: int = 1  # things that one run does
    facts: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of one run: flops, bytes, memory; and compile_seconds
    close: Callable[[], Any] = lambda: None  # gives back what it took


@dataclasses.dataclass(frozen=True)
class Stage:
    """A row: what is timed, and what one of it is."""

    label: str
    unit: str
    prepare: Callable[[Any], Work]


def main(config, workdir, *, task: str, stages: str, growth: bool, repeats: int, against: str, limit: float, out: str) -> dict[str, Any]:
    """Time the stages of a task, and compare them with an earlier run's."""
    del workdir
    known = [name for name in STAGES if name not in CEILINGS]
    wanted = [options.check_choice("--stages", name, known) for name in stages.split(",") if name] or known
    before = read(against) if against else None
    rows = [timed(name, STAGES[name], config, repeats) for name in (*CEILINGS, *wanted)]
    peaks = {field: next(row for row in rows if row["name"] == name)[f"{field}_per_second"] for name, field in CEILINGS.items()}
    for row in rows:
        row["share"] = {field: row[f"{field}_per_second"] / peak for field, peak in peaks.items() if f"{field}_per_second" in row}
    grown = [grow(name, config, repeats) for name in GROWTH] if growth else []
    result = {"task": task, **machine(), "stages": rows, "growth": grown}
    kind = "".join(letter if letter.isalnum() else "-" for letter in result["device"].lower())
    path = pathlib.Path(out) / f"{kind}-{task}.json"
    writers.write_json(path, result)
    print(f"\n{table(rows)}\n\n{growth_table(grown)}\n\n{path}" if grown else f"\n{table(rows)}\n\n{path}")
    if before is not None and slower(before, result, limit):
        raise SystemExit(1)
    return result


def machine() -> dict[str, Any]:
    """Say what was measured on."""
    device = jax.devices()[0]
    return {
        "device": device.device_kind,
        "devices": jax.device_count(),
        "processors": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }


# Timing


def compiled(function: Callable[..., Any], *arguments: Any, count: int = 1) -> Work:
    """Compile a function of arrays for its arguments: its run, and what XLA counts of it."""
    program, facts = build_program(compiling.jit(function), *arguments)
    return Work(lambda: jax.block_until_ready(program(*arguments)), count, facts)


def build_program(jitted, *arguments: Any) -> tuple[Any, dict[str, float]]:
    """Compile a jitted function: the program, its compile time, and the operations, bytes and memory that XLA counts for it."""
    begin = time.perf_counter()
    program = jitted.lower(*arguments).compile()
    facts = {"compile_seconds": time.perf_counter() - begin}
    cost, memory = program.cost_analysis() or {}, program.memory_analysis()
    facts |= {name: float(cost[key]) for name, key in (("flops", "flops"), ("bytes", "bytes accessed")) if cost.get(key, 0) > 0}
    if memory is not None:
        facts["memory"] = float(memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes)
    return program, facts


def timed(name: str, stage: Stage, config, repeats: int) -> dict[str, Any]:
    """Time a stage: a row with the median and the extremes of a thing in seconds; or why it could not run."""
    print(f"{name}: {stage.label}", flush=True)
    row = {"name": name, "label": stage.label, "unit": stage.unit}
    try:
        work = stage.prepare(config)
    except Unavailable as error:
        return {**row, "unavailable": str(error)}
    return {**row, **measured(work, repeats)}


def measured(work: Work, repeats: int) -> dict[str, Any]:
    """Run some work once to warm up and then up to `repeats` times: seconds a thing, and rates."""
    runs = []
    with contextlib.closing(work):
        work.run()
        begin = time.perf_counter()
        while len(runs) < repeats and (not runs or time.perf_counter() - begin < SECONDS):
            start = time.perf_counter()
            work.run()
            runs.append((time.perf_counter() - start) / work.count)
    seconds = float(np.median(runs))
    rates = {f"{name}_per_second": work.facts[name] / work.count / seconds for name in ("flops", "bytes") if name in work.facts}
    return {"seconds": seconds, "lowest": min(runs), "highest": max(runs), "runs": len(runs), "count": work.count, **work.facts, **rates}


# The stages


def matrix_product(config) -> Work:
    """Multiply two matrices of 2048 x 2048."""
    del config
    x = jax.random.normal(jax.random.key(0), (2048, 2048))
    return compiled(jnp.matmul, x, x)


def copy(config) -> Work:
    """Read and write 256 MB."""
    del config
    return compiled(lambda x: x + 1.0, jnp.zeros(64 << 20))


def scenes_of(config, count: int) -> tuple[types.Scene, jax.Array]:
    """Draw scenes of val seeds, stacked, each with half of its objects at their goals: `(scenes, poses [B, N, 7])`."""
    task = build.task(config)
    drawn = [task.sample(seed) for seed in build.split_seeds("val", 0, count)]
    stacked = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves), jnp.float32), *drawn)
    half = jnp.arange(stacked.start.shape[1])[:, None] < stacked.start.shape[1] // 2
    return stacked, jnp.where(half, stacked.goal, stacked.start)


def resized(config, **fields):
    """Give the config with other fields."""
    return options.override(config, [f"{name}={value}" for name, value in fields.items()])


def full_size(config):
    """Give the config with the cameras' own resolution."""
    return resized(config, **FULL)


def render_views(config) -> Work:
    """Render the views of some scenes with the arm parked."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, BATCH)
    observer.background()
    return compiled(jax.vmap(observer.views), drawn.size, drawn.color, drawn.base, poses, count=BATCH)


def render_mujoco(config) -> Work:
    """Render the same with MuJoCo: colour and depth."""
    task, cameras = build.task(config), build.observer(config).camera
    model = scene.build_model(task, task.sample(1), cameras=cameras)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    try:
        renderer = mujoco.Renderer(model, cameras.height, cameras.width)
    except Exception as error:  # each GL backend has its own
        raise Unavailable(f"mujoco.Renderer needs OpenGL: {type(error).__name__} {error}") from error

    def run():
        for name in [model.camera(i).name for i in range(model.ncam)]:
            for depth in (False, True):
                (renderer.enable_depth_rendering if depth else renderer.disable_depth_rendering)()
                renderer.update_scene(data, camera=name)
                renderer.render()

    return Work(run)


def fuse(config) -> Work:
    """Unproject and fuse rendered views."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, BATCH)
    views = jax.jit(jax.vmap(observer.views))(drawn.size, drawn.color, drawn.base, poses)
    return compiled(observer.fuse, views, count=BATCH)


def observe(config) -> Work:
    """Render, unproject and fuse."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, BATCH)
    observer.background()

    def maps(size, color, base, poses):
        return topdown.from_views_batch(jax.vmap(observer.views)(size, color, base, poses), spec=observer.spec)

    return compiled(maps, drawn.size, drawn.color, drawn.base, poses, count=BATCH)


def features(config) -> Work:
    """Run the pretrained backbone on the views and fuse its features."""
    observer, (drawn, poses) = build.observer(resized(config, **{"camera.backbone": "resnet50_imagenet_v1"})), scenes_of(config, 1)
    views = jax.jit(jax.vmap(observer.views))(drawn.size, drawn.color, drawn.base, poses)
    return compiled(observer.fuse, views)


def act(config) -> Work:
    """Let the policy act on one pair of maps."""
    agent = build.build_policy(config)
    params = jax.jit(agent.init)(jax.random.key(0, impl="rbg"))
    blank = policy.empty_map(agent.spec)
    return compiled(agent.act, params, blank, blank)


def correlate(config, *, method: str, rotations: int = 36, rows: int = 320, cols: int = 160) -> Work:
    """Correlate forward and backward at the paper's size: 64 x 64 crops, 3 channels."""
    del config
    keys = jax.random.split(jax.random.key(0))
    inputs = jax.random.normal(keys[0], (rows, cols, 3)), jax.random.normal(keys[1], (rotations, 64, 64, 3))

    def loss(key, kernels):
        return jnp.square(correlation.correlate(key, kernels, method=method)).mean()

    return compiled(jax.value_and_grad(loss, (0, 1)), *inputs)


def states_of(config, count: int) -> types.State:
    """Make training states without physics: scenes half done."""
    drawn, poses = scenes_of(config, count)
    task = build.task(config)
    done = [(oracle.placed(task, *one), oracle.ready(task, *one)) for one in zip(unstacked(drawn), np.asarray(poses), strict=True)]
    placed, ready = (jnp.asarray(np.stack(leaves)) for leaves in zip(*done, strict=True))
    fields = {name: getattr(drawn, name) for name in ("size", "color", "base", "goal", "symmetry")}
    return types.State(**fields, poses=poses, placed=placed, ready=ready)


def unstacked(drawn: types.Scene) -> list[types.Scene]:
    """Give the scenes of a batch one by one, as NumPy."""
    whole = jax.tree.map(np.asarray, drawn)
    return [jax.tree.map(lambda leaf: leaf[i], whole) for i in range(len(whole.size))]  # noqa: B023


def training_step(config) -> Work:
    """Take training steps: draw, augment, render, fuse, loss, gradient, update."""
    recipe, states, key = build.recipe(config), states_of(config, BATCH), jax.random.key(0)
    fresh = jax.jit(lambda key: state.create(recipe.policy.init(key), recipe.optimizer))(jax.random.key(0, impl="rbg"))
    frozen = recipe.policy.frozen
    jitted = compiling.jit(functools.partial(train_step.train_step, recipe), donate_argnums=0)
    program, facts = build_program(jitted, fresh, states, key, frozen)
    held = [fresh]

    def run():
        held[0], metrics = program(held[0], states, key, frozen)
        jax.block_until_ready((held[0], metrics))

    return Work(run, recipe.batch_size, facts)


def paper_step(config) -> Work:
    """Take a step of the paper's two-stream agent at its own size."""
    return training_step(options.load(f"configs/{config.task.name}.py:paper"))


def input_pipeline(config) -> Work:
    """Draw, augment, render and fuse the examples of a training step."""
    recipe, states = build.recipe(config), states_of(config, BATCH)

    def inputs(key, states):
        key_batch, key_augment, key_noise = jax.random.split(key, 3)
        index = jax.random.randint(key_batch, (recipe.batch_size,), 0, states.size.shape[0])
        examples = jax.tree.map(lambda leaf: leaf[index], states)
        how = {"observer": recipe.observer, "recolor": recipe.recolor, "mix": recipe.mix, "rigid": recipe.rigid}
        disturb = jax.vmap(functools.partial(train_step.augmented, **how))
        return train_step.observations(recipe, key_noise, disturb(jax.random.split(key_augment, recipe.batch_size), examples))

    return compiled(inputs, jax.random.key(0), states, count=recipe.batch_size)


def primitive(config) -> Work:
    """Carry out one right action with the arm."""
    task = build.task(config)
    drawn = task.sample(1)
    world = physics.World(task, drawn)
    action = oracle.act(task, drawn, drawn.start, np.random.default_rng(0))

    def run():
        world.reset(drawn.start)
        world.step(action)

    return Work(run)


def collection(config) -> Work:
    """Record demonstrations of the oracle."""
    task, seeds = build.task(config), build.split_seeds("train", 0, recording.SHARD)
    made = len(recording.demonstrate(task, seeds, threads=config.data.threads))
    return Work(lambda: recording.demonstrate(task, seeds, threads=config.data.threads), made)


def evaluation(config, *, parallel: int = 25) -> Work:
    """Run the closed loop with the weights that ship."""
    path = f"pretrained/{config.task.name}"
    agent, observer = build.build_policy(config), build.observer(config)
    params = scoring.check_checkpoint(path, config, agent)
    seeds = build.split_seeds("val", 0, parallel)

    def run():
        scoring.evaluate(agent, params, observer, seeds=seeds, parallel=parallel, threads=config.data.threads)

    return Work(run, parallel)


def trained_state(config) -> tuple[state.TrainState, dict[str, Any]]:
    """Make a fresh training state, and what is stored beside it."""
    recipe = build.recipe(config)
    fresh = jax.jit(lambda key: state.create(recipe.policy.init(key), recipe.optimizer))(jax.random.key(0, impl="rbg"))
    return fresh, {"config": options.to_dict(config), "input_spec": build.input_spec(config)}


def save(config) -> Work:
    """Write a checkpoint, checksums and all."""
    fresh, stored = trained_state(config)
    folder, steps = tempfile.TemporaryDirectory(), itertools.count(1)
    store = checkpoint.Checkpoints(folder.name)

    return Work(lambda: store.save_latest(next(steps), fresh, **stored), close=folder.cleanup)


def restore(config) -> Work:
    """Read a checkpoint and verify it."""
    fresh, stored = trained_state(config)
    folder = tempfile.TemporaryDirectory()
    store = checkpoint.Checkpoints(folder.name)
    store.save_latest(1, fresh, **stored)
    return Work(lambda: store.restore_latest(fresh), close=folder.cleanup)


def start_up(config) -> Work:
    """Start Python and import the package."""
    del config
    return Work(lambda: subprocess.run([sys.executable, "-c", "import lala_jax"], check=True))


CEILINGS = {"matmul": "flops", "copy": "bytes"}
STAGES = {
    "matmul": Stage("matrix product 2048 x 2048", "product", matrix_product),
    "copy": Stage("reading and writing 256 MB", "copy", copy),
    "import": Stage("starting Python and importing lala_jax", "start", start_up),
    "render": Stage("render 4 views of 640 x 480", "observation", lambda config: render_views(full_size(config))),
    "render-mujoco": Stage("the same with mujoco.Renderer", "observation", lambda config: render_mujoco(full_size(config))),
    "fuse": Stage("unproject and fuse them", "observation", lambda config: fuse(full_size(config))),
    "observe": Stage("render, unproject and fuse", "observation", lambda config: observe(full_size(config))),
    "observe-compact": Stage("the same at the config's resolution", "observation", observe),
    "backbone": Stage("fuse with ResNet-50 features", "observation", features),
    "act": Stage("act", "action", act),
    "correlate": Stage("correlation and its gradient, in the spectrum", "sample", lambda config: correlate(config, method="fft")),
    "correlate-direct": Stage("the same directly", "sample", lambda config: correlate(config, method="conv")),
    "inputs": Stage("examples of a training step", "sample", input_pipeline),
    "train": Stage("training step", "sample", training_step),
    "train-paper": Stage("training step, paper's size", "sample", paper_step),
    "primitive": Stage("one action of the arm", "action", primitive),
    "collect": Stage("demonstrations", "demonstration", collection),
    "evaluate": Stage("closed loop", "episode", evaluation),
    "save": Stage("save a checkpoint", "checkpoint", save),
    "restore": Stage("restore a checkpoint", "checkpoint", restore),
}


# How cost grows


def many_boxes(config, count: int) -> Work:
    """Render `count` boxes on a table, in a grid."""
    cameras, side = build.observer(config).camera, int(np.ceil(np.sqrt(count)))
    spec = mujoco.MjSpec()
    spec.add_material(name="plain")  # MJX wants one
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05], rgba=[*scene.TABLE_COLOR, 1.0])
    for i, (x, y) in enumerate(itertools.islice(itertools.product(np.linspace(0.3, 0.7, side), np.linspace(-0.4, 0.4, side)), count)):
        spec.worldbody.add_geom(
            name=f"object{i}", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02] * 3, pos=[x, y, 0.02], rgba=[0.5, 0.5, 0.5, 1.0]
        )
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    put = render.mjx.put_model(model), render.mjx.put_data(model, data)
    layer = render.background(*put, cameras, geoms=(0,), segmentation=False)
    return compiled(lambda model, data: render.render_over(layer, model, data, cameras, geoms=scene.object_geoms(model)), *put)


def some_views(config, count: int) -> Work:
    """Render and fuse one scene with `count` cameras: the preset's, over and over."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, 1)
    which = jnp.arange(count) % len(observer.camera.intrinsics)
    layer = jax.tree.map(lambda leaf: leaf[which], observer.background())

    def maps(size, color, base, poses):
        return topdown.from_views(observer.views(size, color, base, poses, layer), spec=observer.spec)

    return compiled(maps, *(leaf[0] for leaf in (drawn.size, drawn.color, drawn.base, poses)))


def with_cells(config, rows: int) -> Work:
    """Fuse to a map of `rows` rows and half as many columns."""
    return fuse(resized(config, **{"map.cell": 1.0 / rows}))


def with_batch(config, batch: int) -> Work:
    """Take training steps of another batch size."""
    return training_step(resized(config, **{"train.batch_size": batch}))


def with_episodes(config, count: int) -> Work:
    """Let the oracle act in `count` episodes at once."""
    task, seeds = build.task(config), build.split_seeds("val", 0, count)
    drawn = [task.sample(seed) for seed in seeds]

    def run():
        rollout.run(task, drawn, seeds, rollout.oracle_agent(task, drawn, seeds, "oracle"), threads=config.data.threads, max_actions=1)

    return Work(run, count)


GROWTH = {
    "views": ("render and fuse, by the number of views", (1, 2, 4, 8), some_views),
    "boxes": ("render, by the number of boxes", (2, 4, 8, 16, 32, 64), many_boxes),
    "cells": ("fuse, by the number of rows of the map", (80, 160, 320, 640), with_cells),
    "rotations": (
        "correlation and its gradient, by the number of rotations",
        (12, 24, 36, 72),
        lambda config, count: correlate(config, method="fft", rotations=count),
    ),
    "batch": ("training step a sample, by the batch size", (1, 4, 16, 64), with_batch),
    "episodes": ("one action of the oracle an episode, by the episodes at once", (1, 8, 64, 512), with_episodes),
}


def grow(name: str, config, repeats: int) -> dict[str, Any]:
    """Time one thing at several sizes."""
    label, values, prepare = GROWTH[name]
    print(f"{name}: {label}", flush=True)
    return {"name": name, "label": label, "rows": [{"value": value, **measured(prepare(config, value), repeats)} for value in values]}


# Tables and comparisons


def seconds_text(seconds: float) -> str:
    """Write a time with three digits: `12.3 ms`."""
    scale, unit = next(pair for pair in ((1.0, "s"), (1e3, "ms"), (1e6, "us")) if seconds * pair[0] >= 1.0 or pair[1] == "us")
    return f"{seconds * scale:.3g} {unit}"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write the stages as a Markdown table."""
    lines = []
    for row in rows:
        if "unavailable" in row:
            lines.append([row["label"], row["unavailable"], "", "", "", ""])
            continue
        share = [f"{100 * row['share'][field]:.0f}%" if field in row["share"] else "" for field in CEILINGS.values()]
        spread = f"{seconds_text(row['lowest'])} to {seconds_text(row['highest'])}"
        lines.append([row["label"], f"{seconds_text(row['seconds'])} a {row['unit']}", spread, f"{row['runs']}", *share])
    return common.table(["stage", "median", "range", "runs", "of the matrix rate", "of the copy rate"], lines)


def growth_table(grown: Sequence[Mapping[str, Any]]) -> str:
    """Write what grows as a Markdown table."""
    lines = [[one["label"], ", ".join(f"{row['value']}: {seconds_text(row['seconds'])}" for row in one["rows"])] for one in grown]
    return common.table(["", "seconds"], lines)


def read(path: str) -> dict[str, Any]:
    """Read a file of this benchmark; raises OptionsError where it is none."""
    try:
        found = json.loads(pathlib.Path(path).read_text())
        return {**found, "stages": list(found["stages"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise options.OptionsError(f"--against={path} is no file of this benchmark: {type(error).__name__} {error}") from error


def slower(before: Mapping[str, Any], after: Mapping[str, Any], limit: float) -> list[str]:
    """Print the ratio of each stage's medians, after to before, and name the stages above `limit`."""
    if before["device"] != after["device"] or before["task"] != after["task"]:
        there, here = (f"{one['task']} on {one['device']}" for one in (before, after))
        raise options.OptionsError(f"--against holds {there}, this is {here}: their ratio says nothing")
    old = {row["name"]: row["seconds"] for row in before["stages"] if "seconds" in row}
    ratios = {row["name"]: row["seconds"] / old[row["name"]] for row in after["stages"] if "seconds" in row and row["name"] in old}
    print(common.table(["stage", "time, ratio"], [[name, f"{ratio:.2f}"] for name, ratio in ratios.items()]))
    found = [name for name, ratio in ratios.items() if ratio > limit]
    if found:
        print(f"more than {limit} times as long: {', '.join(found)}")
    return found


def command(argv: Sequence[str] | None = None):
    """Run from the command line."""
    return options.run(main, flags=FLAGS, config_from=common.shipped_config, workdir=".", user_errors=common.USER_ERRORS, argv=argv)


if __name__ == "__main__":
    command()
