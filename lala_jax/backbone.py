"""Pretrained ImageNet features: the ResNet-50 trunk in the package, or a user's file. No pickle, no PyTorch, no download.

    lala_jax/features/<name>.npz   weights that ship, named as in their source; their SHA-256 is in PACKAGED
    lala_jax/features/README.md    where they come from, their licence, what their storage costs

A file, `.safetensors` or `.npz`, says by its names what it is: torchvision's `resnet50` state dict, or Keras Applications' `ResNet50`
(say from `np.savez(file, **{w.path: w.numpy() for w in model.weights})`), with the layer names of today or of before 2019.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
import pathlib
import zipfile
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
import safetensors

from lala_jax import checkpoint, writers
from lala_jax.models import resnet

FOLDER = pathlib.Path(__file__).resolve().parent / "features"
PACKAGED = {"resnet50_imagenet_v1": "6f83727240bb62ad4b80c852c7a9cfa9bbd01031dee8cf3fd77a50826719300d"}
FLOATS = ("float32", "float16", "bfloat16")  # what weights may be stored as: each is exact in float32

_PARTS = ("shortcut", "reduce", "middle", "expand")  # of a block, as Keras numbers them from 0 and torchvision from 1
_SAFETENSORS = {
    **{"F64": np.float64, "F32": np.float32, "F16": np.float16, "BF16": jnp.bfloat16, "BOOL": np.bool_},
    **{"I64": np.int64, "I32": np.int32, "I16": np.int16, "I8": np.int8, "U8": np.uint8},
}
_DAMAGE = (
    *(OSError, ValueError, EOFError, LookupError, TypeError, AttributeError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, safetensors.SafetensorError),
)


def load(
    name_or_path: str | os.PathLike[str], *, stage: str = "conv2", dtype: jnp.dtype = jnp.float32
) -> tuple[resnet.ResNet50, dict[str, Any]]:
    """Give `(module, variables)` of a packaged name or a file: `module.apply(variables, rgb)` gives the features after `stage`.

    The variables are nested dicts of float32 NumPy arrays with the file's values, unrounded; a convolution's bias, which only
    Keras has, is subtracted from the mean that follows. The head and stages past `stage` are left out. Names do not say the
    arithmetic: where a torchvision-layout file was trained with another, `module.clone(flavour=...)`.

    Raises CheckpointError naming a file that is missing, damaged or of another type, and MismatchError naming the tensors that
    are missing, unexpected, or of another shape or dtype.
    """
    name = os.fspath(name_or_path)
    file = FOLDER / f"{name}.npz" if name in PACKAGED else pathlib.Path(name)
    if file.suffix not in _READERS:
        raise checkpoint.CheckpointError(
            f"no backbone {name!r}; packaged: {', '.join(PACKAGED)}; files: {', '.join(_READERS)} (safetensors.torch.save_file writes a "
            "PyTorch state dict)"
        )
    tensors = read(file, PACKAGED.get(name))
    layout = _recognise(file, tensors)
    return resnet.ResNet50(layout.flavour, stage, dtype), _variables(file, tensors, layout, stage)


def save(file: str | os.PathLike[str], module: resnet.ResNet50, variables: Mapping[str, Any]) -> None:
    """Write a trunk for `load`, float32 `.npz`, atomically: the layout is torchvision's or Keras' of today, as the arithmetic is.

    Raises ValueError for a file of another suffix and for another arithmetic, which no layout stands for.
    """
    layout = next((layout for layout in _LAYOUTS if layout.flavour == module.flavour), None)
    if layout is None or pathlib.Path(file).suffix != ".npz":
        raise ValueError(f"backbone.save writes .npz files of resnet.KERAS or resnet.TORCHVISION, not {file} of {module.flavour}")
    leaves, tensors = checkpoint.named(variables), {}
    for name, (variable, _) in _tensors(layout, module.stage).items():
        if not variable.endswith("/conv/bias"):  # Keras', which is in the mean
            tensor = np.asarray(leaves[variable], np.float32)
            tensors[name] = tensor.transpose(np.argsort(layout.axes)) if tensor.ndim == 4 else tensor
    with writers.atomic(file) as stream:
        np.savez(stream, **tensors)


@dataclasses.dataclass(frozen=True)
class _Layout:
    """How a family of files names and stores its tensors."""

    flavour: resnet.Flavour
    names: Callable[[str], tuple[str, str]]  # from a layer's path in `resnet.layers` to its convolution and its normalisation
    leaves: Mapping[str, str]  # from a variable of a path to its tensor, of the (convolution, normalisation) just named
    axes: tuple[int, int, int, int]  # of a stored kernel: where height, width, in and out are
    aside: tuple[str, ...]  # how names end that belong to the whole model but not to its trunk


def _torchvision(path: str) -> tuple[str, str]:
    if path == "stem":
        return "conv1", "bn1"
    stage, block, part = _split(path)
    prefix = f"layer{stage - 1}.{block - 1}"
    return (f"{prefix}.conv{part}", f"{prefix}.bn{part}") if part else (f"{prefix}.downsample.0", f"{prefix}.downsample.1")


def _keras(path: str) -> tuple[str, str]:
    prefix = "conv1" if path == "stem" else "conv{}_block{}_{}".format(*_split(path))
    return f"{prefix}_conv", f"{prefix}_bn"


def _keras_before_2019(path: str) -> tuple[str, str]:
    if path == "stem":
        return "conv1", "bn_conv1"
    stage, block, part = _split(path)
    suffix = f"{stage}{'abcdef'[block - 1]}_branch{('1', '2a', '2b', '2c')[part]}"
    return f"res{suffix}", f"bn{suffix}"


def _split(path: str) -> tuple[int, int, int]:
    """`conv3_2/middle` to `(3, 2, 2)`."""
    block, part = path.split("/")
    return int(block[4]), int(block[6]), _PARTS.index(part)


_KERNEL, _BIAS, _MEAN, _VAR = "params/{}/conv/kernel", "params/{}/conv/bias", "batch_stats/{}/norm/mean", "batch_stats/{}/norm/var"
_SCALE, _SHIFT = "params/{}/norm/scale", "params/{}/norm/bias"
_TORCH_LEAVES = {
    _KERNEL: "{0}.weight",
    _SCALE: "{1}.weight",
    _SHIFT: "{1}.bias",
    _MEAN: "{1}.running_mean",
    _VAR: "{1}.running_var",
}
_KERAS_LEAVES = {
    _KERNEL: "{0}/kernel",
    _BIAS: "{0}/bias",
    _SCALE: "{1}/gamma",
    _SHIFT: "{1}/beta",
    _MEAN: "{1}/moving_mean",
    _VAR: "{1}/moving_variance",
}
_HWIO, _OIHW = (0, 1, 2, 3), (2, 3, 1, 0)
_LAYOUTS = (
    _Layout(resnet.TORCHVISION, _torchvision, _TORCH_LEAVES, _OIHW, ("fc.weight", "fc.bias", ".num_batches_tracked")),
    _Layout(resnet.KERAS, _keras, _KERAS_LEAVES, _HWIO, ("predictions/kernel", "predictions/bias", "probs/kernel", "probs/bias")),
    _Layout(resnet.KERAS, _keras_before_2019, _KERAS_LEAVES, _HWIO, ("fc1000/kernel", "fc1000/bias")),
)


def _tensors(layout: _Layout, stage: str) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Give the variable and the shape in the file of every tensor that a whole trunk up to `stage` may have, by its name there."""
    found = {}
    for path, shape in resnet.layers(stage).items():
        for variable, name in layout.leaves.items():
            stored = tuple(shape[layout.axes.index(axis)] for axis in range(4)) if variable == _KERNEL else shape[3:]
            found[name.format(*layout.names(path))] = variable.format(path), stored
    return found


def _recognise(file: pathlib.Path, tensors: Mapping[str, np.ndarray]) -> _Layout:
    stems = {next(iter(_tensors(layout, "stem"))): layout for layout in _LAYOUTS}
    for name, layout in stems.items():
        if name in tensors:
            return layout
    raise checkpoint.MismatchError(f"{file} is no ResNet-50: it has none of {', '.join(stems)}, but {_few(list(tensors))}")


def _variables(file: pathlib.Path, tensors: Mapping[str, np.ndarray], layout: _Layout, stage: str) -> dict[str, Any]:
    """Check the trunk's tensors, convert them to float32 and nest them as the module wants them."""
    wanted, whole = _tensors(layout, stage), _tensors(layout, "conv5")
    biases = {name for name, (variable, _) in whole.items() if variable.endswith("/conv/bias")}
    if not biases & tensors.keys():  # `use_bias=False`: all or none
        wanted = {name: found for name, found in wanted.items() if name not in biases}
    unexpected = [name for name in tensors if name not in whole and not name.endswith(layout.aside)]
    missing = [name for name in wanted if name not in tensors]
    if unexpected or missing:
        found = [f"{kind} {_few(names)}" for kind, names in (("has unexpected", unexpected), ("lacks", missing)) if names]
        raise checkpoint.MismatchError(f"{file} is no ResNet-50 up to {stage}: it {' and '.join(found)}")
    leaves = {}
    for name, (variable, shape) in wanted.items():
        tensor = _checked(file, name, tensors[name], shape, positive=variable.endswith("/var"))
        leaves[variable] = np.ascontiguousarray(tensor.transpose(layout.axes)) if tensor.ndim == 4 else tensor
    for path in resnet.layers(stage):
        bias = leaves.pop(_BIAS.format(path), None)
        if bias is not None:
            leaves[_MEAN.format(path)] = leaves[_MEAN.format(path)] - bias
    return checkpoint.nest(leaves)


def _checked(file: pathlib.Path, name: str, tensor: np.ndarray, shape: tuple[int, ...], *, positive: bool) -> np.ndarray:
    if tensor.shape != shape or tensor.dtype.name not in FLOATS:
        there, here = f"{tensor.dtype.name} {list(tensor.shape)}", f"{' or '.join(FLOATS)} {list(shape)}"
        raise checkpoint.MismatchError(f"{file} is no ResNet-50: tensor {name} is {there}, not {here}")
    tensor = tensor.astype(np.float32)
    if not np.isfinite(tensor).all() or (positive and (tensor < 0).any()):
        raise checkpoint.CheckpointError(f"{file} is damaged: tensor {name} has {'negative or ' if positive else ''}non-finite values")
    return tensor


def _few(names: list[str]) -> str:
    return (", ".join(names[:3]) or "nothing") + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def read(file: pathlib.Path, sha256: str | None = None) -> dict[str, np.ndarray]:
    """Read all tensors of an `.npz` or `.safetensors` file, compared with the hash, if one is given, before anything else looks at them.

    Raises CheckpointError naming a file that is missing, damaged, of another hash or of another type.
    """
    if file.suffix not in _READERS:
        raise checkpoint.CheckpointError(f"{file} is no file of weights: known are {', '.join(_READERS)}")
    try:
        content = file.read_bytes()
    except OSError as error:
        raise checkpoint.CheckpointError(f"{file} cannot be read: {error}") from error
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise checkpoint.CheckpointError(f"{file} is damaged: its SHA-256 is not {sha256}")
    try:
        return _READERS[file.suffix](content)
    except _DAMAGE as error:
        raise checkpoint.CheckpointError(f"{file} is damaged or no {file.suffix} file: {type(error).__name__} {error}") from error


def _read_npz(content: bytes) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        damaged = archive.testzip()  # all of it, before NumPy believes a header
    if damaged is not None:
        raise ValueError(f"{damaged} does not match its checksum")
    with np.load(io.BytesIO(content), allow_pickle=False) as stored:
        return {name: np.asarray(stored[name]) for name in stored.files}


def _read_safetensors(content: bytes) -> dict[str, np.ndarray]:
    """Read what the library parses and checks; its own `numpy.load` knows no bfloat16."""
    tensors = {}
    for name, entry in safetensors.deserialize(content):
        if entry["dtype"] not in _SAFETENSORS:
            raise ValueError(f"tensor {name} is {entry['dtype']}, which is not one of {', '.join(_SAFETENSORS)}")
        tensors[name] = np.frombuffer(entry["data"], _SAFETENSORS[entry["dtype"]]).reshape(entry["shape"])
    return tensors


_READERS = {".npz": _read_npz, ".safetensors": _read_safetensors}
