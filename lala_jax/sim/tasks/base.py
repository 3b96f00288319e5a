"""What a task is, and the free, reachable poses that every task samples from."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Iterable, Iterator
from typing import ClassVar

import numpy as np

from lala_jax import types
from lala_jax.perception import transforms
from lala_jax.sim import robot
from lala_jax.sim.tasks import geometry

COLORS = {
    "blue": (78, 121, 167),
    "red": (255, 87, 89),
    "green": (89, 169, 79),
    "orange": (242, 142, 43),
    "yellow": (237, 201, 72),
    "purple": (176, 122, 161),
    "pink": (255, 157, 167),
    "cyan": (118, 183, 178),
    "brown": (156, 117, 95),
    "white": (255, 255, 255),
    "gray": (186, 176, 172),
}
PALETTES = {"paper": tuple(COLORS), "code": tuple(name for name in COLORS if name != "brown")}
COLOR_CHOICES = (*PALETTES, "uniform")  # uniform: anywhere in the RGB cube


def palette(name: str) -> np.ndarray:
    """Give the colours `[P, 3]` of a palette, RGB in 0..1."""
    return np.array([COLORS[color] for color in PALETTES[name]]) / 255.0


def closest(colors: np.ndarray) -> float:
    """Give the Euclidean distance of the closest two of `colors` `[P, 3]`."""
    first, second = np.triu_indices(len(colors), 1)
    return float(np.linalg.norm(colors[first] - colors[second], axis=-1).min())


APART = closest(palette("paper"))  # colours drawn uniformly are at least so far from each other
LOWEST = 0.02  # metres, of objects: twice what the score tolerates in height
BURIED = -1.0  # metres, the height of a distractor's goal: under the table, where no camera sees it

WORKSPACE = types.MapSpec()
MARGIN = 0.015  # metres between the footprints of two objects at the start
BORDER = 0.01  # metres between a footprint and the edge of the workspace
CARRY = 0.32  # metres, how far an object is lifted above the table by the primitive
HOVER = 0.10  # metres, at least so far above a goal the arm must reach
TRIES = 128  # candidate poses an object gets in one attempt
_FIRST = 8  # candidates looked at before the others
ATTEMPTS = 20  # fresh starts before `NoFreePose`
COLOR_TRIES = 1000  # draws a uniform colour gets


class NoFreePose(RuntimeError):
    """No free pose was found within the bounded number of tries."""


@dataclasses.dataclass(frozen=True)
class Area:
    """Where objects are drawn: footprints inside a rectangle, centres where the arm reaches from the table up to `height`. In metres."""

    x: tuple[float, float]
    y: tuple[float, float]
    height: float

    def holds(self, poses: np.ndarray, size: np.ndarray) -> np.ndarray:
        """Say for `poses` `[..., 7]` whether the footprint of a box of `size` `[3]` lies inside."""
        low, high = np.array([self.x[0], self.y[0]]) + BORDER, np.array([self.x[1], self.y[1]]) - BORDER
        xy, half = poses[..., :2], geometry.extent(poses, size)[..., :2]
        inside = ((xy - half >= low) & (xy + half <= high)).all(-1)
        for z in (0.0, self.height):
            inside &= robot.reachable(np.concatenate([xy, np.full((*xy.shape[:-1], 1), z)], axis=-1))
        return inside


def free_pose(
    rng: np.random.Generator, size: np.ndarray, area: Area, others: np.ndarray, other_size: np.ndarray, *, tries: int = TRIES
) -> np.ndarray | None:
    """Draw a pose `[7]` on the table of a box of `size` `[3]`, any yaw, clear of `others` `[K, 7]` by `MARGIN`; None if none is free."""
    xy = rng.uniform([area.x[0], area.y[0]], [area.x[1], area.y[1]], (tries, 2))
    poses = transforms.pose_from_yaw(np.concatenate([xy, np.full((tries, 1), size[2] / 2)], -1), rng.uniform(-np.pi, np.pi, tries))
    poses = poses[area.holds(poses, size)]
    for part in (poses[:_FIRST], poses[_FIRST:]):  # one of the first is nearly always free
        free = (geometry.gap(part[:, None], size, others, other_size) >= MARGIN).all(-1)
        if free.any():
            return part[np.argmax(free)]
    return None


def free_poses(
    rng: np.random.Generator, size: np.ndarray, area: Area, *, order: np.ndarray, others: np.ndarray, other_size: np.ndarray
) -> np.ndarray:
    """Draw poses `[N, 7]` of boxes of `size` `[N, 3]`, one after another in `order`, clear of each other and of `others` `[K, 7]`.

    Raises `NoFreePose` after `ATTEMPTS` fresh starts of `TRIES` candidates an object.
    """
    index = 0
    for _ in range(ATTEMPTS):
        poses, done = np.zeros((len(size), 7)), []
        for index in order:
            taken = np.concatenate([others, poses[done]]), np.concatenate([other_size, size[done]])
            found = free_pose(rng, size[index], area, *taken)
            if found is None:
                break
            poses[index] = found
            done.append(index)
        else:
            return poses
    raise NoFreePose(
        f"no free pose for object {index} of size {np.round(size[index], 4).tolist()} after {ATTEMPTS} attempts of {TRIES} tries in "
        f"x {area.x}, y {area.y}, in reach up to z = {area.height:.3f} m, beside {len(size) - 1} other objects: use fewer or smaller ones"
    )


def uniform_colors(rng: np.random.Generator, count: int, *, taken: np.ndarray, apart: float) -> np.ndarray:
    """Draw `count` colours `[count, 3]` uniformly in RGB 0..1, one after another, `apart` from each other and from `taken` `[K, 3]`."""
    colors = taken
    for index in range(count):
        drawn = rng.uniform(size=(COLOR_TRIES, 3))
        free = (np.linalg.norm(drawn[:, None] - colors, axis=-1) >= apart).all(-1)
        if not free.any():
            raise ValueError(f"no colour {apart:.3f} away from {len(colors)} others in {COLOR_TRIES} draws: {index} of {count} found")
        colors = np.concatenate([colors, drawn[[np.argmax(free)]]])
    return colors[len(colors) - count :]


@dataclasses.dataclass(frozen=True)
class Task:
    """The facts of a task; hashable, so that compiled models may be kept per task.

    Distractors are further objects on the table, the scene's last ones, that the goal does not show: their goal poses are under the table.
    """

    num_objects: int  # that the goal shows
    colors: str = "paper"  # one of COLOR_CHOICES
    max_actions: int | None = None  # of an episode; None: the task's own budget
    distractors: int = 0

    name: ClassVar[str]
    base_size: ClassVar[tuple[float, float, float]]  # full extents, metres
    base_color: ClassVar[tuple[float, float, float]]  # RGB 0..1

    def __post_init__(self):
        if self.colors not in COLOR_CHOICES:
            raise ValueError(f"task {self.name}: colors={self.colors!r} is not one of {sorted(COLOR_CHOICES)}")
        most = len(PALETTES.get(self.colors, COLORS)) - self.num_objects
        if not all(0.0 <= value <= 1.0 for value in self.base_color):
            raise ValueError(f"task {self.name}: base_color must be RGB in 0..1, got {self.base_color}")
        if self.num_objects < 1:
            raise ValueError(f"task {self.name}: num_objects={self.num_objects} must be at least 1")
        if self.distractors and type(self).build_distractors is Task.build_distractors:
            raise ValueError(f"task {self.name} has no build_distractors: without one it needs distractors=0, got {self.distractors}")
        if self.distractors and not 0 < self.distractors <= most:
            raise ValueError(f"task {self.name}: distractors={self.distractors} is not one of 0..{most}: each has a colour of its own")
        if self.budget < 1:
            raise ValueError(f"task {self.name}: max_actions={self.budget} must be at least 1")

    @property
    def budget(self) -> int:
        """The actions that an episode may take."""
        return self.default_max_actions() if self.max_actions is None else self.max_actions

    def default_max_actions(self) -> int:
        """Give the action budget that the benchmark grants."""
        raise NotImplementedError

    def build(self, rng: np.random.Generator) -> types.Scene:
        """Draw one scene in float64 numpy, without distractors; `sample` seeds it, adds them and fixes the dtype."""
        raise NotImplementedError

    def build_distractors(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw the distractors' sizes `[D, 3]` in metres and symmetries `[D]` in radians."""
        raise NotImplementedError

    def start_area(self, size: np.ndarray) -> Area:
        """Say where boxes of `size` `[N, 3]` lie at the start."""
        return Area(WORKSPACE.x, WORKSPACE.y, size[:, 2].max() + CARRY)

    def object_mass(self, scene: types.Scene) -> np.ndarray:
        """Give the objects' masses `[N]` in kilograms."""
        raise NotImplementedError

    def sample(self, seed: int) -> types.Scene:
        """Give the scene of `seed` (at least 0), float32 numpy leaves: a pure function of the task's fields and the seed."""
        if seed < 0:
            raise ValueError(f"task {self.name}: seed={seed} must be at least 0")
        rng = np.random.default_rng([seed, zlib.crc32(self.name.encode())])
        scene = self.build(rng)
        if not isinstance(scene, types.Scene):
            raise ValueError(f"task {self.name}: build must return a types.Scene, got {type(scene).__name__}")
        if self.distractors:  # after all else: the other objects stay what they are without
            scene = self._with_distractors(rng, scene)
        drawn = types.Scene(**{field.name: np.asarray(getattr(scene, field.name), np.float32) for field in dataclasses.fields(scene)})
        self._check(drawn)
        return drawn

    def roomy(self, seeds: Iterable[int]) -> Iterator[tuple[int, types.Scene]]:
        """Give `(seed, scene)` of the seeds whose scene has a free pose for every object; the others are passed over."""
        for seed in seeds:
            try:
                scene = self.sample(seed)
            except NoFreePose:
                continue
            yield seed, scene

    def roomy_lists(self, seeds: Iterable[int]) -> tuple[list[int], list[types.Scene]]:
        """Give what `roomy` does as two lists."""
        pairs = list(self.roomy(seeds))
        return [seed for seed, _ in pairs], [scene for _, scene in pairs]

    def _check(self, scene: types.Scene) -> None:
        """Raise ValueError, naming the field, for a scene that nothing later could make sense of."""
        count = self.num_objects + self.distractors
        shapes = {"size": (count, 3), "color": (count, 3), "base": (7,), "start": (count, 7), "goal": (count, 7), "symmetry": (count,)}
        for name, shape in shapes.items():
            if (found := getattr(scene, name)).shape != shape or not np.isfinite(found).all():
                found = found if found.shape == shape else found.shape
                raise ValueError(f"task {self.name}: a scene's {name} must be finite and of shape {shape}, got {found}")
        if wrong := types.out_of_range(scene):
            raise ValueError(f"task {self.name}: a scene's {wrong}")
        for name in ("base", "start", "goal"):
            if (tilt := np.abs(getattr(scene, name)[..., 4:6]).max()) > 1e-3:
                raise ValueError(f"task {self.name}: a scene's {name} must stand upright, turned about z alone, got qx or qy of {tilt:.4g}")
        if (lowest := scene.size[:, 2].min()) < LOWEST - 1e-6:
            raise ValueError(f"task {self.name}: objects must be at least {LOWEST} m high, or the score mixes up levels, got {lowest:.4f}")

    def _with_distractors(self, rng: np.random.Generator, scene: types.Scene) -> types.Scene:
        """Add the distractors, clear of all that lies on the table."""
        size, symmetry = self.build_distractors(rng)
        color = self.draw_colors(rng, count=self.distractors, taken=np.asarray(scene.color))
        others = np.concatenate([scene.start, scene.base[None]]), np.concatenate([scene.size, [self.base_size]])
        order = np.arange(self.distractors)
        start = free_poses(rng, size, self.start_area(size), order=order, others=others[0], other_size=others[1])
        goal = np.column_stack([start[:, :2], np.full(len(start), BURIED), start[:, 3:]])
        more = {"size": size, "color": color, "start": start, "goal": goal, "symmetry": symmetry}
        return scene.replace(**{name: np.concatenate([getattr(scene, name), rows]) for name, rows in more.items()})

    def draw_colors(
        self, rng: np.random.Generator, *, count: int | None = None, taken: np.ndarray | None = None, distinct: bool = True
    ) -> np.ndarray:
        """Draw RGB `[count, 3]` in 0..1, of `num_objects` unless told: none of `taken` `[K, 3]`, and distinct unless told."""
        count = self.num_objects if count is None else count
        taken = np.zeros((0, 3)) if taken is None else taken
        if self.colors == "uniform":
            return uniform_colors(rng, count, taken=taken, apart=APART if distinct else 0.0)
        colors = palette(self.colors)
        colors = colors[(colors[:, None] != taken).any(-1).all(-1)]
        if distinct and count > len(colors):
            raise ValueError(f"task {self.name}: {count} distinct colours asked of the {len(colors)} in palette {self.colors!r}")
        return colors[rng.choice(len(colors), count, replace=not distinct)]

    def supports(self, scene: types.Scene) -> np.ndarray:
        """Give `[N, N]` bool: `[i, j]` when goal pose i rests on goal pose j, so that j must be in place before i."""
        goal, size = np.asarray(scene.goal, float), np.asarray(scene.size, float)
        half = geometry.extent(goal, size)[:, 2]
        touching = np.abs((goal[:, 2] - half)[:, None] - (goal[:, 2] + half)[None, :]) < 1e-3
        return touching & (geometry.gap(goal[:, None], size[:, None], goal, size) < -1e-4)


def color_name(rgb: np.ndarray) -> str:
    """Name the palette colour nearest to `rgb` `[3]` in 0..1."""
    return min(COLORS, key=lambda name: float(np.sum((np.array(COLORS[name]) / 255.0 - np.asarray(rgb)) ** 2)))
