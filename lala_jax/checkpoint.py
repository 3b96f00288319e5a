"""Training states on disk: the only place that sees Orbax.

    <directory>/latest/<step>/       an Orbax v1 checkpoint: a flat dict from leaf name to array
    <directory>/latest/<step>.json   beside it: CRC32, shape and dtype of every leaf, CRC32 of every file, config, input spec, score
    <directory>/best/...             the same, the one step with the best score

Orbax stores no checksum of its payload and loads most flipped bytes silently. So the side file is written last, by one rename: a
step exists from then on, and is intact when its files and leaves match. The files are compared before Orbax sees them, which on
damaged ones leaves failed background tasks behind. Leaves are named by their path in the pytree (`params/Dense_0/kernel`).

A leaf that is split over devices is written by Orbax in its parts, each process its own, into one directory that all share; all else the
first process writes. A checksum is of the whole leaf, which is gathered for it one at a time, so that it does not depend on how the leaf
was split. Reading gives every process whole leaves, compares them, and only then puts them where the template's are, however many
devices that is.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import pathlib
import shutil
import signal
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax import parallel, writers

FORMAT_VERSION = 1

_LOG = logging.getLogger(__name__)
_Read = TypeVar("_Read")


class CheckpointError(ValueError):
    """Checkpoints that are missing, damaged, of another format or already ahead."""


class MismatchError(CheckpointError):
    """An intact checkpoint of another model: a leaf is missing, extra, or has another shape or dtype."""


class Checkpoints:
    """The checkpoints of one run: the newest `keep` steps, and the best.

    One run per directory; every process of a multi-process run makes the same calls.
    """

    def __init__(self, directory: str | os.PathLike[str], *, keep: int = 2):
        if keep < 1:
            raise CheckpointError(f"keep must be at least 1, got {keep}")
        self.directory = pathlib.Path(directory).absolute()
        self.keep = keep
        self._damaged: set[pathlib.Path] = set()  # seen by this object: no obstacle to saving, first to go

    def save_latest(self, step: int, state: Any, *, config: Mapping[str, Any], input_spec: Mapping[str, Any]) -> None:
        """Commit `state` as `step`, then drop steps past `keep`; returns when it is on disk.

        A kill at any moment leaves the steps before it. Raises CheckpointError where the directory holds a newer intact step: this
        run did not continue from it.
        """
        folder = self.directory / "latest"
        self._drop_damaged(folder)
        newer = parallel.first(lambda: [other for other in _steps(folder) if other > step])
        if newer:
            raise CheckpointError(f"{folder} holds step {newer[0]} already, newer than {step}: restore it, or choose another directory")
        _save(folder, step, state, {"config": config, "input_spec": input_spec, "score": None})
        _remove(folder, _steps(folder)[self.keep :])

    def save_best(self, step: int, state: Any, score: float, *, config: Mapping[str, Any], input_spec: Mapping[str, Any]) -> bool:
        """Commit `state` as the best if `score` (finite, higher is better) is at least the stored one; say whether it was."""
        if not np.isfinite(score):
            raise CheckpointError(f"score of step {step} must be finite, got {score}")
        folder = self.directory / "best"
        self._drop_damaged(folder)
        before, better = parallel.first(lambda: (_steps(folder), [_stored_score(folder, other) > score for other in _steps(folder)]))
        if any(better):
            return False
        _save(folder, step, state, {"config": config, "input_spec": input_spec, "score": float(score)})
        _remove(folder, [other for other in before if other != step])
        return True

    def restore_latest(self, template: Any) -> tuple[int, Any] | None:
        """Give `(step, state)` of the newest intact step, or None where nothing was saved yet.

        `template` is a pytree of arrays or `jax.ShapeDtypeStruct`; the state has its structure, and its shardings where it has
        any. Damaged steps are logged and passed over, in all processes alike. Raises MismatchError naming the leaf, the stored and the
        expected shape and dtype; CheckpointError where steps exist and none is intact, or where processes do not see the same steps.
        """
        folder = self.directory / "latest"
        steps = _steps(folder)
        if parallel.anywhere(parallel.first(lambda: steps) != steps):
            raise CheckpointError(f"{folder} must be one directory that all processes share: they do not see the same steps in it")
        if not steps:
            return None

        def read(folder: pathlib.Path, step: int) -> tuple[int, Any]:
            problem = _problem(folder, step)
            if parallel.anywhere(bool(problem)):  # all read it, or none
                raise CheckpointError(problem or f"{folder / str(step)}, which another process cannot read")
            return step, _restore(folder, step, template)

        return _first_intact(f"in {folder}", [(folder, step) for step in steps], read, damaged=self._damaged)

    def _drop_damaged(self, folder: pathlib.Path) -> None:
        whole = _steps(folder)
        _remove(folder, [step for step in _steps(folder, committed=False) if step not in whole or folder / str(step) in self._damaged])


def load(path: str | os.PathLike[str], template: Any = None, *, which: str = "best") -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Give `(state, config, input_spec)` from nothing but a path: a run's checkpoint directory, or one step's inside it.

    From a directory the `which` ("best" or "latest") step is read; if that is damaged or absent, the newest intact one, with a
    warning in the log. Without `template` the state is nested dicts of NumPy arrays keyed as the pytree was (sequences by
    "0", "1", ...); flax params come back as they were. Raises CheckpointError, MismatchError as `Checkpoints.restore_latest`.
    """

    def read(folder: pathlib.Path, step: int) -> tuple[Any, dict[str, Any], dict[str, Any]]:
        state, side = _restore(folder, step, template), _read_side(folder, step)
        return state, side["config"], side["input_spec"]

    return _first_at(path, which, read)


def describe(path: str | os.PathLike[str], *, which: str = "best") -> dict[str, Any]:
    """Give `step`, `score`, `config`, `input_spec`, `leaves` (name to shape, dtype, crc32) of the step that `load` reads, leaves unread."""

    def read(folder: pathlib.Path, step: int) -> dict[str, Any]:
        side = _read_side(folder, step)
        _check_files(folder / str(step), side)
        return {"step": step, **side}

    return _first_at(path, which, read)


def _first_at(path: str | os.PathLike[str], which: str, read: Callable[[pathlib.Path, int], _Read]) -> _Read:
    """Give what `read` makes of the step that `load` reads."""
    return _first_intact(f"at {path}", _candidates(pathlib.Path(path).absolute(), which), read)


def _first_intact(
    where: str,
    steps: Iterable[tuple[pathlib.Path, int]],
    read: Callable[[pathlib.Path, int], _Read],
    *,
    damaged: set[pathlib.Path] | None = None,
) -> _Read:
    """Give what `read` makes of the first of `steps` that is intact; damaged ones are logged, added to `damaged` and passed over."""
    problems = []
    for folder, step in steps:
        try:
            return read(folder, step)
        except MismatchError:
            raise
        except CheckpointError as error:
            _LOG.warning("passing over %s", error)
            problems.append(str(error))
            if damaged is not None:
                damaged.add(folder / str(step))
    raise CheckpointError(f"no intact checkpoint {where}:\n" + "\n".join(problems))


@contextlib.contextmanager
def stop_signals(signals: tuple[signal.Signals, ...] = (signal.SIGTERM,)) -> Iterator[Callable[[], bool]]:
    """Turn `signals` into a question: `with stop_signals() as stopped: ... if stopped(): save and leave`.

    A signal never interrupts a save. Old handlers return at the end; outside the main thread, where Python allows no handlers,
    the answer is always False.
    """
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event.is_set
        return
    before = {number: signal.signal(number, lambda *_: event.set()) for number in signals}
    try:
        yield event.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _steps(folder: pathlib.Path, *, committed: bool = True) -> list[int]:
    """List steps, newest first; uncommitted: also a payload or side file without the other."""
    if not folder.is_dir():
        return []
    payloads = {int(entry.name) for entry in folder.iterdir() if entry.name.isdigit() and entry.is_dir()}
    sides = {int(entry.stem) for entry in folder.glob("*.json") if entry.stem.isdigit()}
    return sorted(payloads & sides if committed else payloads | sides, reverse=True)


def _candidates(path: pathlib.Path, which: str) -> list[tuple[pathlib.Path, int]]:
    """List `(folder, step)` to try for `path`, in order."""
    if which not in ("best", "latest"):
        raise CheckpointError(f"which must be one of 'best', 'latest', got {which!r}")
    if path.name.isdigit() and path.with_suffix(".json").exists():
        return [(path.parent, int(path.name))]
    folders = [path / which, path / ("latest" if which == "best" else "best")]
    found = [(folder, step) for folder in folders for step in _steps(folder)]
    if not found:
        raise CheckpointError(f"no checkpoint at {path}: looked for steps in {folders[0]} and {folders[1]}{_near(path)}")
    if found[0][0] != folders[0]:
        _LOG.warning("%s holds no step, taking %s", folders[0], folders[1])
    return found


def _near(path: pathlib.Path) -> str:
    """Name the checkpoints below or above a path that is none; "" where there are none."""
    for folder in (path / "checkpoints", path.parent, path.parent.parent):
        if there := [str(folder / kind / str(step)) for kind in ("best", "latest") for step in _steps(folder / kind)]:
            return f"; did you mean {folder}, or one of its steps, {', '.join(there)}?"
    return ""


def named(tree: Any) -> dict[str, Any]:
    """Flatten a pytree to leaves by name, their path: `params/Dense_0/kernel`."""
    leaves = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator="/") or "value"
        if name in leaves:
            raise CheckpointError(f"two leaves of the state are both named {name!r}")
        leaves[name] = leaf
    return leaves


def crc32(tree: Any) -> int:
    """Give a checksum of a tree's leaves and their names, whatever their order."""
    crc = 0
    for name, leaf in sorted(named(tree).items()):
        crc = _crc(leaf, zlib.crc32(name.encode(), crc))
    return crc


def _host(name: str, leaf: Any) -> np.ndarray:
    """Bring one leaf to the host, whole."""
    if isinstance(leaf, jax.Array) and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        raise CheckpointError(f"leaf {name} is a typed PRNG key: store its seed, or jax.random.key_data of it")
    array = parallel.fetch(leaf) if isinstance(leaf, jax.Array) else np.asarray(leaf)
    if array.dtype == object:
        raise CheckpointError(f"leaf {name} is {type(leaf).__name__}, not an array or a number")
    return array


def _crc(array: np.ndarray, begin: int = 0) -> int:
    return zlib.crc32(np.ascontiguousarray(array).reshape(-1).view(np.uint8), begin)


def _digest(side: Mapping[str, Any]) -> int:
    fields = {key: value for key, value in side.items() if key != "crc32"}
    return zlib.crc32(json.dumps(fields, sort_keys=True).encode())


def _save(folder: pathlib.Path, step: int, state: Any, facts: Mapping[str, Any]) -> None:
    """Write the payload, then the side file, which makes it count."""
    from orbax.checkpoint import v1 as ocp

    leaves, described = {}, {}
    for name, leaf in named(state).items():
        array = _host(name, leaf)
        leaves[name] = leaf if parallel.is_split(leaf) else array
        described[name] = {"shape": array.shape, "dtype": str(array.dtype), "crc32": _crc(array)}
    if not leaves:
        raise CheckpointError(f"the state of step {step} has no leaves")
    side = writers.plain({"version": FORMAT_VERSION, **facts, "leaves": described})
    if parallel.first(lambda: _same(folder, step, side)):
        return  # as when a signal arrives right after a periodic save
    _remove(folder, [step])
    # Orbax refuses arrays without elements; their description says all there is to know
    ocp.save(folder / str(step), {name: leaf for name, leaf in leaves.items() if leaf.size} or {"empty": np.zeros(1)})
    parallel.first(lambda: _commit(folder, step, side))


def _commit(folder: pathlib.Path, step: int, side: Mapping[str, Any]) -> None:
    """Write the side file of a payload that is on disk."""
    files = [path for path in sorted((folder / str(step)).rglob("*")) if path.is_file()]
    crcs = {path.relative_to(folder / str(step)).as_posix(): zlib.crc32(path.read_bytes()) for path in files}
    side = {**side, "files": crcs}
    writers.write_json(folder / f"{step}.json", {**side, "crc32": _digest(side)})


def _same(folder: pathlib.Path, step: int, side: Mapping[str, Any]) -> bool:
    """Say whether `step` is there already, intact and with the same state and facts."""
    try:
        stored = _read_side(folder, step)
        _check_files(folder / str(step), stored)
    except CheckpointError:
        return False
    return all(stored[key] == value for key, value in side.items() if key != "version")


def _remove(folder: pathlib.Path, steps: Iterable[int]) -> None:
    """Take steps back, the side file first, without which a payload does not count; all processes wait for it."""

    def work():
        for step in steps:
            (folder / f"{step}.json").unlink(missing_ok=True)
            shutil.rmtree(folder / str(step), ignore_errors=True)

    parallel.first(work)


def _stored_score(folder: pathlib.Path, step: int) -> float:
    """Give a step's score; below all others where its side file is damaged."""
    try:
        return _read_side(folder, step)["score"]
    except CheckpointError:
        return -float("inf")


def _read_side(folder: pathlib.Path, step: int) -> dict[str, Any]:
    """Read and check a side file, without its own checksum."""
    file = folder / f"{step}.json"
    try:
        side = json.loads(file.read_bytes())
        same = side.pop("crc32") == _digest(side)
        version = side.pop("version")
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise CheckpointError(f"{file} is missing or damaged: {type(error).__name__} {error}") from error
    if not same:
        raise CheckpointError(f"{file} is damaged: its checksum does not match")
    if version != FORMAT_VERSION:
        raise CheckpointError(f"{file} has format version {version}, this code reads version {FORMAT_VERSION}")
    return side


def _restore(folder: pathlib.Path, step: int, template: Any) -> Any:
    """Read one step, check every leaf, and shape the result like `template`."""
    side = _read_side(folder, step)
    described = side["leaves"]
    if template is not None:
        _check_template(folder / str(step), described, template)
    _check_files(folder / str(step), side)
    leaves = _read_payload(folder / str(step), described)
    if template is None:
        return nest(leaves)
    placed = [_place(leaves[name], leaf) for name, leaf in named(template).items()]
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(template), placed)


def _problem(folder: pathlib.Path, step: int) -> str:
    """Say what is wrong with a step before it is read, "" where nothing is; of a single process its reading will tell."""
    if jax.process_count() == 1:
        return ""
    try:
        _check_files(folder / str(step), _read_side(folder, step))
    except CheckpointError as error:
        return str(error)
    return ""


def _check_files(path: pathlib.Path, side: Mapping[str, Any]) -> None:
    """Raise CheckpointError on the first payload file that is missing or changed."""
    for name, crc in side["files"].items():
        try:
            same = zlib.crc32((path / name).read_bytes()) == crc
        except OSError as error:
            raise CheckpointError(f"{path} is damaged: {name} cannot be read ({error})") from error
        if not same:
            raise CheckpointError(f"{path} is damaged: {name} does not match its checksum")


def _check_template(path: pathlib.Path, described: Mapping[str, Any], template: Any) -> None:
    """Raise MismatchError on the first leaf that differs, before any payload is read (Orbax would cast dtypes silently)."""
    numbers = {name: leaf if hasattr(leaf, "dtype") else np.asarray(leaf) for name, leaf in named(template).items()}
    expected = {name: (tuple(leaf.shape), str(leaf.dtype)) for name, leaf in numbers.items()}
    stored = {name: (tuple(leaf["shape"]), leaf["dtype"]) for name, leaf in described.items()}
    names = [name for name in sorted(expected.keys() | stored.keys()) if expected.get(name) != stored.get(name)]
    if names:
        name = min(names, key=lambda name: (not name.startswith("params/"), name))
        there, here = ("absent" if leaf is None else f"{leaf[1]} {list(leaf[0])}" for leaf in (stored.get(name), expected.get(name)))
        more = f" ({len(names) - 1} more leaves differ)" if len(names) > 1 else ""
        raise MismatchError(f"{path} is of another model: leaf {name} is {there} in the checkpoint, {here} here{more}")


def _read_payload(path: pathlib.Path, described: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Read the leaves and compare each with its description."""
    from orbax.checkpoint import v1 as ocp

    whole = {name: np.zeros(leaf["shape"], jnp.dtype(leaf["dtype"])) for name, leaf in described.items()}  # on the host, not split
    empty = {name: leaf for name, leaf in whole.items() if not leaf.size}
    try:
        wanted = {name: leaf for name, leaf in whole.items() if leaf.size}
        leaves = {**ocp.load(path, wanted), **empty} if wanted else empty
    except Exception as error:  # Orbax and TensorStore raise many kinds and hide the reason in the cause
        reason = error.__cause__ or error
        raise CheckpointError(f"{path} is damaged: {type(reason).__name__} {str(reason)[:300]}") from error
    for name, leaf in described.items():
        array = np.asarray(leaves[name]) if name in leaves else None
        if array is None or list(array.shape) != leaf["shape"] or str(array.dtype) != leaf["dtype"] or _crc(array) != leaf["crc32"]:
            raise CheckpointError(f"{path} is damaged: leaf {name} does not match its checksum")
    return {name: np.asarray(leaves[name]) for name in described}


def nest(leaves: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Turn `a/b` names into nested dicts: the inverse of `named` for trees of dicts."""
    tree: dict[str, Any] = {}
    for name, leaf in leaves.items():
        *parents, last = name.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[last] = leaf
    return tree


def _place(array: np.ndarray, like: Any) -> Any:
    """Put a leaf where its template's is: a device, the host, or a Python number."""
    if isinstance(like, (jax.Array, jax.ShapeDtypeStruct)):
        return jax.device_put(array) if like.sharding is None else parallel.put(array, like.sharding)
    return array if isinstance(like, (np.ndarray, np.generic)) else array.item()
