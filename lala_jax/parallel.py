"""Several devices and several processes: who they are, what lies where, and how processes wait for each other.

Training is data-parallel. Every device runs the program of one device on its share of the batch, and averages are taken over all
shares. The mesh has one axis, DATA, over all devices of all processes. Where there is one device there is no mesh, and nothing here
changes the program.
"""

from __future__ import annotations

import importlib.util
import itertools
import os
import pathlib
import pickle
import re
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from lala_jax import options

DATA = "data"
EXPLICIT = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")
VISIBLE = ("CUDA_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES")
PATIENCE = 7 * 24 * 3600 * 1000  # milliseconds that processes wait for what the first one does; one that dies is noticed at once

T = TypeVar("T")


class PeerError(RuntimeError):
    """What the first process did for all has failed there."""


# Processes


def launched(environ: Mapping[str, str], *, attached: int = 0) -> dict[str, Any] | None:
    """Read from a process's environment what `jax.distributed.initialize` is to be told; None where the process is alone.

    `attached` GPUs are on the node, which the processes there share where the environment does not say which ones they see.
    The variables of EXPLICIT come first, then Open MPI, a Slurm step, and a pod of an Indexed Job where the package `kubernetes` is
    installed; what is not told JAX finds out itself. Raises OptionsError where a variable of EXPLICIT is missing or no number, and where
    Open MPI, from its version 5 on, does not tell where the first process is.
    """
    incomplete = options.OptionsError(f"the environment sets some, but not all of {', '.join(EXPLICIT)}")
    address, *numbers = (environ.get(name) for name in EXPLICIT)
    if numbers != [None, None]:
        if None in (address, *numbers):
            raise incomplete
        count, process = (_number(environ, name) for name in EXPLICIT[1:])
        if not 0 <= process < count:
            raise options.OptionsError(f"JAX_PROCESS_ID must be from 0 to JAX_NUM_PROCESSES - 1 = {count - 1}, got {process}")
        return {"coordinator_address": address, "num_processes": count, "process_id": process} if count > 1 else None
    told: dict[str, Any]
    if "OMPI_COMM_WORLD_SIZE" in environ:  # before Slurm, as in JAX: mpirun within a step starts more processes than srun knows of
        told = {"num_processes": _number(environ, "OMPI_COMM_WORLD_SIZE")}
        if told["num_processes"] > 1 and "OMPI_MCA_orte_hnp_uri" not in environ:
            if address is None:
                raise options.OptionsError(f"Open MPI 5 does not tell where the first process is: set {EXPLICIT[0]}=HOST:PORT")
            told |= {"coordinator_address": address, "process_id": _number(environ, "OMPI_COMM_WORLD_RANK")}
        devices = _devices(environ, environ.get("OMPI_COMM_WORLD_LOCAL_RANK"), environ.get("OMPI_COMM_WORLD_LOCAL_SIZE"), attached)
    elif "SLURM_STEP_NODELIST" in environ:  # inside srun; a batch script by itself is one process, whatever the job's tasks
        told = {"num_processes": _number(environ, "SLURM_STEP_NUM_TASKS" if "SLURM_STEP_NUM_TASKS" in environ else "SLURM_NTASKS")}
        beside = environ.get("SLURM_STEP_TASKS_PER_NODE", "")  # 4 or 4(x2), where they are as many on every node
        here = re.fullmatch(r"(\d+)(\(x\d+\))?", beside)
        own = "SLURM_GPUS_PER_TASK" in environ
        devices = _devices(environ, environ.get("SLURM_LOCALID"), here and here[1], attached, own=own)
    else:
        indexed = {"KUBERNETES_SERVICE_HOST", "JOB_COMPLETION_INDEX"} <= environ.keys()
        if indexed and importlib.util.find_spec("kubernetes"):
            return {}
        if address is not None:  # what a scheduler would tell is missing
            raise incomplete
        return None
    return {**told, **devices} if told["num_processes"] > 1 else None


def _devices(environ: Mapping[str, str], place: str | None, beside: str | None, attached: int, *, own: bool = False) -> dict[str, Any]:
    """Say which GPUs that a process sees are its own, where JAX, which takes the one numbered as its `place` on the node, would err.

    All, where it is the only one `beside` itself on the node, or where what it sees is its `own`; else an equal share of them.
    """
    named = next((environ[name].split(",") for name in VISIBLE if environ.get(name)), None)
    seen = attached if named is None else len(named)
    if "JAX_LOCAL_DEVICE_IDS" in environ or None in (place, beside):
        return {}
    if own or beside == "1" or named is not None and seen == 1:
        return {"local_device_ids": []}  # JAX then takes them all
    share, first = seen // int(beside), int(place)
    return {"local_device_ids": list(range(first * share, (first + 1) * share))} if share > 1 else {}


def _number(environ: Mapping[str, str], name: str) -> int:
    try:
        return int(environ[name])
    except (KeyError, ValueError):
        raise options.OptionsError(f"environment variable {name} must be a whole number, got {environ.get(name)!r}") from None


def initialize() -> None:
    """Join the other processes of the run where `launched` finds any; to be called before JAX is first used."""
    told = launched(os.environ, attached=len(list(pathlib.Path("/dev").glob("nvidia[0-9]*"))))
    if told is None or jax.distributed.is_initialized():
        return
    jax.distributed.initialize(**told)
    if jax.process_count() > 1:
        _client().wait_at_barrier("lala_jax/start", PATIENCE)
        anywhere(False)  # the first exchange between CPUs finds its peers within 30 s or fails: now, while they keep step


def is_first() -> bool:
    """Say whether this is the process that writes, prints and evaluates."""
    return jax.process_index() == 0


def say(text: str) -> None:
    """Print a line, in the first process only."""
    if is_first():
        print(text, flush=True)


def _client():
    """Give JAX's own store of keys and values, which has no public name; there is one where there are several processes."""
    from jax._src import distributed

    assert distributed.global_state.client is not None
    return distributed.global_state.client


_turns = itertools.count()


def first(work: Callable[[], T]) -> T:
    """Let the first process do `work`, and give what it returned (to be pickled) in all; every process must make this call.

    Others wait without a device, whose collectives have time limits. Raises PeerError in them where the first one raised.
    """
    if jax.process_count() == 1:
        return work()
    client, key = _client(), f"lala_jax/{next(_turns)}"
    if not is_first():
        answer, failure = pickle.loads(client.blocking_key_value_get_bytes(key, PATIENCE))
        if failure:
            raise PeerError(f"the first process failed: {failure}")
        return answer
    try:
        answer = work()
        told = pickle.dumps((answer, ""))
    except BaseException as error:
        client.key_value_set_bytes(key, pickle.dumps((None, f"{type(error).__name__}: {error}")))
        raise
    client.key_value_set_bytes(key, told)
    return answer


def anywhere(flag: bool) -> bool:
    """Say in all processes whether `flag` is true in any; every process must make this call."""
    if jax.process_count() == 1:
        return flag
    from jax.experimental import multihost_utils

    return bool(multihost_utils.process_allgather(np.bool_(flag)).any())


# Devices


def mesh(name: str, batch_size: int) -> Mesh | None:
    """Give the mesh of all devices, None for a single one; raises OptionsError where they cannot share `batch_size`, the field `name`."""
    devices = jax.devices()
    if len(devices) == 1:
        return None
    if batch_size % len(devices):
        much = f"config field {name}={batch_size} cannot be shared alike by {len(devices)} devices"
        raise options.OptionsError(f"{much}: make it a multiple of {len(devices)}, or show fewer devices (say, CUDA_VISIBLE_DEVICES=0)")
    return Mesh(np.array(devices), (DATA,))


def shardings(mesh: Mesh, tree: Any, *, shard: bool = False) -> Any:
    """Say where each leaf lies: on every device, or with `shard` split along its largest axis that the number of devices divides."""

    def one(leaf):
        axes = [axis for axis, size in enumerate(leaf.shape) if shard and size and size % mesh.size == 0]
        where = max(axes, key=lambda axis: leaf.shape[axis], default=None)
        return NamedSharding(mesh, PartitionSpec() if where is None else PartitionSpec(*[None] * where, DATA))

    return jax.tree.map(one, tree)


def place(tree: Any, mesh: Mesh | None, *, shard: bool = False) -> Any:
    """Put arrays that each process holds whole on the devices as `shardings` says, committed; the first process's values count.

    Without a mesh, on the one device. Machines need not agree on the last bit of what they compute, and copies must not differ.
    """
    if mesh is None:
        return jax.device_put(tree, jax.devices()[0])
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        tree = multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, tree))
    return jax.tree.map(put, tree, shardings(mesh, tree, shard=shard))


def put(array: Any, sharding: jax.sharding.Sharding) -> jax.Array:
    """Put an array that each process holds whole, and alike, where `sharding` says."""
    if sharding.is_fully_addressable:
        return jax.device_put(array, sharding)
    return jax.make_array_from_callback(np.shape(array), sharding, lambda index: np.asarray(array)[index])


def constrain(tree: Any, mesh: Mesh | None, *, shard: bool) -> Any:
    """Keep what a jitted function computes where `shardings` says; nothing without a mesh."""
    return tree if mesh is None else jax.lax.with_sharding_constraint(tree, shardings(mesh, tree, shard=shard))


def is_split(leaf: Any) -> bool:
    """Say whether an array's parts lie on several devices."""
    return isinstance(leaf, jax.Array) and not leaf.is_fully_replicated


def fetch(leaf: jax.Array) -> np.ndarray:
    """Bring an array to the host, whole; every process must make this call where `leaf` lies in several."""
    if leaf.is_fully_addressable:
        return np.asarray(leaf)
    if leaf.is_fully_replicated:
        return np.asarray(leaf.addressable_data(0))
    from jax.experimental import multihost_utils

    return multihost_utils.process_allgather(leaf, tiled=True)


def here(tree: Any, mesh: Mesh | None) -> Any:
    """Copy a pytree to this process's first device, for programs of one device; it stays as it is without a mesh."""
    return tree if mesh is None else jax.device_put(jax.tree.map(fetch, tree), jax.local_devices()[0])


# Inside a program


def over_batch(function: Callable[[Any, Any], Any], mesh: Mesh | None) -> Callable[[Any, Any], Any]:
    """Let each device apply `function(common, batch)` to its share of the batch (leaves `[B, ...]`).

    What it gives must be the same on all devices: `mean` and `nanmean` see to it. Without a mesh it is the function itself.
    """
    if mesh is None:
        return function
    # What varies over the devices is not tracked: the carries of the renderer's loops start as constants.
    return jax.shard_map(function, mesh=mesh, in_specs=(PartitionSpec(), PartitionSpec(DATA)), out_specs=PartitionSpec(), check_vma=False)


def mean(tree: Any, mesh: Mesh | None) -> Any:
    """Average what each device has of its share over all shares; inside `over_batch`."""
    return tree if mesh is None else jax.lax.pmean(tree, DATA)


def nanmean(values: jax.Array, mesh: Mesh | None) -> jax.Array:
    """Average the values `[b]` of all examples of all shares, NaN left out; NaN where nothing is left. Inside `over_batch`."""
    if mesh is None:
        return jnp.nanmean(values)
    total, count = jax.lax.psum((jnp.nansum(values), (~jnp.isnan(values)).sum()), DATA)
    return total / count


def whole(function: Callable[[jax.Array], jax.Array], values: jax.Array, mesh: Mesh | None, *, parts: int = 1) -> jax.Array:
    """Apply `function` to the whole batch and give this share of it: for what draws from one key for all. Inside `over_batch`.

    `values` `[parts * b, ...]` are the shares of so many batches one after another, and so are the results.
    """
    if mesh is None:
        return function(values)
    share = values.reshape(parts, -1, *values.shape[1:])
    batch = jax.lax.all_gather(share, DATA, axis=1, tiled=True)
    done = function(batch.reshape(-1, *values.shape[1:])).reshape(batch.shape)
    begin = jax.lax.axis_index(DATA) * share.shape[1]
    return jax.lax.dynamic_slice_in_dim(done, begin, share.shape[1], axis=1).reshape(values.shape)
