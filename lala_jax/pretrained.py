"""Trained weights that ship with the package, and the one reader of whatever `--checkpoint` names.

    lala_jax/weights/<task>/weights.npz   the averaged parameters, flat names, float32 or bfloat16 bits as uint16; no pickle
    lala_jax/weights/<task>/card.json     SHA-256 of weights.npz, config, input spec, data, commands, reported scores
    lala_jax/weights/<task>/README.md     the card for people

`pretrained/<task>` names such a directory from anywhere. `lala_jax.publish` makes one from a checkpoint and its scores.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import pathlib
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from lala_jax import checkpoint, defaults, options

FORMAT_VERSION = 1
WEIGHTS = pathlib.Path(__file__).resolve().parent / "weights"
PREFIX = "pretrained"
CARD, ARRAYS = "card.json", "weights.npz"
FIELDS = ("sha256", "dtype", "step", "config", "input_spec", "scores")  # of the card, read here
STORED = {"float32": np.float32, "bfloat16": np.uint16}  # dtype of the parameters to that of the arrays
COMPARED = ("seed", "task", "camera", "map", "model")  # groups of the config that a score belongs to


def names() -> list[str]:
    """List the policies that this installation has."""
    return sorted(path.name for path in WEIGHTS.glob("*") if not path.suffix and is_published(path))


def is_published(path: pathlib.Path) -> bool:
    """Say whether a directory holds published weights, whole or damaged."""
    return (path / CARD).exists() or (path / ARRAYS).exists()


def find(path: str | os.PathLike[str]) -> pathlib.Path:
    """Give the directory that `path` names: itself, or for `pretrained/NAME`, where no such path exists, the package's.

    Raises CheckpointError listing the valid names for an unknown one.
    """
    given = pathlib.Path(path)
    if given.parts[:1] != (PREFIX,) or given.exists():
        return given
    name, valid = "/".join(given.parts[1:]), names()
    if name not in valid:
        choices = "valid: " + ", ".join(f"{PREFIX}/{choice}" for choice in valid) if valid else "this installation has none"
        raise checkpoint.CheckpointError(f"no pretrained policy {name!r}; {choices}")
    return WEIGHTS / name


def load(path: str | os.PathLike[str]) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Give `(averaged parameters, config, input_spec)` of published weights or of a run's best checkpoint.

    The parameters are nested dicts of NumPy arrays, float32 also from bfloat16. Raises CheckpointError naming the file that is
    missing, damaged, or of another format version.
    """
    folder, found = find(path), card(path)
    if found is not None:
        return _read_arrays(folder / ARRAYS, found), defaults.complete(found["config"]), found["input_spec"]
    state, config, input_spec = checkpoint.load(folder)
    return state["average"], defaults.complete(config), input_spec


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Give at least `step`, `config` (with the fields that it is older than) and `input_spec` of what `load` reads, parameters unread."""
    found = card(path)
    found = checkpoint.describe(find(path)) if found is None else found
    return {**found, "config": defaults.complete(found["config"])}


def fingerprint(path: str | os.PathLike[str], params: Any) -> dict[str, Any]:
    """Say what identifies the weights of a checkpoint: the step, and a checksum of all leaves."""
    return {"step": describe(path)["step"], "crc32": checksum(params)}


def checksum(tree: Any) -> int:
    """Give one CRC-32 of the bytes of all leaves, in the order of their names."""
    return zlib.crc32(b"".join(np.asarray(leaf).tobytes() for _, leaf in sorted(checkpoint.named(tree).items())))


def card(path: str | os.PathLike[str]) -> dict[str, Any] | None:
    """Read the card of published weights; None where `path` is something else, say a run's checkpoints."""
    folder = find(path)
    if not is_published(folder):
        return None
    file = folder / CARD
    try:
        found = json.loads(file.read_bytes())
        version = found["version"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise checkpoint.CheckpointError(f"{file} is missing or damaged: {type(error).__name__} {error}") from error
    if version != FORMAT_VERSION:
        raise checkpoint.CheckpointError(f"{file} has format version {version}, this code reads version {FORMAT_VERSION}")
    missing = [name for name in FIELDS if name not in found]
    if missing or found["dtype"] not in STORED:
        reason = f"no field {', '.join(missing)}" if missing else f"dtype {found['dtype']!r} is not one of {', '.join(STORED)}"
        raise checkpoint.CheckpointError(f"{file} is damaged: {reason}")
    return found


def pack(params: Any, dtype: str) -> bytes:
    """Give the bytes of `weights.npz`; a pytree always gives the same ones. Raises CheckpointError on a leaf that is not float32."""
    leaves = {name: np.asarray(leaf) for name, leaf in sorted(checkpoint.named(params).items())}
    for name, leaf in leaves.items():
        if leaf.dtype != np.float32:
            raise checkpoint.CheckpointError(f"leaf {name} is {leaf.dtype}: only float32 parameters can be published")
    if dtype == "bfloat16":
        leaves = {name: leaf.astype(jnp.bfloat16).view(np.uint16) for name, leaf in leaves.items()}
    buffer = io.BytesIO()
    np.savez(buffer, **leaves)
    return buffer.getvalue()


def _read_arrays(file: pathlib.Path, found: Mapping[str, Any]) -> dict[str, Any]:
    """Read the parameters, compared with the card's hash before anything else looks at them."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise checkpoint.CheckpointError(f"{file} cannot be read: {error}") from error
    if hashlib.sha256(content).hexdigest() != found["sha256"]:
        raise checkpoint.CheckpointError(f"{file} is damaged: its SHA-256 is not the one in {CARD}")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            leaves = {name: stored[name] for name in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise checkpoint.CheckpointError(f"{file} is not what lala_jax.publish writes: {error}") from error
    for name, leaf in leaves.items():
        if leaf.dtype != STORED[found["dtype"]]:
            raise checkpoint.CheckpointError(f"{file} is not what its card says: leaf {name} is {leaf.dtype}, not {found['dtype']}")
    if found["dtype"] == "bfloat16":
        leaves = {name: leaf.view(jnp.bfloat16).astype(np.float32) for name, leaf in leaves.items()}
    return checkpoint.nest(leaves)


def differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """List the fields that decide a score and are not the same in two configs (as JSON holds them)."""
    whole = (defaults.complete(config) for config in (there, here))
    return options.differences(*(options.fields({group: config[group] for group in COMPARED}) for config in whole))


def verdict(
    found: Mapping[str, Any], config: Mapping[str, Any], *, split: str, seeds: Sequence[int], result: Mapping[str, Any]
) -> tuple[bool, str]:
    """Compare a score with the one that the card reports for the same world and seeds: `(no contradiction, what to say)`.

    `config` is as JSON holds it. Another world or other seeds are no contradiction, and nothing is compared.
    """
    changed = differences(found["config"], config)
    if changed:
        return True, f"not compared with the reported score, which has another {', '.join(changed)}"
    same = {"split": split, "seeds": [seeds[0], seeds[-1]]}
    rows = [row for row in found["scores"] if all(row[name] == value for name, value in same.items())]
    if not rows:
        reported = " and ".join(f"{row['split']} seeds {row['seeds'][0]} to {row['seeds'][1]}" for row in found["scores"])
        return True, f"not compared with the reported score, which is of {reported}, not {split} seeds {seeds[0]} to {seeds[-1]}"
    (low, high), reported, score = rows[0]["interval95"], rows[0]["score"], result["score"]
    if math.isclose(score, reported, abs_tol=1e-6):
        return True, f"reproduced: equal to the reported score of {reported:.1f}"
    claim = f"{reported:.1f} [{low:.1f}, {high:.1f}]"
    if low <= score <= high:
        return True, f"reproduced: {score:.1f} differs from the reported {claim}, but lies within the interval"
    return False, f"NOT reproduced: {score:.1f} DIFFERS by more than the interval from the reported {claim}"
