"""What runs on several devices or processes for `test_parallel.py`: `python tests/parallel_program.py WHAT DIRECTORY [NUMBER ...]`.

The devices of a process are those that its XLA_FLAGS simulate; what is found is left in DIRECTORY.
"""

import dataclasses
import functools
import json
import pathlib
import sys
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
import test_train_step
from jax.sharding import Mesh, PartitionSpec

from lala_jax import build, checkpoint, loop, options, parallel, train

CONFIG = options.from_dict({"rate": 0.1})
STORED = {"config": options.to_dict(CONFIG), "input_spec": {}}


@dataclasses.dataclass(frozen=True)
class Probe:
    """A policy that compiles fast, and whose loss and metrics tell examples, their maps and their keys apart."""

    frozen: ClassVar[dict[str, Any]] = {"scale": np.float32(0.5)}
    privileged: ClassVar[bool] = False

    def init(self, key):
        return {"in": jax.random.normal(key, (16, 24)), "out": jnp.ones((24, 2)), "odd": jnp.zeros(3)}

    def loss(self, params, key, example, current, goal):
        seen = jnp.concatenate([m.height.reshape(8, -1).sum(1) for m in (current, goal)])
        told = jnp.tanh(params["scale"] * seen @ params["in"]) @ params["out"] + params["odd"][:2]
        loss = jnp.square(told + jax.random.normal(key, (2,)) - example.goal[0, :2]).sum()
        defined = example.color[0, 0] > 0.5
        return loss, {"loss": loss, "height": current.height.sum(), "red": jnp.where(defined, example.color[0, 0], jnp.nan)}


@functools.cache
def probe():
    """A recipe of the probe for batches of 8, every cause of chance in it."""
    config = test_train_step.tiny_config("train.batch_size=8", "camera.depth_noise=true", "augment.depth_noise=0.5", "augment.missing=0.5")
    return dataclasses.replace(build.recipe(config), policy=Probe(), optimizer=optax.sgd(0.05, momentum=0.9))


def agent(batch_size):
    """The default agent's recipe; with SGD, since Adam makes steps of what rounding leaves of gradients that are zero."""
    made = build.recipe(test_train_step.tiny_config(f"train.batch_size={batch_size}"))
    return dataclasses.replace(made, optimizer=optax.sgd(1e-2, momentum=0.9))


def start(recipe):
    """A fresh state, where the recipe says."""
    return parallel.place(train.fresh(recipe, 0), recipe.mesh, shard=recipe.shard_state)


def advance(recipe, steps=3):
    """Take steps: the state and each step's metrics. It is compiled once."""
    run, data, found = start(recipe), parallel.place(test_train_step.states(), recipe.mesh), []
    frozen, before = recipe.policy.frozen, train.step()._cache_size()
    for _ in range(steps):
        run, metrics = train.step()(recipe, run, data, jax.random.key(0), frozen)
        found.append({name: float(value) for name, value in jax.device_get(metrics).items()})
    assert train.step()._cache_size() == before + 1
    return run, found


def leave(directory, name, run, metrics):
    """Write a state, whole, and metrics."""
    np.savez(directory / f"{name}.npz", **{leaf: parallel.fetch(value) for leaf, value in checkpoint.named(run).items()})
    (directory / f"{name}.json").write_text(json.dumps(metrics))


def specs(tree):
    """How each leaf is split."""
    return {name: leaf.sharding.spec for name, leaf in checkpoint.named(tree).items()}


def devices(directory):
    """The probe on all devices, its state whole and split, and what became of the split one on other numbers of devices."""
    mesh = parallel.mesh("train.batch_size", 8)
    leave(directory, "whole", *advance(dataclasses.replace(probe(), mesh=mesh)))
    split = dataclasses.replace(probe(), mesh=mesh, shard_state=True)
    run, metrics = advance(split)
    leave(directory, "split", run, metrics)
    assert specs(run) == specs(start(split))
    assert specs(run.params) == {"in": PartitionSpec(None, "data"), "out": PartitionSpec("data"), "odd": PartitionSpec()}
    assert specs(run.average) == specs(run.params) and run.params["in"].addressable_data(0).shape == (16, 3)
    on_eight, on_two = checkpoint.Checkpoints(directory), checkpoint.Checkpoints(directory / "on_two")
    on_eight.save_latest(3, run, **STORED)

    def restored(store, number, *, shard):
        few = Mesh(np.array(jax.devices()[:number]), ("data",))
        again = loop.start_or_resume(start(probe()), store, CONFIG, dict, mesh=few, shard=shard)
        assert specs(again) == {
            name: sharding.spec for name, sharding in checkpoint.named(parallel.shardings(few, run, shard=shard)).items()
        }
        assert test_train_step.bits(again) == test_train_step.bits(run)
        return again

    restored(on_eight, 2, shard=False)
    restored(on_eight, 8, shard=False)
    on_two.save_latest(3, restored(on_eight, 2, shard=True), **STORED)
    restored(on_two, 8, shard=True)
    try:
        parallel.mesh("train.batch_size", 12)
    except options.OptionsError as error:
        (directory / "refused").write_text(str(error))


def reductions(directory):
    """Means over shares with NaN among them, and a function of the whole batch, on all devices."""
    mesh, key = parallel.mesh("n", 8), jax.random.key(3)
    values = np.array([1.0, np.nan, 2.0, np.nan, np.nan, 9.0, 4.0, 4.0] * 2, np.float32).reshape(8, 2)
    pictures = np.arange(48, dtype=np.int32).reshape(16, 3)

    def draw(batch):
        return batch + jax.random.randint(key, batch.shape, 0, 1000)

    def share(common, batch):
        one, two, both = batch
        drawn = parallel.whole(draw, jnp.concatenate(both), mesh, parts=2)
        gathered = jax.lax.all_gather(drawn.reshape(2, -1, 3), "data", axis=1, tiled=True)
        return parallel.nanmean(one.ravel(), mesh), parallel.nanmean(two, mesh), parallel.mean(common * one[0, 0], mesh), gathered

    given = (values, np.full(8, np.nan, np.float32), (pictures[:8], pictures[8:]))
    some, none, mean, drawn = jax.jit(parallel.over_batch(share, mesh))(2.0, given)
    np.testing.assert_allclose(some, np.nanmean(values))
    assert np.isnan(none) and np.isnan(mean)
    np.testing.assert_array_equal(drawn.reshape(16, 3), jax.jit(draw)(pictures))
    (directory / "done").touch()


def agents(directory, number):
    """The default agent, an example on each device."""
    leave(directory, "agent", *advance(dataclasses.replace(agent(int(number)), mesh=parallel.mesh("train.batch_size", int(number)))))


def processes(directory):
    """What processes tell each other, and a checkpoint that is split over them."""
    parallel.initialize()
    assert jax.process_count() == 2 and jax.device_count() == 2
    mine = jax.process_index()
    mesh = parallel.mesh("n", 2)
    assert parallel.first(lambda: {"who": mine}) == {"who": 0}
    assert [parallel.anywhere(flag) for flag in (False, mine == 1, True)] == [False, True, True]
    try:
        parallel.first(lambda: open(directory / "nowhere" / "file"))
    except (FileNotFoundError, parallel.PeerError) as error:
        assert type(error) is (parallel.PeerError if mine else FileNotFoundError) and "No such file" in str(error)
    tree = {"own": np.full(4, mine + 1.0, np.float32), "step": jnp.int32(7), "flag": np.bool_(True)}
    placed = parallel.place(tree, mesh, shard=True)
    assert specs(placed) == {"own": PartitionSpec("data"), "step": PartitionSpec(), "flag": PartitionSpec()}
    assert placed["own"].addressable_data(0).shape == (2,) and not placed["own"].is_fully_addressable
    assert test_train_step.bits(parallel.here(placed, mesh)) == test_train_step.bits({**tree, "own": np.ones(4, np.float32)})  # the first's
    double = jax.jit(lambda tree: parallel.constrain({**tree, "own": jnp.arange(4.0) + tree["own"]}, mesh, shard=True))(placed)
    store = checkpoint.Checkpoints(directory / "checkpoints", keep=1)
    for step in (1, 2, 2):
        store.save_latest(step, double, **STORED)
    assert store.save_best(2, double, 5.0, **STORED) and not store.save_best(3, double, 4.0, **STORED)
    for template in (double, jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), double)):
        step, found = checkpoint.Checkpoints(directory / "checkpoints").restore_latest(template)
        assert step == 2 and test_train_step.bits(parallel.here(found, None if template is not double else mesh)) == [
            (np.dtype(bool), (), b"\x01"), (np.dtype(np.float32), (4,), np.array([1, 2, 3, 4], np.float32).tobytes()),
            (np.dtype(np.int32), (), np.int32(7).tobytes()),
        ]  # fmt: skip
    try:
        apart = checkpoint.Checkpoints(directory / f"apart-{mine}")
        if mine == 0:
            (apart.directory / "latest" / "5").mkdir(parents=True)
            (apart.directory / "latest" / "5.json").touch()
        apart.restore_latest(double)
        raise AssertionError("two directories were taken for one")
    except checkpoint.CheckpointError as error:
        assert "all processes share" in str(error)
    several, real, lost = checkpoint.Checkpoints(directory / "several"), checkpoint._check_files, {"2"}
    for step in (1, 2):
        several.save_latest(step, double, **STORED)

    def check(path, side):
        if mine == 1 and path.name in lost:
            raise checkpoint.CheckpointError(f"{path} is damaged: disk error")
        real(path, side)

    checkpoint._check_files = check  # one process cannot read what the other can
    assert several.restore_latest(double)[0] == 1
    lost.add("1")
    try:
        several.restore_latest(double)
        raise AssertionError("a process went on by itself")
    except checkpoint.CheckpointError as error:
        assert "no intact checkpoint in" in str(error) and ("disk error" if mine else "another process cannot read") in str(error)
    (directory / f"done-{mine}").touch()


if __name__ == "__main__":
    _, what, where, *more = sys.argv
    {"devices": devices, "reductions": reductions, "agents": agents, "processes": processes}[what](pathlib.Path(where), *more)
