"""CLIP with a ResNet in NumPy, in float64 and unbatched, from OpenAI's `clip/model.py`: on tensors called and laid out as there."""

import numpy as np
import reference
import resnet_reference


def shapes(*, blocks, width, side, embed, vocab, positions, text_width, layers):
    """Every parameter and statistic of the model, as its constructors make them: `side` is the image's, in pixels."""
    found = {"positional_embedding": (positions, text_width), "text_projection": (text_width, embed), "logit_scale": ()}

    def norm(name, size):
        found.update({f"{name}.{leaf}": (size,) for leaf in ("weight", "bias", "running_mean", "running_var")})

    def dense(name, out, inside):
        found.update({f"{name}.weight": (out, inside), f"{name}.bias": (out,)})

    for index, (inside, out) in enumerate(((3, width // 2), (width // 2, width // 2), (width // 2, width)), 1):
        found[f"visual.conv{index}.weight"] = (out, inside, 3, 3)
        norm(f"visual.bn{index}", out)
    inside = width
    for stage, count in enumerate(blocks, 1):
        planes = width * 2 ** (stage - 1)
        for block in range(count):
            name = f"visual.layer{stage}.{block}"
            for index, shape in enumerate(((planes, inside, 1, 1), (planes, planes, 3, 3), (4 * planes, planes, 1, 1)), 1):
                found[f"{name}.conv{index}.weight"] = shape
                norm(f"{name}.bn{index}", shape[0])
            if block == 0:
                found[f"{name}.downsample.0.weight"] = (4 * planes, inside, 1, 1)
                norm(f"{name}.downsample.1", 4 * planes)
            inside = 4 * planes
    found["visual.attnpool.positional_embedding"] = ((side // 32) ** 2 + 1, inside)
    for part in "kqvc":
        dense(f"visual.attnpool.{part}_proj", embed if part == "c" else inside, inside)
    found["token_embedding.weight"] = (vocab, text_width)
    for layer in range(layers):
        name = f"transformer.resblocks.{layer}"
        found |= {f"{name}.attn.in_proj_weight": (3 * text_width, text_width), f"{name}.attn.in_proj_bias": (3 * text_width,)}
        dense(f"{name}.attn.out_proj", text_width, text_width)
        dense(f"{name}.mlp.c_fc", 4 * text_width, text_width)
        dense(f"{name}.mlp.c_proj", text_width, 4 * text_width)
    for name in (f"{under}.ln_{index}" for under in (f"transformer.resblocks.{layer}" for layer in range(layers)) for index in (1, 2)):
        found |= {f"{name}.weight": (text_width,), f"{name}.bias": (text_width,)}
    return found | {"ln_final.weight": (text_width,), "ln_final.bias": (text_width,)}


def state(rng, **sizes):
    """Random tensors, float32, with statistics far from 0 and 1, and no layer so small that it does not matter."""
    found = {}
    for name, shape in shapes(**sizes).items():
        if name.endswith("running_var"):
            tensor = rng.uniform(0.2, 3.0, shape)
        elif len(shape) > 1 and "embedding" not in name:
            tensor = rng.normal(0, (2 / np.prod(shape[1:])) ** 0.5, shape)
        else:
            tensor = rng.normal(1.0 if name.endswith(("bn1.weight", "bn2.weight", "bn3.weight")) else 0.0, 0.4, shape)
        found[name] = np.asarray(tensor, np.float32)
    return found


def visual(tensors, rgb, *, blocks):
    """Give the features after every stage, fine to coarse, `[h, w, c]`: `prepool_im` of CLIPort's copy."""
    tensors = {name: tensor.astype(np.float64) for name, tensor in tensors.items()}

    def layer(x, under, conv, norm, stride=1, pad=0):
        return resnet_reference.convolve_and_norm(tensors, x, f"{under}.{conv}", f"{under}.{norm}", stride, pad)

    def halve(x):
        return reference.windows(x, 2, 2).mean((-2, -1))

    x = (rgb.astype(np.float64) - [0.48145466, 0.4578275, 0.40821073]) / [0.26862954, 0.26130258, 0.27577711]
    for index, stride in ((1, 2), (2, 1), (3, 1)):
        x = layer(x, "visual", f"conv{index}", f"bn{index}", stride, 1).clip(0)
    x, features = halve(x), []
    for stage, count in enumerate(blocks, 1):
        for block in range(count):
            under = f"visual.layer{stage}.{block}"
            out = layer(x, under, "conv1", "bn1").clip(0)
            out = layer(out, under, "conv2", "bn2", 1, 1).clip(0)
            if stage > 1 and block == 0:
                x, out = halve(x), halve(out)
            out = layer(out, under, "conv3", "bn3")
            if block == 0:
                x = layer(x, under, "downsample.0", "downsample.1")
            x = (x + out).clip(0)
        features.append(x)
    return features


def pool(tensors, x, *, heads):
    """Pool `[h, w, c]`: `AttentionPool2d`, all of its queries, of which the first is kept."""
    tensors = {name.removeprefix("visual.attnpool."): tensor.astype(np.float64) for name, tensor in tensors.items()}

    def linear(part, x):
        return reference.dense(x, tensors[f"{part}_proj.weight"], tensors[f"{part}_proj.bias"])

    x = np.stack([x.mean((0, 1)), *(cell for row in x for cell in row)]) + tensors["positional_embedding"]
    return linear("c", reference.attend(linear("q", x), linear("k", x), linear("v", x), heads))[0]


def text(tensors, ids, *, layers, heads):
    """Give the embedding of one sentence `[T]`, and what its tokens became: `encode_text_with_embeddings` of CLIPort's copy."""
    tensors = {name: tensor.astype(np.float64) for name, tensor in tensors.items()}

    def linear(x, name, join="."):
        return reference.dense(x, tensors[f"{name}{join}weight"], tensors[f"{name}{join}bias"])

    def normalised(x, name):
        return reference.normalise(x, tensors[f"{name}.weight"], tensors[f"{name}.bias"], 1e-5)

    x = np.stack([tensors["token_embedding.weight"][token] + tensors["positional_embedding"][at] for at, token in enumerate(ids)])
    for index in range(layers):
        under, width = f"transformer.resblocks.{index}", x.shape[-1]
        both = linear(normalised(x, f"{under}.ln_1"), f"{under}.attn.in_proj", "_")
        query, key, value = both[:, :width], both[:, width : 2 * width], both[:, 2 * width :]
        before = np.arange(len(ids))[:, None] >= np.arange(len(ids))
        x = x + linear(reference.attend(query, key, value, heads, before), f"{under}.attn.out_proj")
        hidden = linear(normalised(x, f"{under}.ln_2"), f"{under}.mlp.c_fc")
        x = x + linear(hidden / (1 + np.exp(-1.702 * hidden)), f"{under}.mlp.c_proj")
    x = normalised(x, "ln_final")
    return x[list(ids).index(max(ids))] @ tensors["text_projection"], x
