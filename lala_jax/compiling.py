"""How the programs with a network in them are compiled, what they need, and where they are kept for the next process."""

from __future__ import annotations

import functools
import os
import pathlib
import sys
import time
from typing import Any

import jax

# On a CPU, XLA hands convolutions and what is around them to a library, YNN. The kernel gradient of a 3x3 convolution of 24 channels
# over 8 x 160 x 80 cells takes it 157 ms, and XLA's own convolution 13 (jaxlib 0.10.2, two cores). "" hands it nothing; other platforms
# do not care.
OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}

jit = functools.partial(jax.jit, compiler_options=OPTIONS)
"""`jax.jit` with OPTIONS; as with any compiler options, what it wraps cannot be called in another jitted function."""


def build(jitted, *arguments: Any) -> tuple[Any, dict[str, float]]:
    """Compile a jitted function for its arguments, static ones among them, without running it.

    Gives the program, which takes those that are not static, and facts: `compile_seconds`, and as far as XLA counts them `flops` and
    `bytes` of a run, and the `memory` in bytes that one needs: arguments, results (those in donated memory once) and what is between.
    """
    begin = time.perf_counter()
    program = jitted.lower(*arguments).compile()
    facts = {"compile_seconds": time.perf_counter() - begin}
    cost, memory = program.cost_analysis() or {}, program.memory_analysis()
    facts |= {name: float(cost[key]) for name, key in (("flops", "flops"), ("bytes", "bytes accessed")) if cost.get(key, 0) > 0}
    if memory is not None:
        outside = memory.argument_size_in_bytes + memory.output_size_in_bytes - memory.alias_size_in_bytes
        facts["memory"] = float(outside + memory.temp_size_in_bytes)
    return program, facts


def keep() -> None:
    """Keep compiled programs in the user's cache folder, for processes to come: their first training step is there in a fifth of the time.

    JAX_COMPILATION_CACHE_DIR names another folder, JAX_ENABLE_COMPILATION_CACHE=false keeps nothing. The folder may be deleted.
    """
    if jax.config.jax_compilation_cache_dir is not None or not jax.config.jax_enable_compilation_cache:
        return
    folder = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache") / "lala_jax" / "xla"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # what lies there is run
    except OSError as error:
        print(f"compiled programs are not kept: {error}", file=sys.stderr)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
