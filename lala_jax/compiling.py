"""How the programs with a network in them are compiled."""

from __future__ import annotations

import functools

import jax

# On a CPU, XLA hands convolutions and what is around them to a library, YNN. The kernel gradient of a 3x3 convolution of 24 channels
# over 8 x 160 x 80 cells takes it 157 ms, and XLA's own convolution 13 (jaxlib 0.10.2, two cores). "" hands it nothing; other platforms
# do not care.
OPTIONS = {"xla_cpu_experimental_ynn_fusion_type": ""}

jit = functools.partial(jax.jit, compiler_options=OPTIONS)
"""`jax.jit` with OPTIONS; as with any compiler options, what it wraps cannot be called in another jitted function."""
