"""The stages that `benchmark` times; as a program it times the one that `timing.alone` asks for."""

from __future__ import annotations

import functools
import itertools
import json
import os
import subprocess
import sys
import tempfile
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax

from experiments import timing
from experiments.benchmark_targets import EPISODES
from lala_jax import (
    build,
    checkpoint,
    compiling,
    losses,
    options,
    policy,
    pretrained,
    recording,
    rollout,
    scoring,
    state,
    train,
    train_step,
    types,
)
from lala_jax.models import correlation, transporter
from lala_jax.perception import topdown
from lala_jax.sim import oracle, physics, render, robot, scene

BATCH = 8  # observations at a time, where a stage takes several
FULL = {"camera.height": 480, "camera.width": 640, "map.cell": 0.003125}  # the cameras' own resolution, and the paper's map
EGL = {"MUJOCO_GL": "egl"} if sys.platform == "linux" else {}  # renders without a display


def matrix_product(config, *, side: int = 2048, dtype: jnp.dtype = jnp.float32) -> timing.Work:
    """Multiply two matrices of `side x side`."""
    del config
    x = jax.random.normal(jax.random.key(0), (side, side), dtype)
    return timing.compiled(jnp.matmul, x, x)


def copy(config) -> timing.Work:
    """Read and write 256 MB."""
    del config
    return timing.compiled(lambda x: x + 1.0, jnp.zeros(64 << 20))


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
    """Give the config with the cameras' own resolution and a map of 320 x 160 cells."""
    return resized(config, **FULL)


def render_views(config) -> timing.Work:
    """Render the views of some scenes with the arm parked."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, BATCH)
    observer.background()
    return timing.compiled(jax.vmap(observer.views), drawn.size, drawn.color, drawn.base, poses, count=BATCH)


def render_mujoco(config, *, samples: int) -> timing.Work:
    """Render colour and depth of the same views with MuJoCo, the arm parked, by some `samples` a pixel, 0 for one."""
    task, cameras = build.task(config), build.observer(config).camera
    model = scene.build_model(task, task.sample(1), cameras=cameras)
    model.vis.quality.offsamples = samples
    data = mujoco.MjData(model)
    robot.Arm(model).reset(data)
    mujoco.mj_forward(model, data)
    try:
        renderer = mujoco.Renderer(model, cameras.height, cameras.width)
    except Exception as error:  # each GL backend has its own
        raise timing.Unavailable(f"mujoco.Renderer needs OpenGL: {type(error).__name__} {error}") from error
    names = [model.camera(i).name for i in range(model.ncam)]

    def run():
        return [look(renderer, data, name) for name in names]

    return timing.Work(run, close=renderer.close)


def look(renderer: mujoco.Renderer, data: mujoco.MjData, camera: str) -> tuple[np.ndarray, np.ndarray]:
    """Give a camera's picture `[H, W, 3]` uint8 and depth `[H, W]` in metres."""
    pictures = []
    for switch in (renderer.disable_depth_rendering, renderer.enable_depth_rendering):
        switch()
        renderer.update_scene(data, camera=camera)
        pictures.append(renderer.render())
    return pictures[0], pictures[1]


def fuse(config) -> timing.Work:
    """Unproject and fuse rendered views."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, BATCH)
    views = jax.jit(jax.vmap(observer.views))(drawn.size, drawn.color, drawn.base, poses)
    return timing.compiled(observer.fuse, views, count=BATCH)


def observe(config, *, count: int = BATCH) -> timing.Work:
    """Render, unproject and fuse."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, count)
    observer.background()

    def maps(size, color, base, poses):
        return topdown.from_views_batch(jax.vmap(observer.views)(size, color, base, poses), spec=observer.spec)

    return timing.compiled(maps, drawn.size, drawn.color, drawn.base, poses, count=count)


def features(config) -> timing.Work:
    """Run the pretrained backbone on the views and fuse its features."""
    observer, (drawn, poses) = build.observer(resized(config, **{"camera.backbone": "resnet50_imagenet_v1"})), scenes_of(config, 1)
    views = jax.jit(jax.vmap(observer.views))(drawn.size, drawn.color, drawn.base, poses)
    return timing.compiled(observer.fuse, views)


def act(config) -> timing.Work:
    """Let the policy act on one pair of maps."""
    agent = build.build_policy(config)
    params = compiling.draw(agent.init, 0)
    blank = policy.empty_map(agent.spec)
    return timing.compiled(agent.act, params, blank, blank)


def correlate(config, *, method: str, rotations: int = 36, rows: int = 320, cols: int = 160) -> timing.Work:
    """Correlate forward and backward at the paper's size: 64 x 64 crops, 3 channels."""
    del config
    keys = jax.random.split(jax.random.key(0))
    inputs = jax.random.normal(keys[0], (rows, cols, 3)), jax.random.normal(keys[1], (rotations, 64, 64, 3))

    def loss(key, kernels):
        return jnp.square(correlation.correlate(key, kernels, method=method)).mean()

    return timing.compiled(jax.value_and_grad(loss, (0, 1)), *inputs)


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


def training_step(config) -> timing.Work:
    """Take training steps: draw, augment, render, fuse, loss, gradient, update."""
    recipe, states, key = build.recipe(config), states_of(config, BATCH), jax.random.key(0)
    step = compiling.jit_step(functools.partial(train_step.train_step, recipe))
    return timing.stepping(step, train.fresh(recipe, 0), states, key, recipe.policy.frozen, count=recipe.batch_size)


def paper_step(config, **fields) -> timing.Work:
    """Take a step of the paper's two-stream agent at its own size."""
    return training_step(resized(options.load(f"configs/{config.task.name}.py:paper"), **fields))


def paper_example(rows: int, cols: int) -> dict[str, Any]:
    """Draw maps `[rows, cols, 6]` as public code has them (colours, and thrice the height), a pick, and its place and bin; all NumPy."""
    rng = np.random.default_rng(0)
    current, goal = (np.concatenate([rng.normal(size=(rows, cols, 3)), *[rng.normal(size=(rows, cols, 1))] * 3], -1) for _ in range(2))
    pick, place = (rng.integers((rows, cols)) for _ in range(2))
    maps = {"current": current.astype(np.float32), "goal": goal.astype(np.float32)}
    return {**maps, "pick": pick.astype(np.int32), "place": place.astype(np.int32), "bin": np.int32(1)}


def paper_losses(net: transporter.Transporter, params: Any, example: dict[str, Any]) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Give the sum of pick's and place's one-hot cross-entropies, and the logits."""
    logits, _ = net.apply({"params": params}, example["current"], example["goal"], example["pick"])
    rows, cols = logits["pick"].shape
    at = example["pick"][0] * cols + example["pick"][1] == jnp.arange(rows * cols)
    place = losses.place_cross_entropy(logits["place"], example["bin"][None], example["place"][None], jnp.ones(1, bool))
    return losses.masked_cross_entropy(logits["pick"], at) + place, logits


def paper_network(config, *, rows: int = 320, cols: int = 160, batch: int = 1, **sizes) -> timing.Work:
    """Take plain steps of the paper's two-stream network on given maps, `batch` examples at a time: loss, gradient, Adam."""
    del config
    net, optimizer, example = transporter.Transporter(**sizes), optax.adam(1e-4), jax.tree.map(jnp.asarray, paper_example(rows, cols))

    def step(run, examples):
        params, moments = run

        def mean_loss(params):
            found, logits = jax.vmap(functools.partial(paper_losses, net, params))(examples)
            return found.mean(), logits

        grads, logits = jax.grad(mean_loss, has_aux=True)(params)
        updates, moments = optimizer.update(grads, moments)
        return (optax.apply_updates(params, updates), moments), {name: leaf.max() for name, leaf in logits.items()}

    params = compiling.draw(net.init, 0, example["current"], example["goal"], example["pick"])["params"]
    examples = jax.tree.map(lambda leaf: jnp.stack([leaf] * batch), example)
    return timing.stepping(compiling.jit_step(step), (params, optimizer.init(params)), examples, count=batch)


def correlate_torch(config, **sizes) -> timing.Work:
    """Do what `correlate` does with PyTorch's conv2d."""
    from experiments import benchmark_torch  # needs an extra

    del config
    return benchmark_torch.correlate(**sizes)


def paper_torch(config, *, rows: int = 320, cols: int = 160, **sizes) -> timing.Work:
    """Do what `paper_network` does with PyTorch."""
    from experiments import benchmark_torch  # needs an extra

    del config
    return benchmark_torch.steps(paper_example(rows, cols), **sizes)


def input_pipeline(config) -> timing.Work:
    """Draw, augment, render and fuse the examples of a training step."""
    recipe, states = build.recipe(config), states_of(config, BATCH)

    def inputs(key, states):
        key_batch, key_augment, key_noise = jax.random.split(key, 3)
        index = jax.random.randint(key_batch, (recipe.batch_size,), 0, states.size.shape[0])
        examples = jax.tree.map(lambda leaf: leaf[index], states)
        how = {"observer": recipe.observer, "recolor": recipe.recolor, "mix": recipe.mix, "rigid": recipe.rigid}
        disturb = jax.vmap(functools.partial(train_step.augmented, **how))
        return train_step.observations(recipe, key_noise, disturb(jax.random.split(key_augment, recipe.batch_size), examples))

    return timing.compiled(inputs, jax.random.key(0), states, count=recipe.batch_size)


def primitive(config) -> timing.Work:
    """Carry out one right action with the arm."""
    task = build.task(config)
    drawn = task.sample(1)
    world = physics.World(task, drawn)
    action = oracle.act(task, drawn, drawn.start, np.random.default_rng(0))

    def run():
        world.reset(drawn.start)
        world.step(action)

    return timing.Work(run)


def collection(config) -> timing.Work:
    """Record demonstrations of the oracle."""
    task, seeds = build.task(config), build.split_seeds("train", 0, recording.SHARD)
    made = len(recording.demonstrate(task, seeds, threads=config.data.threads))
    return timing.Work(lambda: recording.demonstrate(task, seeds, threads=config.data.threads), made)


def evaluation(config) -> timing.Work:
    """Run the closed loop with the weights that ship, a quarter of EPISODES at once."""
    if config.task.name not in pretrained.names():
        raise timing.Unavailable(f"needs weights of {config.task.name} in the package, which has {', '.join(pretrained.names())}")
    path = f"pretrained/{config.task.name}"
    agent, observer = build.build_policy(config), build.observer(config)
    params = scoring.check_checkpoint(path, config, agent)
    parallel = max(EPISODES // 4, 1)

    def close_the_loop(start: int, count: int):
        seeds = build.split_seeds("val", start, count)
        scoring.evaluate(agent, params, observer, seeds=seeds, parallel=parallel, threads=config.data.threads)

    return timing.Work(lambda: close_the_loop(0, EPISODES), EPISODES, cold=True, more=lambda: close_the_loop(EPISODES, parallel))


def trained_state(config) -> tuple[state.TrainState, dict[str, Any]]:
    """Make a fresh training state, and what is stored beside it."""
    return train.fresh(build.recipe(config), 0), {"config": options.to_dict(config), "input_spec": build.input_spec(config)}


def save(config) -> timing.Work:
    """Write a checkpoint, checksums and all."""
    fresh, stored = trained_state(config)
    folder, steps = tempfile.TemporaryDirectory(), itertools.count(1)
    store = checkpoint.Checkpoints(folder.name)

    return timing.Work(lambda: store.save_latest(next(steps), fresh, **stored), facts=size_of(fresh), close=folder.cleanup)


def restore(config) -> timing.Work:
    """Read a checkpoint and verify it."""
    fresh, stored = trained_state(config)
    folder = tempfile.TemporaryDirectory()
    store = checkpoint.Checkpoints(folder.name)
    store.save_latest(1, fresh, **stored)
    return timing.Work(lambda: store.restore_latest(fresh), facts=size_of(fresh), close=folder.cleanup)


def size_of(tree) -> dict[str, float]:
    """Count the bytes of all leaves."""
    return {"bytes": float(sum(leaf.nbytes for leaf in jax.tree.leaves(tree)))}


def start_up(config) -> timing.Work:
    """Start Python and import the package."""
    del config
    return timing.Work(lambda: subprocess.run([sys.executable, "-c", "import lala_jax"], check=True))


def first_step(config, *, cached: bool) -> timing.Work:
    """Start Python, import, build and take one training step; without kept programs, or with those that such a start has left before."""
    folder = tempfile.TemporaryDirectory()
    keep = {"JAX_ENABLE_COMPILATION_CACHE": str(cached).lower(), "JAX_COMPILATION_CACHE_DIR": folder.name}
    command, request = [sys.executable, "-m", "experiments.benchmark_start"], json.dumps(options.to_dict(config))

    def run():
        done = subprocess.run(command, input=request, env={**os.environ, **keep}, capture_output=True, text=True, check=False)
        if done.returncode:
            raise timing.Unavailable(f"a first training step {timing.ended(done)}", failed=True)

    if cached:
        run()
    return timing.Work(run, close=folder.cleanup)


OPENGL: dict[str, Any] = {"alone": True, "environment": EGL}
TORCH: dict[str, Any] = {"alone": True, "needs": ("torch",), "platform": "cpu"}
OWN_MALLOC = {"MALLOC_TRIM_THRESHOLD_": "131072"}  # glibc's default, said aloud: memory is given back, which `compiling.keep_memory` leaves
CEILINGS = {"matmul": "flops", "copy": "bytes"}  # always timed
PEAKS = {**CEILINGS, "matmul-bfloat16": "flops"}  # the fastest of a field is the machine's own rate
LARGE = {"model.dtype": "bfloat16", "train.batch_size": 8}  # how a GPU takes the paper's step
STAGES = {
    "matmul": timing.Stage("matrix product 2048 x 2048", "product", matrix_product),
    "matmul-bfloat16": timing.Stage(
        "matrix product 8192 x 8192, bfloat16",
        "product",
        functools.partial(matrix_product, side=8192, dtype=jnp.bfloat16),
        platform="gpu",
    ),
    "copy": timing.Stage("reading and writing 256 MB", "copy", copy),
    "import": timing.Stage("starting Python and importing lala_jax", "start", start_up),
    "first-step": timing.Stage("from starting Python to the first training step", "start", functools.partial(first_step, cached=False)),
    "first-step-cached": timing.Stage("the same with programs kept from before", "start", functools.partial(first_step, cached=True)),
    "render": timing.Stage("render 4 views of 640 x 480", "observation", lambda config: render_views(full_size(config))),
    "render-mujoco": timing.Stage(
        "the same with mujoco.Renderer, one sample a pixel, as ours",
        "observation",
        lambda config: render_mujoco(full_size(config), samples=0),
        **OPENGL,
    ),
    "render-mujoco-smooth": timing.Stage(
        "the same with mujoco.Renderer, four samples, as it does unless told",
        "observation",
        lambda config: render_mujoco(full_size(config), samples=4),
        **OPENGL,
    ),
    "fuse": timing.Stage("unproject and fuse them to 320 x 160 cells", "observation", lambda config: fuse(full_size(config))),
    "observe": timing.Stage("render, unproject and fuse", "observation", lambda config: observe(full_size(config))),
    "observe-many": timing.Stage("the same, batch 64", "observation", lambda config: observe(full_size(config), count=64), platform="gpu"),
    "observe-compact": timing.Stage("the same at the config's resolution", "observation", observe),
    "backbone": timing.Stage("fuse with ResNet-50 features", "observation", features),
    "act": timing.Stage("act", "action", act),
    "correlate": timing.Stage("correlation and its gradient, in the spectrum", "sample", lambda config: correlate(config, method="fft")),
    "correlate-direct": timing.Stage("the same directly", "sample", lambda config: correlate(config, method="conv"), alone=True),
    "correlate-torch": timing.Stage("the same with PyTorch's conv2d", "sample", correlate_torch, **TORCH),
    "inputs": timing.Stage("examples of a training step", "sample", input_pipeline),
    "train": timing.Stage("training step", "sample", training_step),
    "train-many": timing.Stage(
        "training step, batch 64", "sample", lambda config: training_step(resized(config, **{"train.batch_size": 64})), platform="gpu"
    ),
    "train-paper": timing.Stage("training step, paper's size", "sample", paper_step),
    "train-paper-bfloat16": timing.Stage("the same in bfloat16, batch 8", "sample", functools.partial(paper_step, **LARGE), platform="gpu"),
    "train-paper-network": timing.Stage("the same on given maps without a backbone", "sample", paper_network, alone=True),
    "train-paper-network-bfloat16": timing.Stage(
        "that in bfloat16, batch 8", "sample", functools.partial(paper_network, batch=8, dtype=jnp.bfloat16), platform="gpu"
    ),
    "train-paper-torch": timing.Stage("that with PyTorch, memory kept as by our commands", "sample", paper_torch, **TORCH),
    "train-paper-torch-given-back": timing.Stage(
        "the same, memory given back as by any program", "sample", paper_torch, environment=OWN_MALLOC, **TORCH
    ),
    "primitive": timing.Stage("one action of the arm", "action", primitive),
    "collect": timing.Stage("demonstrations", "demonstration", collection),
    "evaluate": timing.Stage(f"closed loop, {EPISODES} episodes and compiling", "episode", evaluation),
    "save": timing.Stage("save a checkpoint", "checkpoint", save),
    "restore": timing.Stage("restore a checkpoint", "checkpoint", restore),
}


# How cost grows


def many_boxes(config, count: int) -> timing.Work:
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
    return timing.compiled(lambda model, data: render.render_over(layer, model, data, cameras, geoms=scene.object_geoms(model)), *put)


def some_views(config, count: int) -> timing.Work:
    """Render and fuse one scene with `count` cameras: the preset's, over and over."""
    observer, (drawn, poses) = build.observer(config), scenes_of(config, 1)
    which = jnp.arange(count) % len(observer.camera.intrinsics)
    layer = jax.tree.map(lambda leaf: leaf[which], observer.background())

    def maps(size, color, base, poses):
        return topdown.from_views(observer.views(size, color, base, poses, layer), spec=observer.spec)

    return timing.compiled(maps, *(leaf[0] for leaf in (drawn.size, drawn.color, drawn.base, poses)))


def with_cells(config, count: int) -> timing.Work:
    """Fuse to a map of `count` rows and half as many columns."""
    return fuse(resized(config, **{"map.cell": 1.0 / count}))


def with_batch(config, count: int) -> timing.Work:
    """Take training steps of another batch size."""
    return training_step(resized(config, **{"train.batch_size": count}))


def with_episodes(config, count: int) -> timing.Work:
    """Let the oracle act in `count` episodes at once."""
    task, seeds = build.task(config), build.split_seeds("val", 0, count)
    drawn = [task.sample(seed) for seed in seeds]

    def run():
        rollout.run(task, drawn, seeds, rollout.oracle_agent(task, drawn, seeds, "oracle"), threads=config.data.threads, max_actions=1)

    return timing.Work(run, count)


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


def served() -> dict[str, timing.Stage]:
    """Give every stage by its name, and each size of what grows by `NAME=SIZE`."""
    grown = {
        f"{name}={value}": timing.Stage(label, "thing", functools.partial(prepare, count=value))
        for name, (label, values, prepare) in GROWTH.items()
        for value in values
    }
    return {**STAGES, **grown}


def grow(name: str, config, repeats: int, *, apart: bool = False) -> dict[str, Any]:
    """Time one thing at several sizes; `apart` as in `timing.timed`."""
    (label, values, _), stages = GROWTH[name], served()
    print(f"{name}: {label}", flush=True)
    rows = [{"value": value, **timing.timed(f"{name}={value}", stages, config, repeats, apart=apart)} for value in values]
    return {"name": name, "label": label, "rows": rows}


if __name__ == "__main__":
    compiling.keep_memory()
    timing.serve(served())
