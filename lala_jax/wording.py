"""The goal in words: sentences of the tasks, and their tokens by whatever tokenizer there is. `language` and `clip_file` have one each.

A tokenizer is a function here, from a text to its ids: the start, the pieces of words, the end. Padding is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from lala_jax.sim.tasks import base, tower

TASKS = (tower.TowerTask.name,)  # whose goals can be said
Encode = Callable[[str], Sequence[int]]


def sentence(task_name: str, colors: Sequence[str]) -> str:
    """Say the goal of a scene whose objects have these colours, names of `base.COLORS`, bottom to top.

    Raises ValueError for a task without a sentence (the paper ran its language baseline on the tower only), an unknown colour
    and no colours.
    """
    if task_name not in TASKS:
        raise ValueError(f"task {task_name!r} has no sentence: the paper gives one for {', '.join(map(repr, TASKS))} only")
    unknown = sorted(set(colors) - set(base.COLORS))
    if unknown or not colors:
        raise ValueError(f"a sentence needs colours out of {', '.join(base.COLORS)}, got {', '.join(unknown) or 'none'}")
    return tower.sentence(colors)


def tokenize(encode: Encode, sentences: Sequence[str], length: int | None = None) -> np.ndarray:
    """Give the ids `[B, length]`, int32, of each sentence, and zeros after them.

    Without a `length` it is that of the longest sentence. Raises ValueError for a sentence that is longer and for none at all.
    """
    if not sentences:
        raise ValueError("no sentences to tokenize")
    rows = [list(encode(sentence)) for sentence in sentences]  # one at a time starts no threads
    longest = max(range(len(rows)), key=lambda index: len(rows[index]))
    length = len(rows[longest]) if length is None else length
    if len(rows[longest]) > length:
        raise ValueError(f"{sentences[longest]!r} has {len(rows[longest])} tokens, more than the {length} that are asked for")
    return np.array([row + [0] * (length - len(row)) for row in rows], np.int32)


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


def template(encode: Encode, task_name: str, count: int, length: int | None = None) -> Template:
    """Make the template of a task's sentences with `count` colours, as long as the longest of them, or padded to `length`.

    Raises ValueError as `sentence` and `tokenize` do, and for a tokenizer that gives 0 to what is no padding, or to a colour
    other tokens in a sentence than alone.
    """
    names = list(base.COLORS)
    colors = [list(encode(name))[1:-1] for name in names]
    longest = max(colors, key=len)
    text = sentence(task_name, [names[colors.index(longest)]] * count)
    (ids,), width = tokenize(encode, [text], length), len(longest)
    if 0 in encode(text) or any(0 in row for row in colors):
        raise ValueError(f"token 0 is no padding: it is in {text!r}, or a colour's")
    starts = [start for start in range(len(ids) - width + 1) if ids[start : start + width].tolist() == longest]
    slots = np.array(starts, np.int32)[:, None] + np.arange(width, dtype=np.int32)
    if len(np.unique(slots)) != count * width:
        raise ValueError(f"the tokens {longest} stand {len(starts)} times in {text!r}, not {count} times apart")
    ids[slots] = 0
    padded = np.array([row + [0] * (width - len(row)) for row in colors], np.int32)
    return Template(ids=jnp.asarray(ids), slots=jnp.asarray(slots), colors=jnp.asarray(padded))
