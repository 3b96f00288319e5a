"""CLIP from a user's files: its weights and its tokens. No pickle, no PyTorch, no download.

    net, variables = clip_file.load("RN50.safetensors")
    ids = clip_file.tokenize("tokenizer.json", ["put the red block in a brown bowl"])
    embeddings, tokens = net.bind(variables).text(ids)  # [1, 1024] and [1, 77, 512]

Weights are `.safetensors` or `.npz` files of OpenAI's state dict, by its names: what open_clip made of OpenAI's has them, and so has
what `safetensors.torch.save_file(torch.jit.load("RN50.pt", map_location="cpu").state_dict(), "RN50.safetensors")` writes where
PyTorch is. Most that open_clip trained itself has them too, but wants another GELU. Sizes are read off the tensors' shapes, so any
ResNet will do, RN50x4 too. The tokenizer is Hugging Face's `tokenizer.json` of any of OpenAI's models: they share one vocabulary.
"""

from __future__ import annotations

import functools
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from lala_jax import backbone, checkpoint, wording
from lala_jax.models import clip


def load(path: str | os.PathLike[str]) -> tuple[clip.Clip, dict[str, Any]]:
    """Give `(net, variables)` of a file: a CLIP of the file's sizes, and nested dicts of float32 NumPy arrays, exact from half precision.

    Raises CheckpointError naming a file that is missing, damaged or of another type, and the tensor that is missing, unexpected,
    of another shape, or has values that no training gives.
    """
    tensors = backbone.read(pathlib.Path(path))
    try:
        net = clip.sized(tensors)
        return net, clip.from_published(tensors, net)
    except ValueError as error:
        raise checkpoint.CheckpointError(f"{path} cannot be used: {error}") from error


def tokenize(path: str | os.PathLike[str], sentences: Sequence[str], length: int | None = 77) -> np.ndarray:
    """Give token ids `[B, length]`, int32: the start, the word pieces in lower case, the end, the highest id there is, then zeros.

    Needs the package `tokenizers`, of the extra `language`. Raises CheckpointError for a file that is no tokenizer of CLIP, and
    ValueError as `wording.tokenize` does.
    """
    return wording.tokenize(_tokenizer(os.fspath(path))[0], sentences, length)


def template(path: str | os.PathLike[str], task_name: str, count: int, text: clip.Text) -> wording.Template:
    """Make the template of a task's sentences with `count` colours, for a tower that embeds them: `wording.template`.

    Raises CheckpointError for a file that is no tokenizer of CLIP, or one of another vocabulary than the tower's.
    """
    encode, size = _tokenizer(os.fspath(path))
    if size != text.vocab:
        raise checkpoint.CheckpointError(f"{path} has {size} tokens, the weights are of {text.vocab}")
    try:
        made = wording.template(encode, task_name, count)
    except ValueError as error:
        raise checkpoint.CheckpointError(f"{path} cannot be used: {error}") from error
    if len(made.ids) > text.positions:
        raise checkpoint.CheckpointError(f"{path} makes {len(made.ids)} tokens of a sentence, the weights take {text.positions}")
    return made


@functools.lru_cache(maxsize=1)
def _tokenizer(path: str) -> tuple[wording.Encode, int]:
    """Read a tokenizer, and give it with the number of its tokens."""
    try:
        import tokenizers  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("CLIP's tokens need the package tokenizers: pip install tokenizers", name=error.name) from error
    try:
        tokenizer = tokenizers.Tokenizer.from_file(path)
    except Exception as error:  # the library raises nothing narrower
        raise checkpoint.CheckpointError(f"{path} cannot be read as a tokenizer: {error}") from error
    tokenizer.no_truncation()
    tokenizer.no_padding()
    start, end = map(tokenizer.token_to_id, ("<|startoftext|>", "<|endoftext|>"))
    if start is None or end is None or end != tokenizer.get_vocab_size() - 1:  # where the text's tower looks for the sentence
        raise checkpoint.CheckpointError(f"{path} is no tokenizer of CLIP: it does not end in <|startoftext|> and <|endoftext|>")
    return lambda text: [start, *tokenizer.encode(text, add_special_tokens=False).ids, end], end + 1
