"""Take the first training step of the config (JSON) on standard input: what `benchmark_stages.first_step` times in a process of its own."""

from __future__ import annotations

import json
import pathlib
import sys
import tempfile

import jax

from experiments import benchmark_stages
from lala_jax import build, checkpoint, compiling, loop, options, train


def main() -> None:
    """Do what training does up to its first step, with states that are drawn here instead of recorded ones."""
    compiling.keep()
    config = options.from_dict(json.load(sys.stdin))
    recipe, states = build.recipe(config), benchmark_stages.states_of(config, benchmark_stages.BATCH)
    with tempfile.TemporaryDirectory() as folder:
        run = train.start_or_resume(config, recipe, checkpoint.Checkpoints(pathlib.Path(folder)))
    step = loop.compiled(train.step(), recipe, run, states, jax.random.key(config.seed), recipe.policy.frozen)
    jax.block_until_ready(step(run))


if __name__ == "__main__":
    main()
