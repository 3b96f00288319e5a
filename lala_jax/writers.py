"""Metrics, JSON and images on disk; every whole file appears at once or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any, BinaryIO

import numpy as np


@contextlib.contextmanager
def atomic(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a file that takes the name `path` only after the block ended without an error and its bytes are on disk.

    Written under a name of this process that ends in `.tmp`, and renamed; parents are made. Of several processes that write one path the
    last one's file stays, whole; within a process there must be one writer per path.
    """
    path = pathlib.Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    _sync_directory(path.parent)


def _sync_directory(directory: pathlib.Path) -> None:
    """Make a rename in `directory` survive a power cut, where the platform can open directories."""
    with contextlib.suppress(OSError):
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def make_directory(path: str | os.PathLike[str]) -> pathlib.Path:
    """Make a directory and its parents; raises OSError, before the work that is to be kept there, where nothing can be written to it."""
    path = pathlib.Path(path)
    path.mkdir(parents=True, exist_ok=True)
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    return path


def plain(value: Any) -> Any:
    """Turn arrays, NumPy scalars, tuples, paths and nested mappings into what JSON holds; not-finite floats become None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return plain(np.asarray(value).tolist())
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    raise TypeError(f"cannot write {type(value).__name__} {value!r} as JSON; valid: mappings, sequences, arrays, numbers, strings, None")


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as strict, indented JSON in one atomic step (see `plain` for what is converted)."""
    text = json.dumps(plain(value), indent=2, allow_nan=False)
    with atomic(path) as file:
        file.write(text.encode() + b"\n")


def write_image(path: str | os.PathLike[str], image: Any) -> None:
    """Write `image` `[H, W]`, `[H, W, 1]`, `[H, W, 3]` or `[H, W, 4]`, uint8 or floats in 0..1 (clipped), as a picture in one atomic step.

    The format follows the suffix. Raises ValueError for another shape, type or suffix, or for a NaN.
    """
    from PIL import Image

    path = pathlib.Path(path)
    pixels = np.asarray(image)
    if pixels.ndim == 3 and pixels.shape[-1] == 1:
        pixels = pixels[..., 0]
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[-1] in (3, 4))) or 0 in pixels.shape:
        raise ValueError(f"image for {path} must be [H, W], [H, W, 1], [H, W, 3] or [H, W, 4], got shape {np.shape(image)}")
    if np.issubdtype(pixels.dtype, np.floating):
        if not np.isfinite(pixels).all():
            raise ValueError(f"image for {path} has values that are not finite")
        pixels = np.rint(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise ValueError(f"image for {path} must be uint8 or floating, got {pixels.dtype}")
    formats = Image.registered_extensions()
    if path.suffix.lower() not in formats:
        raise ValueError(f"image suffix {path.suffix!r} of {path} is unknown; valid are for example .png, .webp, .jpg")
    with atomic(path) as file:
        Image.fromarray(pixels).save(file, format=formats[path.suffix.lower()])


def read_metrics(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Read a `metrics.jsonl`; a last line that a kill cut short is left out.

    Raises ValueError naming the line for damage anywhere else.
    """
    lines = pathlib.Path(path).read_bytes().split(b"\n")
    records = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            records.append(json.loads(line))
        except ValueError as error:
            if number == len(lines):  # no newline after it: the write never finished
                break
            raise ValueError(f"{path}: line {number} is not JSON ({error})") from error
    return records


class Writer:
    """Append scalars to `directory/metrics.jsonl` and, with `tensorboard`, to TensorBoard event files beside it.

    Reopening appends, so a resumed run continues its file; a line cut short by a kill is removed first.
    """

    def __init__(self, directory: str | os.PathLike[str], *, tensorboard: bool = True):
        self.path = pathlib.Path(directory) / "metrics.jsonl"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        _drop_cut_line(self.path)
        self._file = open(self.path, "ab")
        self._board = None
        if tensorboard:
            import tensorboardX

            self._board = tensorboardX.SummaryWriter(str(self.path.parent))

    def scalars(self, step: int, values: Mapping[str, Any]) -> None:
        """Write one record of named scalars; a value that is not finite is null in the JSON lines.

        Raises ValueError for anything but one number, and for the name `step`.
        """
        record: dict[str, Any] = {"step": int(step)}
        for name, value in values.items():
            number = np.asarray(value)
            if number.size != 1 or number.dtype.kind not in "biufV":
                raise ValueError(f"metric {name!r} must be one number, got shape {number.shape} of {number.dtype}")
            if name == "step":
                raise ValueError("metric name 'step' is taken by the step itself")
            record[name] = number.item() if number.dtype.kind in "biu" else float(number.reshape(()).astype(np.float64))
        self._file.write(json.dumps(plain(record), allow_nan=False).encode() + b"\n")
        self._file.flush()
        if self._board is not None:
            for name in values:
                if math.isfinite(record[name]):  # else undefined here: a gap in the curve
                    self._board.add_scalar(name, record[name], int(step))

    def close(self) -> None:
        """Flush to disk and close; closing twice does nothing."""
        if self._file.closed:
            return
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        if self._board is not None:
            self._board.close()

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _drop_cut_line(path: pathlib.Path) -> None:
    """Cut the file back to its last newline."""
    if path.exists() and (content := path.read_bytes()) and not content.endswith(b"\n"):
        os.truncate(path, content.rfind(b"\n") + 1)
