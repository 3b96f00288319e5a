"""ResNet-50 without its head: frozen features of colour images, for weights that were trained elsewhere.

He et al., Deep Residual Learning for Image Recognition, 2015. Two families of weights are about, with one set of shapes and
different arithmetic; a `Flavour` says which. `lala_jax.backbone` reads files of both. Nothing here is trained: batch
normalisation uses the stored statistics, always.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from lala_jax.models import convolution

STAGES = {"stem": 0, "conv2": 3, "conv3": 4, "conv4": 6, "conv5": 3}  # blocks of each, in order
STRIDED = ("reduce", "middle", "pool")


@dataclasses.dataclass(frozen=True)
class Flavour:
    """What a family of weights expects: static and hashable.

    An image enters as `(peak * rgb[..., order] - mean) / std`. Raises ValueError for an unknown `strided`.
    """

    strided: str  # what halves in a stage's first block: "reduce" (1x1, the paper's), "middle" (3x3), or "pool" before "expand" (CLIP's)
    order: tuple[int, int, int]  # of the channels: (0, 1, 2) is RGB, (2, 1, 0) is BGR
    peak: float  # what colours of 0..1 are scaled to
    mean: tuple[float, float, float]  # of each channel, in the order and on the scale just given
    std: tuple[float, float, float]
    epsilon: float  # added to the stored variances

    def __post_init__(self):
        if self.strided not in STRIDED:
            raise ValueError(f"Flavour.strided must be one of {STRIDED}, got {self.strided!r}")

    def prepare(self, rgb: jax.Array) -> jax.Array:
        """Bring RGB in 0..1, `[..., H, W, 3]`, to what the weights were trained on, float32: the only place that does."""
        if rgb.ndim < 3 or rgb.shape[-1] != 3 or not jnp.issubdtype(rgb.dtype, jnp.floating):
            raise ValueError(f"a ResNet needs RGB images [..., H, W, 3] of floats in 0..1, got {rgb.dtype} {list(rgb.shape)}")
        order, mean, std = (np.array(value) for value in (self.order, self.mean, self.std))
        return (self.peak * rgb.astype(jnp.float32)[..., order] - mean.astype(np.float32)) / std.astype(np.float32)


# Keras Applications' `resnet_common.py` and `preprocess_input`; the paper's own weights, from Caffe (whose epsilon is 1e-5).
KERAS = Flavour("reduce", (2, 1, 0), 255.0, (103.939, 116.779, 123.68), (1.0, 1.0, 1.0), 1.001e-5)
# torchvision's `resnet50`, "v1.5", with the mean and deviation of its `ImageClassification` preset.
TORCHVISION = Flavour("middle", (0, 1, 2), 1.0, (0.485, 0.456, 0.406), (0.229, 0.224, 0.225), 1e-5)


def layers(stage: str) -> dict[str, tuple[int, int, int, int]]:
    """Give the shapes `(height, width, in, out)` of all kernels up to `stage`, by the path of their layer: `conv2_1/reduce`."""
    found, width = {"stem": (7, 7, 3, 64)}, 64
    for name, mid, _, first in _blocks(stage):
        found |= {f"{name}/reduce": (1, 1, width, mid), f"{name}/middle": (3, 3, mid, mid), f"{name}/expand": (1, 1, mid, 4 * mid)}
        if first:
            found[f"{name}/shortcut"] = (1, 1, width, 4 * mid)
        width = 4 * mid
    return found


def _blocks(stage: str) -> Iterator[tuple[str, int, int, bool]]:
    """Yield name, channels, stride and whether it is its stage's first, of every block up to `stage`."""
    names = list(STAGES)
    for depth, name in enumerate(names[1 : names.index(stage) + 1]):
        for block in range(STAGES[name]):
            yield f"{name}_{block + 1}", 64 << depth, 2 if depth and not block else 1, not block


class Norm(nn.Module):
    """Hold what normalises channels by stored statistics."""

    channels: int
    epsilon: float

    @nn.compact
    def __call__(self) -> tuple[jax.Array, jax.Array]:
        """Give what each channel is multiplied by, and what is added then, both `[channels]`, float32."""
        shape = (self.channels,)
        scale, bias = self.param("scale", nn.initializers.ones, shape), self.param("bias", nn.initializers.zeros, shape)
        mean, var = self.variable("batch_stats", "mean", jnp.zeros, shape), self.variable("batch_stats", "var", jnp.ones, shape)
        factor = scale * jax.lax.rsqrt(var.value + self.epsilon)
        return factor, bias - mean.value * factor


class ConvNorm(nn.Module):
    """Convolve without a bias and normalise by stored statistics: a convolution whose kernel has the factors in it, and a bias."""

    out: int  # channels
    size: int
    stride: int
    epsilon: float
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map `[..., H, W, C]` to `[..., ceil(H / stride), ceil(W / stride), out]`."""
        factor, offset = Norm(self.out, self.epsilon, name="norm")()

        def scaled(x: jax.Array, kernel: jax.Array, *where: Any, **how: Any) -> jax.Array:
            return jax.lax.conv_general_dilated(x, (kernel * factor).astype(kernel.dtype), *where, **how)

        size, stride, how = (self.size, self.size), (self.stride, self.stride), {"use_bias": False, "dtype": self.dtype, "name": "conv"}
        x = nn.Conv(self.out, size, stride, padding=self.size // 2, conv_general_dilated=scaled, **how)(x)
        return x + offset.astype(self.dtype)


class Bottleneck(nn.Module):
    """Add a 1x1 - 3x3 - 1x1 branch, `mid` - `mid` - `4 * mid` channels, to the input or to its 1x1 projection."""

    mid: int  # channels
    stride: int
    project: bool
    flavour: Flavour
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Map `[..., H, W, C]` to `[..., H', W', 4 * mid]`: sides divided by the stride, rounded up, or down where the flavour pools."""

        def layer(name: str, out: int, size: int, stride: int = 1) -> ConvNorm:
            return ConvNorm(out, size, stride, self.flavour.epsilon, self.dtype, name=name)

        first, second, pool = (self.stride if self.flavour.strided == name else 1 for name in STRIDED)
        y = convolution.relu(layer("reduce", self.mid, 1, first)(x))
        y = convolution.relu(layer("middle", self.mid, 3, second)(y))
        if pool > 1:
            x, y = (nn.avg_pool(z, (pool, pool), (pool, pool)) for z in (x, y))
        y = layer("expand", 4 * self.mid, 1)(y)
        return convolution.relu(y + (layer("shortcut", 4 * self.mid, 1, self.stride // pool)(x) if self.project else x))


class ResNet50(nn.Module):
    """Give the features of colour images after `stage`: frozen, pure, no deeper than asked for.

    "stem" (with its max pool) gives 64 channels at 1/4 of the image's sides, "conv2" 256 at 1/4 (the paper's choice), "conv3"
    512 at 1/8, "conv4" 1024 at 1/16, "conv5" 2048 at 1/32; odd sides round up. With sides at `1 / s`, every flavour centres
    feature `[i, j]` on *pixel* `[s * i, s * j]`, not on the middle of an `s` x `s` patch.

    The variables are `params` (kernels `[height, width, in, out]`, scales and biases) and `batch_stats` (means and variances);
    the tree of a shallow trunk is part of a deeper one's, and what is deeper is ignored. Raises ValueError for another stage.
    """

    flavour: Flavour
    stage: str = "conv2"
    dtype: jnp.dtype = jnp.float32  # what the layers compute in

    def __post_init__(self):
        if self.stage not in STAGES:
            raise ValueError(f"ResNet50.stage must be one of {', '.join(STAGES)}, got {self.stage!r}")
        super().__post_init__()

    def __call__(self, rgb: jax.Array) -> jax.Array:
        """Map RGB in 0..1, `[..., H, W, 3]`, to features, `[..., H', W', C]`, float32 whatever the layers compute in."""
        return self.pyramid(rgb)[self.stage]

    @nn.compact
    def pyramid(self, rgb: jax.Array) -> dict[str, jax.Array]:
        """Map the same to the features after every stage up to the last, by the stage's name."""
        x = self.flavour.prepare(rgb).astype(self.dtype)
        x = convolution.relu(ConvNorm(64, 7, 2, self.flavour.epsilon, self.dtype, name="stem")(x))
        # Keras pads with zeros and torchvision with -inf: after a ReLU, these are one. nn.max_pool pads one batch dimension at most.
        x = nn.max_pool(jnp.pad(x, [(0, 0)] * (x.ndim - 3) + [(1, 1), (1, 1), (0, 0)]), (3, 3), (2, 2))
        found = {"stem": x}
        for name, mid, stride, first in _blocks(self.stage):
            found[name.partition("_")[0]] = x = Bottleneck(mid, stride, first, self.flavour, self.dtype, name=name)(x)
        return {stage: features.astype(jnp.float32) for stage, features in found.items()}
