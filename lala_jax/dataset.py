"""Recorded demonstrations on disk: a directory per task and options of it, of checksummed shards.

    <path>/meta.json           task, task options, format version
    <path>/shard-000000.demo   one `append` each, in order; never changed once written

A shard is `MAGIC | version u32 | body length u64 | SHA-256 of all before and of the body | body`, little-endian; its body is an
uncompressed `.npz` (no pickle) with one array per leaf and demonstration. Every byte is covered: a changed one is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import pathlib
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lala_jax import types, writers

FORMAT_VERSION = 1
COLLECT_COMMAND = "python -m lala_jax.collect --config=configs/{task}.py"

_MAGIC = b"LALADEMO"
_PREFIX = struct.Struct("<8sIQ")
_SHA = 32
_SCENE = ("size", "color", "base", "start", "goal", "symmetry")
_ACTION = ("pick", "place", "yaw")
_REST = ("poses", "placed", "ready", "seed", "score")


class DatasetError(ValueError):
    """Recorded demonstrations that are missing, damaged, of another kind, or too few."""


def save(path: str | os.PathLike[str], demos: Sequence[types.Demo], *, task: str, task_options: Mapping[str, Any]) -> None:
    """Write a new dataset of `demos`.

    Raises DatasetError where one exists already, and as `append` does.
    """
    path = pathlib.Path(path)
    if (path / "meta.json").exists() or _shards(path):
        raise DatasetError(f"{path} holds a dataset already: append to it, or choose another path")
    append(path, demos, task=task, task_options=task_options)


def append(path: str | os.PathLike[str], demos: Sequence[types.Demo], *, task: str, task_options: Mapping[str, Any]) -> None:
    """Add `demos` as one shard, making the dataset if there is none: after a kill the shard is whole or absent. One writer per path.

    `**build.data_identity(config)` gives the task and the options that training with a config asks for. Raises DatasetError for no demos,
    for shapes or numbers that break `types.Demo`, another number of objects than the options' or the first's, or where `path` holds
    another task or other options.
    """
    path = pathlib.Path(path)
    if not demos:
        raise DatasetError(f"no demonstrations to write to {path}")
    wanted = task_options["num_objects"] + task_options.get("distractors", 0) if "num_objects" in task_options else None
    for index, demo in enumerate(demos):
        _check_demo(demo, index, len(demos[0].scene.size) if wanted is None else wanted)
    meta = {"task": task, "task_options": writers.plain(task_options)}
    if (path / "meta.json").exists():
        _check_same(path, _read_meta(path), meta)
    elif _shards(path):
        raise DatasetError(f"{path / 'meta.json'} is missing beside the shards {[shard.name for shard in _shards(path)]}")
    else:
        writers.write_json(path / "meta.json", {"version": FORMAT_VERSION, **meta, "sha256": _meta_digest(FORMAT_VERSION, meta)})
    numbers = [int(shard.stem.removeprefix("shard-")) for shard in _shards(path)]
    _write_shard(path / f"shard-{max(numbers, default=-1) + 1:06d}.demo", demos)


def load(
    path: str | os.PathLike[str],
    *,
    count: int | None = None,
    task: str | None = None,
    task_options: Mapping[str, Any] | None = None,
) -> tuple[list[types.Demo], dict[str, Any]]:
    """Read the demonstrations (NumPy leaves, bit for bit as saved, in the order written) and the meta data.

    meta: `version`, `task`, `task_options`, `demos` (number read). With `count` only the first that many are given, whole shards
    past them are not read. Raises DatasetError for a missing, truncated, changed or newer file, another task or other options than
    asked for, or fewer demonstrations than `count`.
    """
    path = pathlib.Path(path)
    meta = _read_meta(path)
    wanted = {"task": task, "task_options": None if task_options is None else writers.plain(task_options)}
    _check_same(path, meta, {key: value for key, value in wanted.items() if value is not None})
    if count is not None and count < 1:
        raise DatasetError(f"count must be at least 1, got {count}")
    demos: list[types.Demo] = []
    for expected, shard in enumerate(_shards(path)):
        if not shard.stem.removeprefix("shard-").isdigit():
            raise DatasetError(f"{shard} is no shard that this code wrote: take it away")
        if shard.name != f"shard-{expected:06d}.demo":
            raise DatasetError(f"{path / f'shard-{expected:06d}.demo'} is missing: the next shard found is {shard.name}")
        if count is None or len(demos) < count:
            demos.extend(_read_shard(shard))
    if not demos or (count is not None and len(demos) < count):
        command = COLLECT_COMMAND.format(task=meta["task"])
        raise DatasetError(f"{path} holds {len(demos)} demonstrations, {count or 'some'} were asked for; to make more: {command}")
    return demos[:count], {**meta, "demos": len(demos)}


def seeds(path: str | os.PathLike[str]) -> np.ndarray:
    """List the seeds already recorded `[n]` int64 in the order written; none for a path without a dataset. For collection to resume."""
    if not (pathlib.Path(path) / "meta.json").exists() or not _shards(pathlib.Path(path)):
        return np.zeros((0,), np.int64)
    return np.array([int(demo.seed) for demo in load(path)[0]], np.int64)


def stack(demos: Sequence[types.Demo]) -> dict[str, np.ndarray]:
    """Flatten the demonstrations to M training states: those that an action followed and where some object was ready.

    Gives float32 `size` `[M, N, 3]`, `color` `[M, N, 3]`, `base` `[M, 7]`, `goal` `[M, N, 7]`, `symmetry` `[M, N]`, `poses`
    `[M, N, 7]` and bool `placed`, `ready` `[M, N]`, demonstration by demonstration in time order. Raises DatasetError where
    the number of objects differs or no state is left.
    """
    counts = {np.shape(demo.scene.size)[0] for demo in demos}
    if len(counts) > 1:
        raise DatasetError(f"all demonstrations of one batch need the same number of objects, got {sorted(counts)}")
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("size", "color", "base", "goal", "symmetry", "poses", "placed", "ready")}
    for demo in demos:
        keep = np.flatnonzero(np.asarray(demo.ready)[:-1].any(-1))
        for name in ("poses", "placed", "ready"):
            parts[name].append(np.asarray(getattr(demo, name))[keep])
        for name in ("size", "color", "base", "goal", "symmetry"):
            fixed = np.asarray(getattr(demo.scene, name))
            parts[name].append(np.broadcast_to(fixed, (len(keep), *fixed.shape)))
    if not sum(map(len, parts["poses"])):
        raise DatasetError(f"the {len(demos)} demonstrations hold no state with an action and a ready object")
    return {name: np.concatenate(arrays).astype(bool if name in ("placed", "ready") else np.float32) for name, arrays in parts.items()}


def _leaves(demo: types.Demo) -> dict[str, np.ndarray]:
    """Name every leaf of a demonstration, as NumPy."""
    named = {f"scene.{name}": getattr(demo.scene, name) for name in _SCENE}
    named |= {f"action.{name}": getattr(demo.action, name) for name in _ACTION}
    named |= {name: getattr(demo, name) for name in _REST}
    return {name: np.asarray(leaf) for name, leaf in named.items()}


def _demo(leaves: Mapping[str, np.ndarray]) -> types.Demo:
    """Undo `_leaves`."""
    scene = types.Scene(**{name: leaves[f"scene.{name}"] for name in _SCENE})
    action = types.PickPlace(**{name: leaves[f"action.{name}"] for name in _ACTION})
    return types.Demo(scene=scene, action=action, **{name: leaves[name] for name in _REST})


def _check_demo(demo: types.Demo, index: int, objects: int) -> None:
    """Raise DatasetError naming the first leaf whose shape, kind or numbers break `types.Demo`, or another number of objects."""
    leaves = _leaves(demo)
    n, t = np.shape(demo.scene.size)[0], np.shape(demo.action.yaw)[0]
    shapes = {"size": (n, 3), "color": (n, 3), "base": (7,), "start": (n, 7), "goal": (n, 7), "symmetry": (n,)}
    expected: dict[str, tuple[int, ...]] = {f"scene.{name}": shape for name, shape in shapes.items()}
    expected |= {"action.pick": (t, 3), "action.place": (t, 3), "action.yaw": (t,)}
    expected |= {"poses": (t + 1, n, 7), "placed": (t + 1, n), "ready": (t + 1, n), "seed": (), "score": ()}
    for name, leaf in leaves.items():
        if leaf.shape != expected[name]:
            raise DatasetError(f"demonstration {index}: {name} has shape {leaf.shape}, expected {expected[name]} (N={n}, T={t})")
        kinds = {"placed": "b", "ready": "b", "seed": "iu"}.get(name, "f")
        if leaf.dtype.kind not in kinds:
            raise DatasetError(f"demonstration {index}: {name} is {leaf.dtype}, expected kind {kinds!r}")
        if kinds == "f" and not np.isfinite(leaf).all():
            raise DatasetError(f"demonstration {index}: {name} has values that are not finite")
    if n != objects:
        raise DatasetError(f"demonstration {index} has {n} objects, not {objects}: all of a dataset need as many")
    if wrong := types.out_of_range(demo.scene) or types.no_unit_quat("poses", demo.poses):
        raise DatasetError(f"demonstration {index}: {wrong}")


def _shards(path: pathlib.Path) -> list[pathlib.Path]:
    return sorted(path.glob("shard-*.demo"))


def _write_shard(path: pathlib.Path, demos: Sequence[types.Demo]) -> None:
    body = io.BytesIO()
    named = {f"{index:06d}/{name}": leaf for index, demo in enumerate(demos) for name, leaf in _leaves(demo).items()}
    np.savez(body, **named)  # type: ignore[arg-type]
    content = body.getvalue()
    prefix = _PREFIX.pack(_MAGIC, FORMAT_VERSION, len(content))
    with writers.atomic(path) as file:
        file.write(prefix + hashlib.sha256(prefix + content).digest() + content)


def _read_shard(path: pathlib.Path) -> list[types.Demo]:
    content = path.read_bytes()
    start = _PREFIX.size + _SHA
    if len(content) < start:
        raise DatasetError(f"{path} is truncated: {len(content)} bytes, shorter than its header")
    magic, version, length = _PREFIX.unpack_from(content)
    if magic != _MAGIC:
        raise DatasetError(f"{path} is not a shard of demonstrations: it starts with {magic!r}, not {_MAGIC!r}")
    if version != FORMAT_VERSION:
        raise DatasetError(f"{path} has format version {version}, this code reads version {FORMAT_VERSION}")
    if len(content) != start + length:
        raise DatasetError(f"{path} is truncated or too long: {len(content)} bytes, its header says {start + length}")
    body = memoryview(content)[start:]
    if hashlib.sha256(content[: _PREFIX.size] + body).digest() != content[_PREFIX.size : start]:
        raise DatasetError(f"{path} is damaged: its checksum does not match; restore it from a copy or collect it anew")
    groups: dict[str, dict[str, np.ndarray]] = {}
    with np.load(io.BytesIO(body), allow_pickle=False) as archive:
        for key in archive.files:
            index, name = key.split("/")
            groups.setdefault(index, {})[name] = archive[key]
    return [_demo(groups[index]) for index in sorted(groups)]


def _meta_digest(version: int, meta: Mapping[str, Any]) -> str:
    fields = {"version": version, "task": meta["task"], "task_options": meta["task_options"]}
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()


def _read_meta(path: pathlib.Path) -> dict[str, Any]:
    """Read and check meta.json."""
    file = path / "meta.json"
    if not file.exists():
        raise DatasetError(f"no dataset at {path}: {file.name} is missing; to make one: {COLLECT_COMMAND.format(task='<task>')}")
    try:
        meta = json.loads(file.read_bytes())
        version, digest = meta["version"], meta.pop("sha256")
        same = digest == _meta_digest(version, meta) and set(meta) == {"version", "task", "task_options"}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{file} is damaged: {type(error).__name__} {error}") from error
    if not same:
        raise DatasetError(f"{file} is damaged: its checksum does not match")
    if version != FORMAT_VERSION:
        raise DatasetError(f"{file} has format version {version}, this code reads version {FORMAT_VERSION}")
    return meta


def _check_same(path: pathlib.Path, meta: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    for key, value in wanted.items():
        if meta[key] != value:
            raise DatasetError(f"{path} holds {key} {meta[key]!r}, not {value!r}")
