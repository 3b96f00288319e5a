"""CLIP from a user's files: its weights and its tokens. No pickle, no PyTorch, no download.

    variables = clip_file.load("RN50.safetensors")
    ids = clip_file.tokenize("tokenizer.json", ["put the red block in a brown bowl"])
    embeddings, tokens = clip.Clip().bind(variables).text(ids)  # [1, 1024] and [1, 77, 512]

Weights are `.safetensors` or `.npz` files of OpenAI's state dict, by its names: what open_clip made of OpenAI's has them, and so has
what `safetensors.torch.save_file(torch.jit.load("RN50.pt", map_location="cpu").state_dict(), "RN50.safetensors")` writes where
PyTorch is. Most that open_clip trained itself has them too, but wants another GELU. The tokenizer is Hugging Face's `tokenizer.json`
of any of OpenAI's models: they share one vocabulary.
"""

from __future__ import annotations

import functools
import os
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from lala_jax import backbone, checkpoint
from lala_jax.models import clip


def load(path: str | os.PathLike[str], net: clip.Clip | None = None) -> dict[str, Any]:
    """Read the variables of `net`, by default of RN50: nested dicts of float32 NumPy arrays, exact from half precision.

    Raises CheckpointError naming a file that is missing, damaged or of another type, and the tensor that is missing, unexpected,
    of another shape, or has values that no training gives.
    """
    tensors = backbone.read(pathlib.Path(path))
    try:
        return clip.from_published(tensors, clip.Clip() if net is None else net)
    except ValueError as error:
        raise checkpoint.CheckpointError(f"{path} cannot be used: {error}") from error


def tokenize(path: str | os.PathLike[str], sentences: Sequence[str], length: int = 77) -> np.ndarray:
    """Give token ids `[B, length]`, int32: the start, the word pieces in lower case, the end, the highest id there is, then zeros.

    Needs the package `tokenizers`, of the extra `language`. Raises CheckpointError for a file that is no tokenizer of CLIP, and
    ValueError for a sentence with more than `length` tokens and for no sentence at all.
    """
    if not sentences:
        raise ValueError("no sentences to tokenize")
    tokenizer, start, end = _tokenizer(os.fspath(path))
    ids = np.zeros((len(sentences), length), np.int32)
    for row, sentence in zip(ids, sentences, strict=True):
        tokens = [start, *tokenizer.encode(sentence, add_special_tokens=False).ids, end]  # one at a time starts no threads
        if len(tokens) > length:
            raise ValueError(f"{sentence!r} has {len(tokens)} tokens, more than the {length} that are asked for")
        row[: len(tokens)] = tokens
    return ids


@functools.lru_cache(maxsize=1)
def _tokenizer(path: str) -> tuple[Any, int, int]:
    """Read a tokenizer, and give it with the ids of its start and end."""
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
    if start is None or end != tokenizer.get_vocab_size() - 1:  # where the text's tower looks for the sentence
        raise checkpoint.CheckpointError(f"{path} is no tokenizer of CLIP: it does not end in <|startoftext|> and <|endoftext|>")
    return tokenizer, start, end
