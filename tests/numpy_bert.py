"""BERT in plain NumPy, from the papers' equations: one sentence, no padding, float64, a loop over heads."""

import math

import numpy as np
import reference

_erf = np.vectorize(math.erf)


def embed(tensors, ids, *, layers, heads):
    """Embed one sentence `[T]` with tensors named and laid out as in Hugging Face's `BertModel`."""

    def tensor(name):
        return np.asarray(tensors[name], np.float64)

    def linear(x, name):
        return reference.dense(x, tensor(f"{name}.weight"), tensor(f"{name}.bias"))

    def normalised(x, name):
        return reference.normalise(x, tensor(f"{name}.weight"), tensor(f"{name}.bias"), 1e-12)

    words, positions, types = (tensor(f"embeddings.{kind}_embeddings.weight") for kind in ("word", "position", "token_type"))
    x = normalised(np.stack([words[token] + positions[at] + types[0] for at, token in enumerate(ids)]), "embeddings.LayerNorm")
    for layer in range(layers):
        under = f"encoder.layer.{layer}"
        query, key, value = (linear(x, f"{under}.attention.self.{name}") for name in ("query", "key", "value"))
        mixed = reference.attend(query, key, value, heads)
        x = normalised(x + linear(mixed, f"{under}.attention.output.dense"), f"{under}.attention.output.LayerNorm")
        hidden = linear(x, f"{under}.intermediate.dense")
        hidden = hidden * (1 + _erf(hidden / math.sqrt(2))) / 2
        x = normalised(x + linear(hidden, f"{under}.output.dense"), f"{under}.output.LayerNorm")
    mean = x.mean(0)
    return mean / np.linalg.norm(mean)
