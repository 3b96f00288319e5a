"""How the paper's networks take two images: as a difference, in two streams, or in two streams with lateral connections."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from lala_jax.models import blocks

VARIANTS = ("single", "two_stream", "two_stream_lateral")
FUSIONS = ("add", "conv")


class Streams(nn.Module):
    """Predict `out` values a cell from a current and a goal image.

    - "single": one hourglass on the difference, current minus goal.
    - "two_stream": one hourglass each, their outputs fused.
    - "two_stream_lateral": the same, and the current stream's decoder features enter the goal stream's decoder.

    Outputs are fused by addition ("add", the paper's choice for picking) or by a 1x1 convolution of both ("conv", the
    paper's choice for key and query). Raises ValueError for another variant or fusion.
    """

    out: int
    variant: str = "two_stream"
    fusion: str = "add"
    width: int = 64
    stages: int = 4
    dtype: jnp.dtype = jnp.float32
    head_dtype: jnp.dtype | None = None  # of the last layers, `dtype` unless given

    def __post_init__(self):
        if self.variant not in VARIANTS:
            raise ValueError(f"Streams.variant must be one of {VARIANTS}, got {self.variant!r}")
        if self.fusion not in FUSIONS:
            raise ValueError(f"Streams.fusion must be one of {FUSIONS}, got {self.fusion!r}")
        super().__post_init__()

    @nn.compact
    def __call__(self, current: jax.Array, goal: jax.Array) -> jax.Array:
        """Map two images `[..., H, W, C]` to `[..., H, W, out]`, float32 whatever the networks compute in."""
        if current.shape != goal.shape:
            raise ValueError(f"current and goal must have one shape, got {current.shape} and {goal.shape}")
        if self.variant == "single":
            return self._net("difference")(current - goal)[0].astype(jnp.float32)
        current, decoded = self._net("current")(current)
        goal, _ = self._net("goal")(goal, decoded if self.variant == "two_stream_lateral" else None)
        if self.fusion == "add":
            return current.astype(jnp.float32) + goal.astype(jnp.float32)
        both = jnp.concatenate([current, goal], -1)
        return nn.Conv(self.out, (1, 1), dtype=self.dtype, name="fuse")(both).astype(jnp.float32)

    def _net(self, name: str) -> blocks.ResNet43_8s:
        return blocks.ResNet43_8s(self.out, self.width, self.stages, self.dtype, self.head_dtype, name=name)
