"""Slow and obvious NumPy versions of what the networks are made of, on plain arrays or on the parameters of one Flax module."""

import numpy as np


def convolve(x, kernel, stride=1, pad=0):
    """Convolve `[..., H, W, C]` with `[h, w, C, O]`, tap by tap, with `pad` zeros on every side."""
    padded = np.pad(x, [(0, 0)] * (x.ndim - 3) + [(pad, pad), (pad, pad), (0, 0)])
    rows, cols = ((side - size) // stride + 1 for side, size in zip(padded.shape[-3:-1], kernel.shape[:2], strict=True))
    out = 0.0
    for i, j in np.ndindex(kernel.shape[:2]):
        out = out + padded[..., i : i + stride * rows : stride, j : j + stride * cols : stride, :] @ kernel[i, j]
    return out


def conv(x, leaf, stride=1):
    """Convolve `[..., H, W, C]` in float64 with half the kernel of zeros around; `leaf` has a kernel and perhaps a bias."""
    kernel = np.asarray(leaf["kernel"], np.float64)
    out = convolve(x, kernel, stride, len(kernel) // 2)
    return out + np.asarray(leaf["bias"], np.float64) if "bias" in leaf else out


def windows(x, size, stride):
    """Cut windows `[rows, cols, C, size, size]` out of `[H, W, C]`."""
    return np.lib.stride_tricks.sliding_window_view(x, (size, size), axis=(0, 1))[::stride, ::stride]


def dense(x, weight, bias):
    """Map `[..., I]` by a weight `[O, I]`, as PyTorch stores it."""
    return np.einsum("...i,oi->...o", x, weight) + bias


def normalise(x, scale, shift, epsilon):
    """Bring the last axis to mean 0 and variance 1, then to `scale` and `shift`."""
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + epsilon) * scale + shift


def attend(query, key, value, heads, seen=None):
    """Mix values `[S, D]` for every query `[T, D]`, head by head; where `seen` `[T, S]` is given, only those that it is true for."""
    size, mixed = query.shape[-1] // heads, []
    for head in range(heads):
        part = slice(head * size, (head + 1) * size)
        weights = np.exp(query[:, part] @ key[:, part].T / np.sqrt(size))
        weights = weights if seen is None else weights * seen
        mixed.append(weights / weights.sum(-1, keepdims=True) @ value[:, part])
    return np.concatenate(mixed, -1)


def relu(x):
    """Cut at zero."""
    return np.maximum(x, 0)


def upsample(x):
    """Double the sides of `[..., H, W, C]`: even cells copy, odd ones interpolate, the last repeats."""
    for axis in (-3, -2):
        size = x.shape[axis]
        x = np.apply_along_axis(lambda line, size=size: np.interp(np.arange(2 * size) / 2, np.arange(size), line), axis, x)
    return x


def pair(params, name, x, stride=1, last_relu=True):
    """Pass the projecting and the identity block of this name."""
    for kind, step in (("project", stride), ("identity", 1)):
        leaf = params[f"{name}_{kind}"]
        y = relu(conv(relu(conv(x, leaf["reduce"])), leaf["middle"], step))
        x = conv(y, leaf["expand"]) + (conv(x, leaf["shortcut"], step) if kind == "project" else x)
        x = relu(x) if last_relu else x
    return x


def hourglass(params, x, stages, laterals=None, decoded=None):
    """Pass a `blocks.ResNet43_8s`; take in `laterals`, another one's decoder features, and add its own to the list `decoded`."""
    x = relu(conv(np.asarray(x, np.float64), params["stem"]))
    for stage in range(stages):
        x = pair(params, f"down{stage}", x, 2 if stage else 1)
    for stage in reversed(range(stages - 1)):
        x = upsample(pair(params, f"up{stage}", x))
        if laterals is not None:
            x = conv(np.concatenate([x, laterals[stages - 2 - stage]], -1), params[f"lateral{stage}"])
        if decoded is not None:
            decoded.append(x)
    return pair(params, "head", x, last_relu=False)


def streams(params, variant, current, goal, stages):
    """Pass a `streams.Streams`: the paper's three ways to take both images in."""
    if variant == "single":
        return hourglass(params["difference"], current - goal, stages)
    decoded = []
    first = hourglass(params["current"], current, stages, decoded=decoded)
    second = hourglass(params["goal"], goal, stages, laterals=decoded if variant == "two_stream_lateral" else None)
    return conv(np.concatenate([first, second], -1), params["fuse"]) if "fuse" in params else first + second


def quarter_crops(x, cell, crop):
    """Cut four crops of `[H, W, C]` about a cell, turned by quarters: row is y, col is x, zero outside."""
    out = np.zeros((4, crop, crop, x.shape[-1]))
    for turn, i, j in np.ndindex(out.shape[:3]):
        y, x_ = i - crop // 2, j - crop // 2
        for _ in range(turn):  # what is read lies a turn back
            y, x_ = -x_, y
        row, col = cell[0] + y, cell[1] + x_
        if 0 <= row < x.shape[0] and 0 <= col < x.shape[1]:
            out[turn, i, j] = x[row, col]
    return out


def places(key, query):
    """Correlate a map padded by half the crops with the crops, window by window: `[k, H, W]`."""
    crop = query.shape[1]
    rows, cols = key.shape[0] - 2 * (crop // 2), key.shape[1] - 2 * (crop // 2)
    out = np.zeros((len(query), rows, cols))
    for i, j in np.ndindex(rows, cols):
        out[:, i, j] = np.einsum("abd,kabd->k", key[i : i + crop, j : j + crop], query)
    return out
