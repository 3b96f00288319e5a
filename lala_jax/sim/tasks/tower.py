"""Task `tower` (the paper's stacking-tower): cubes in a given order on a stand."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from lala_jax import types
from lala_jax.perception import transforms
from lala_jax.sim.tasks import base, geometry


@dataclasses.dataclass(frozen=True)
class TowerTask(base.Task):
    """Stack `num_objects` (1..6) cubes of distinct colours; cube i belongs at level i, bottom first."""

    num_objects: int = 5
    edge: tuple[float, float] = (0.04, 0.04)  # metres, range of the cubes' edges; equal ends: all the same

    name: ClassVar[str] = "tower"
    base_size: ClassVar[tuple[float, float, float]] = (0.05, 0.05, 0.005)
    base_color: ClassVar[tuple[float, float, float]] = (156 / 255, 117 / 255, 95 / 255)

    def __post_init__(self):
        super().__post_init__()
        if not 1 <= self.num_objects <= 6:
            raise ValueError(f"task tower: num_objects={self.num_objects} is not one of 1..6: a higher tower leaves the workspace")
        low, high = self.edge
        if not 0.03 <= low <= high <= 0.045:
            raise ValueError(f"task tower: edge={self.edge} must be (low, high) with 0.03 <= low <= high <= 0.045 m")

    def default_max_actions(self) -> int:
        return self.num_objects + 1

    def object_mass(self, scene: types.Scene) -> np.ndarray:
        """Give the cubes' masses `[N]`: 0.01 kg at 0.04 m, with the volume otherwise."""
        return 0.01 * np.prod(np.asarray(scene.size, float), axis=-1) / 0.04**3

    def build_distractors(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw cubes like the others."""
        return self._cubes(rng, self.distractors), np.full(self.distractors, np.pi / 2)

    def _cubes(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return np.repeat(rng.uniform(*self.edge, (count, 1)), 3, axis=1)

    def build(self, rng: np.random.Generator) -> types.Scene:
        size = self._cubes(rng, self.num_objects)
        color = self.draw_colors(rng)
        # The finished tower and a cube held above it must be in reach.
        high = base.Area(base.WORKSPACE.x, base.WORKSPACE.y, self.base_size[2] + size[:, 2].sum() + base.HOVER)
        none = np.zeros((0, 7)), np.zeros((0, 3))
        stand = base.free_poses(rng, np.array([self.base_size]), high, order=np.arange(1), others=none[0], other_size=none[1])
        z = self.base_size[2] + np.cumsum(size[:, 2]) - size[:, 2] / 2
        goal = transforms.pose_from_yaw(np.column_stack([np.repeat(stand[:, :2], self.num_objects, axis=0), z]), geometry.yaw(stand))
        order = np.arange(self.num_objects)[::-1]
        start = base.free_poses(rng, size, self.start_area(size), order=order, others=stand, other_size=np.array([self.base_size]))
        return types.Scene(size=size, color=color, base=stand[0], start=start, goal=goal, symmetry=np.full(self.num_objects, np.pi / 2))

    def sentence(self, scene: types.Scene) -> str:
        """Say the goal for a language-conditioned baseline, bottom to top."""
        return sentence([base.color_name(rgb) for rgb in np.asarray(scene.color)[: self.num_objects]])


def sentence(colors: Sequence[str]) -> str:
    """Say the goal of a tower of blocks with these colour names, bottom to top, as the paper did."""
    return f"make the tower with {', '.join(colors)} blocks"
