"""The paper's two-stream agent written plainly in PyTorch, as public code writes it, and conv2d as its correlation: what we compare with.

The only module that imports PyTorch (extra `benchmark`). Its modules have the names of `models.transporter`'s, so that `load` can copy
parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from experiments import timing
from lala_jax import checkpoint


def conv(inputs: int, outputs: int, size: int, *, stride: int = 1, bias: bool = False) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, size, stride, padding=size // 2, bias=bias)


class ResidualBlock(nn.Module):
    """`blocks.ResidualBlock`."""

    def __init__(self, inputs: int, mid: int, out: int, *, stride: int = 1, project: bool = False, last_relu: bool = True):
        super().__init__()
        self.reduce, self.middle, self.expand = conv(inputs, mid, 1), conv(mid, mid, 3, stride=stride), conv(mid, out, 1)
        self.shortcut = conv(inputs, out, 1, stride=stride) if project else nn.Identity()
        self.last_relu = last_relu

    def forward(self, x):
        y = functional.relu(self.reduce(x))
        y = functional.relu(self.middle(y))
        y = self.expand(y) + self.shortcut(x)
        return functional.relu(y) if self.last_relu else y


class Hourglass(nn.Module):
    """`blocks.ResNet43_8s`."""

    def __init__(self, inputs: int, out: int, *, width: int, stages: int):
        super().__init__()
        self.stem = conv(inputs, width, 3, bias=True)
        self.down, self.up, before = [], [], width
        for stage in range(stages):
            self.down += self._pair(f"down{stage}", before, width << stage, width << stage, stride=2 if stage else 1)
            before = width << stage
        for stage in reversed(range(stages - 1)):
            self.up.append(self._pair(f"up{stage}", before, width << stage, width << stage))
            before = width << stage
        self.head = self._pair("head", before, max(width // 4, 4), out, last_relu=False)

    def _pair(self, name: str, inputs: int, mid: int, out: int, *, stride: int = 1, last_relu: bool = True) -> list[str]:
        self.add_module(f"{name}_project", ResidualBlock(inputs, mid, out, stride=stride, project=True, last_relu=last_relu))
        self.add_module(f"{name}_identity", ResidualBlock(out, mid, out, last_relu=last_relu))
        return [f"{name}_project", f"{name}_identity"]

    def _through(self, x, names):
        for name in names:
            x = self.get_submodule(name)(x)
        return x

    def forward(self, x):
        x = self._through(functional.relu(self.stem(x)), self.down)
        for pair in self.up:
            x = double(self._through(x, pair))
        return self._through(x, self.head)


def double(x):
    """Double the sides as `blocks.upsample` does: cells keep their place, odd ones are between, the last ones repeat."""
    rows, cols = x.shape[-2:]
    x = functional.pad(x, (0, 1, 0, 1), mode="replicate")
    x = functional.interpolate(x, size=(2 * rows + 1, 2 * cols + 1), mode="bilinear", align_corners=True)
    return x[..., :-1, :-1]


class TwoStream(nn.Module):
    """`streams.Streams`, fused by addition, or by a convolution."""

    def __init__(self, inputs: int, out: int, *, fuse: bool, width: int, stages: int):
        super().__init__()
        self.current, self.goal = (Hourglass(inputs, out, width=width, stages=stages) for _ in range(2))
        self.fuse = conv(2 * out, out, 1, bias=True) if fuse else None

    def forward(self, current, goal):
        current, goal = self.current(current), self.goal(goal)
        return current + goal if self.fuse is None else self.fuse(torch.cat([current, goal], 1))


class Transporter(nn.Module):
    """`transporter.Transporter` of the variant two_stream, for maps `[1, inputs, rows, cols]` with sides that the strides divide."""

    def __init__(self, inputs: int = 6, *, yaw_bins: int = 36, crop: int = 64, channels: int = 3, width: int = 64, stages: int = 4):
        super().__init__()
        self.yaw_bins, self.crop, self.scale = yaw_bins, crop, (crop * crop * channels) ** -0.5
        self.pick_net = TwoStream(inputs, 1, fuse=False, width=width, stages=stages)
        self.key_net = TwoStream(inputs, channels, fuse=True, width=width, stages=stages)
        self.query_net = TwoStream(inputs, channels, fuse=True, width=width, stages=stages)

    def forward(self, current, goal, pick):
        """Give the logits `[rows, cols]` of picks and `[yaw_bins, rows, cols]` of places of what is at the cell `pick` (row, col)."""
        rows, cols = current.shape[-2:]
        top, left = (max(rows, cols) - rows) // 2, (max(rows, cols) - cols) // 2
        square = (left, max(rows, cols) - cols - left, top, max(rows, cols) - rows - top)
        picks = self.pick_net(functional.pad(current, square), functional.pad(goal, square))[0, 0, top : top + rows, left : left + cols]
        query = self.query_net(*(self._crops(x, pick) for x in (current, goal)))
        margin = (self.crop // 2,) * 4
        key = self.key_net(functional.pad(current, margin), functional.pad(goal, margin))
        return picks, self.scale * functional.conv2d(key, query)[0, :, :rows, :cols]

    def _crops(self, maps, pick):
        """Cut crops about the pick, each turned by a bin more."""
        rows, cols = maps.shape[-2:]
        yaw = 2 * math.pi / self.yaw_bins * torch.arange(self.yaw_bins)[:, None, None]
        y, x = torch.meshgrid(*[torch.arange(self.crop) - self.crop // 2] * 2, indexing="ij")
        row = torch.cos(yaw) * y - torch.sin(yaw) * x + pick[0] + 0.5
        col = torch.cos(yaw) * x + torch.sin(yaw) * y + pick[1] + 0.5
        grid = torch.stack([2 * col / cols - 1, 2 * row / rows - 1], -1)
        return functional.grid_sample(maps.expand(self.yaw_bins, -1, -1, -1), grid, align_corners=False)


def losses(net: Transporter, example: Mapping[str, Any]):
    """Give the sum of pick's and place's cross-entropies, and the logits of both."""
    current, goal = (torch.from_numpy(example[name]).permute(2, 0, 1)[None] for name in ("current", "goal"))
    pick, place = net(current, goal, [int(i) for i in example["pick"]])
    rights = (np.ravel_multi_index(example["pick"], pick.shape), np.ravel_multi_index((example["bin"], *example["place"]), place.shape))
    total = sum(
        functional.cross_entropy(x.flatten()[None], torch.tensor([int(right)])) for x, right in zip((pick, place), rights, strict=True)
    )
    return total, (pick, place)


def load(net: Transporter, params: Any) -> None:
    """Copy the parameters of a `transporter.Transporter`, every one of them."""
    turned = {}
    for name, leaf in checkpoint.named(params).items():
        path, kind = name.rsplit("/", 1)
        kernel = kind == "kernel"
        value = np.transpose(leaf, (3, 2, 0, 1)) if kernel else np.asarray(leaf)
        turned[f"{path.replace('/', '.')}.{'weight' if kernel else 'bias'}"] = torch.from_numpy(np.array(value))
    net.load_state_dict(turned)


def steps(example: Mapping[str, Any], **sizes) -> timing.Work:
    """Take steps on one example: losses, gradient, Adam."""
    torch.manual_seed(0)
    net = Transporter(example["current"].shape[-1], **sizes)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-4)

    def run():
        optimizer.zero_grad()
        losses(net, example)[0].backward()
        optimizer.step()

    return timing.Work(run)


def correlate(*, rotations: int = 36, rows: int = 320, cols: int = 160, crop: int = 64) -> timing.Work:
    """Correlate a map of 3 channels with crops, padded so that every cell has its score, and differentiate the mean square by both."""
    torch.manual_seed(0)
    key, kernels = torch.randn(1, 3, rows, cols, requires_grad=True), torch.randn(rotations, 3, crop, crop, requires_grad=True)
    before, after = crop // 2, crop - 1 - crop // 2

    def run():
        scores = functional.conv2d(functional.pad(key, (before, after, before, after)), kernels)
        return torch.autograd.grad(scores.square().mean(), (key, kernels))

    return timing.Work(run)
