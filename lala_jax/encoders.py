"""What CLIPort takes as others trained it, from files: ImageNet's trunk and MiniLM, or CLIP's towers."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lala_jax import backbone, checkpoint, clip_file, options, policy_cliport, wording
from lala_jax.models import bert
from lala_jax.sim.tasks import base

TRUNK = "resnet50_imagenet_v1"


@functools.lru_cache(maxsize=1)
def load(task_name: str, count: int, *, weights: str = "", tokenizer: str = "", stages: int = 0) -> dict[str, Any]:
    """Give `trunk`, `encoder` and `weights` of a `policy_cliport.CliportPolicy`, for a task's sentences of `count` objects.

    They are ImageNet's and MiniLM's, or, of CLIP's files `weights` and `tokenizer`, CLIP's with so many `stages` of its trunk. Raises
    OptionsError for a task without a sentence and for what is not installed, CheckpointError for files that cannot be used.
    """
    if task_name not in wording.TASKS:
        known = ", ".join(wording.TASKS)
        raise options.OptionsError(f"model.name 'cliport' needs a task.name with a sentence: {known}, got {task_name!r}")
    try:
        if weights:
            net, variables = clip_file.load(weights)
            template = clip_file.template(tokenizer, task_name, count, net.text)
            trunk, seen, encoder, words = policy_cliport.towers(net, variables, stages=stages)
        else:
            from lala_jax import language  # needs an extra

            found, seen = backbone.load(TRUNK, stage=policy_cliport.Trunk.stage)
            trunk, encoder, words = policy_cliport.Trunk(found.flavour, found.stage), bert.Bert(), language.load()
            template = language.template(task_name, count)
    except ModuleNotFoundError as error:
        raise options.OptionsError(f"model.name 'cliport' is not installed: {error}") from error
    palette = np.array(list(base.COLORS.values()), np.float32) / 255
    seen, words = jax.tree.map(jnp.asarray, (seen, words))
    statistics = policy_cliport.sentence_statistics(encoder, words, template, colors=len(palette))
    frozen = policy_cliport.Frozen(seen, words, template, jnp.asarray(palette), *map(jnp.asarray, statistics))
    return {"trunk": trunk, "encoder": encoder, "weights": frozen}


def identity(task_name: str, count: int, *, weights: str, tokenizer: str, stages: int) -> dict[str, int]:
    """Tell what CLIP's files hold from what others do: the `stages`, and a CRC32 of the values and of the tokens of all colours.

    The same in whatever format the values are stored, and for any `count`.
    """
    frozen = load(task_name, count, weights=weights, tokenizer=tokenizer, stages=stages)["weights"]
    words = clip_file.tokenize(tokenizer, [wording.sentence(task_name, list(base.COLORS))], None)
    return {"stages": stages, "crc32": checkpoint.crc32({"trunk": frozen.trunk, "encoder": frozen.encoder, "words": words})}
