"""ResNet-50 in NumPy, in float64 and without a batch, straight from a file's tensors: one network a family, each in its own terms."""

import numpy as np
import reference

BLOCKS = (3, 4)  # of conv2 and conv3, as far as the references go
AROUND = ((1, 1), (1, 1), (0, 0))  # what is padded before the max pool


def keras(tensors, rgb):
    """Keras Applications' ResNet-50 to conv3: every layer, and every block after its ReLU, by this package's paths."""
    tensors, seen = {name: tensor.astype(np.float64) for name, tensor in tensors.items()}, {}

    def layer(path, x, conv, norm, stride=1, pad=0):
        y = reference.convolve(x, tensors[f"{conv}/kernel"], stride, pad) + tensors.get(f"{conv}/bias", 0)
        gamma, beta, mean, variance = (tensors[f"{norm}/{leaf}"] for leaf in ("gamma", "beta", "moving_mean", "moving_variance"))
        seen[path] = gamma * (y - mean) / np.sqrt(variance + 1.001e-5) + beta
        return seen[path]

    x = 255 * rgb.astype(np.float64)[..., ::-1] - np.array([103.939, 116.779, 123.68])
    x = np.maximum(layer("stem", x, "conv1", "bn_conv1", 2, 3), 0)
    x = reference.windows(np.pad(x, AROUND), 3, 2).max((-2, -1))
    for stage, blocks in enumerate(BLOCKS, 2):
        for block in range(blocks):
            path, name = f"conv{stage}_{block + 1}", f"{stage}{'abcd'[block]}_branch"
            stride = 2 if stage > 2 and block == 0 else 1
            y = np.maximum(layer(f"{path}/reduce", x, f"res{name}2a", f"bn{name}2a", stride), 0)
            y = np.maximum(layer(f"{path}/middle", y, f"res{name}2b", f"bn{name}2b", 1, 1), 0)
            y = layer(f"{path}/expand", y, f"res{name}2c", f"bn{name}2c")
            if block == 0:
                x = layer(f"{path}/shortcut", x, f"res{name}1", f"bn{name}1", stride)
            seen[path] = x = np.maximum(x + y, 0)
    return seen


def torchvision(state, rgb):
    """torchvision's ResNet-50 to layer2, or as far as `state` goes: the same dictionary."""
    state, seen = {name: tensor.astype(np.float64) for name, tensor in state.items()}, {}

    def layer(path, x, conv, norm, stride=1, pad=0):
        seen[path] = convolve_and_norm(state, x, conv, norm, stride, pad)
        return seen[path]

    x = (rgb.astype(np.float64) - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    x = layer("stem", x, "conv1", "bn1", 2, 3).clip(0)
    x = reference.windows(np.pad(x, AROUND, constant_values=-np.inf), 3, 2).max((-2, -1))
    for stage, blocks in enumerate(BLOCKS, 1):
        for block in range(blocks if f"layer{stage}.0.conv1.weight" in state else 0):
            path, name = f"conv{stage + 1}_{block + 1}", f"layer{stage}.{block}"
            stride = 2 if stage > 1 and block == 0 else 1
            y = layer(f"{path}/reduce", x, f"{name}.conv1", f"{name}.bn1").clip(0)
            y = layer(f"{path}/middle", y, f"{name}.conv2", f"{name}.bn2", stride, 1).clip(0)
            y = layer(f"{path}/expand", y, f"{name}.conv3", f"{name}.bn3")
            if block == 0:
                x = layer(f"{path}/shortcut", x, f"{name}.downsample.0", f"{name}.downsample.1", stride)
            seen[path] = x = (x + y).clip(0)
    return seen


def convolve_and_norm(state, x, conv, norm, stride=1, pad=0):
    """Convolve `[H, W, C]` without a bias and normalise by the stored statistics, both called and laid out as in PyTorch."""
    y = reference.convolve(x, state[f"{conv}.weight"].transpose(2, 3, 1, 0), stride, pad)
    mean, variance, weight, bias = (state[f"{norm}.{leaf}"] for leaf in ("running_mean", "running_var", "weight", "bias"))
    return (y - mean) / np.sqrt(variance + 1e-5) * weight + bias


def torchvision_state(rng, layers=2):
    """A state dict with statistics that are far from 0 and 1, to layer `layers` of two, and the tensors that are not the trunk's."""
    state = {"fc.weight": np.ones((1000, 8), np.float32), "fc.bias": np.ones(1000, np.float32)}

    def layer(conv, norm, out, inside, size=1):
        state[f"{conv}.weight"] = rng.normal(0, (2 / (inside * size**2)) ** 0.5, (out, inside, size, size))
        state[f"{norm}.weight"], state[f"{norm}.running_var"] = rng.uniform(0.5, 1.5, out), rng.uniform(0.2, 3.0, out)
        state[f"{norm}.bias"], state[f"{norm}.running_mean"] = rng.normal(0, 0.3, out), rng.normal(0, 0.3, out)

    layer("conv1", "bn1", 64, 3, 7)
    inside = 64
    for stage, blocks in enumerate(BLOCKS[:layers], 1):
        mid = 32 << stage
        for block in range(blocks):
            name = f"layer{stage}.{block}"
            layer(f"{name}.conv1", f"{name}.bn1", mid, inside)
            layer(f"{name}.conv2", f"{name}.bn2", mid, mid, 3)
            layer(f"{name}.conv3", f"{name}.bn3", 4 * mid, mid)
            if block == 0:
                layer(f"{name}.downsample.0", f"{name}.downsample.1", 4 * mid, inside)
            inside = 4 * mid
    state = {name: tensor.astype(np.float32) for name, tensor in state.items()}
    return state | {"bn1.num_batches_tracked": np.array(7, np.int64)}
