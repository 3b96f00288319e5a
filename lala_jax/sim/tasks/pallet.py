"""Task `pallet` (the paper's palletizing-boxes): boxes of a split block, back onto a pallet."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from lala_jax import types
from lala_jax.perception import transforms
from lala_jax.sim.tasks import base

REGION = (0.15, 0.15, 0.10)  # metres, the block that is split
SMALLEST = 0.05  # metres, smallest side of a cell of the split
GAP = 0.01  # metres between neighbours in x and y, half from each
TOP = 0.0388  # metres, the pallet's top
DISTRACTOR = (0.05, 0.09)  # metres, range of a distractor's sides in x and y


def symmetry(size: np.ndarray) -> np.ndarray:
    """Give the symmetries `[N]` in radians of boxes of `size` `[N, 3]`: a quarter turn where they are square, half a turn otherwise."""
    return np.where(np.abs(size[:, 0] - size[:, 1]) < 0.001, np.pi / 2, np.pi)


def split(rng: np.random.Generator, low: np.ndarray, high: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Split the block `low` `[3]` to `high` `[3]` (metres) as a KD tree into cells that no axis can split again.

    A random axis whose side is at least twice `SMALLEST` is cut at a uniform place that leaves both parts at least `SMALLEST`;
    then `GAP` is taken, half from each part, in x and y. So a box's side is at least `SMALLEST - GAP / 2` in x and y.
    """
    axes = np.flatnonzero(high - low >= 2 * SMALLEST - 1e-9)
    if not len(axes):
        return [(low, high)]
    axis = rng.choice(axes)
    cut = rng.uniform(low[axis] + SMALLEST, max(high[axis] - SMALLEST, low[axis] + SMALLEST))
    half = 0.0 if axis == 2 else GAP / 2
    below, above = high.copy(), low.copy()
    below[axis], above[axis] = cut - half, cut + half
    return split(rng, low, below) + split(rng, above, high)


@dataclasses.dataclass(frozen=True)
class PalletTask(base.Task):
    """Put eight boxes, two layers of four, back where the goal picture shows them."""

    num_objects: int = 8
    distinct_colors: bool = True  # False: colours may repeat

    name: ClassVar[str] = "pallet"
    base_size: ClassVar[tuple[float, float, float]] = (0.30, 0.25, 0.0375)
    base_color: ClassVar[tuple[float, float, float]] = (222 / 255, 184 / 255, 135 / 255)

    def __post_init__(self):
        super().__post_init__()
        if self.num_objects != 8:
            raise ValueError(f"task pallet: num_objects={self.num_objects} is not 8, the number of boxes that the split always gives")

    def default_max_actions(self) -> int:
        return self.num_objects + 4

    def object_mass(self, scene: types.Scene) -> np.ndarray:
        """Give the boxes' masses `[N]`: 0.1 kg each."""
        return np.full(len(np.asarray(scene.size)), 0.1)

    def start_area(self, size: np.ndarray) -> base.Area:
        """Give the left half of the table."""
        return base.Area(base.WORKSPACE.x, (base.WORKSPACE.y[0], 0.0), size[:, 2].max() + base.CARRY)

    def build_distractors(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw boxes about as large as the others."""
        sides = rng.uniform(*DISTRACTOR, (self.distractors, 2))
        size = np.column_stack([sides, np.full(self.distractors, REGION[2] / 2)])
        return size, symmetry(size)

    def build(self, rng: np.random.Generator) -> types.Scene:
        pallet = transforms.pose_from_yaw([0.5, 0.25, TOP - self.base_size[2] / 2], 0.0)
        corner = np.array([pallet[0] - REGION[0] / 2, pallet[1] - REGION[1] / 2, TOP])
        low, high = (np.array(side) for side in zip(*split(rng, corner, corner + REGION), strict=True))
        size, goal = high - low, transforms.pose_from_yaw((low + high) / 2, np.zeros(len(low)))
        color = self.draw_colors(rng, distinct=self.distinct_colors)
        order = np.argsort(-goal[:, 2], kind="stable")
        start = base.free_poses(rng, size, self.start_area(size), order=order, others=pallet[None], other_size=np.array([self.base_size]))
        return types.Scene(size=size, color=color, base=pallet, start=start, goal=goal, symmetry=symmetry(size))
