"""Mistakes like a policy's own: what the oracle would do, spoiled, so that demonstrations show how to recover. Host-side numpy."""

from __future__ import annotations

import numpy as np

from lala_jax import types
from lala_jax.perception import transforms
from lala_jax.sim import oracle
from lala_jax.sim.tasks import base, geometry

BESIDE = (0.02, 0.06)  # metres: a misplaced object is so far from its goal
_DIRECTIONS = 32  # tried, to find one that leaves the object in the workspace and upright
_REST = 0.005  # metres: what is put down rests at least so far on both sides of its middle, or it would topple
_LEVEL = 0.002  # metres: heights that differ less are one level


def act(
    task: base.Task, scene: types.Scene, poses: np.ndarray, rng: np.random.Generator, rng_mistakes: np.random.Generator, *, share: float
) -> types.PickPlace | None:
    """Choose the oracle's action, or with probability `share` a mistake in its place where the oracle brings an object to its goal.

    Without mistakes it is `oracle.act`, with the same use of `rng`.
    """
    chosen = oracle.plan(task, scene, poses, rng)
    if chosen is None:
        return None
    if rng_mistakes.random() < share and oracle.ready(task, scene, poses)[chosen[0]]:
        kinds = possible(task, scene, poses, chosen[0], rng_mistakes)
        if kinds:
            moves = kinds[rng_mistakes.choice(sorted(kinds))]
            return oracle.move(scene, poses, *moves[rng_mistakes.integers(len(moves))], rng_mistakes)
    return oracle.move(scene, poses, *chosen, rng)


def possible(
    task: base.Task, scene: types.Scene, poses: np.ndarray, index: int, rng: np.random.Generator
) -> dict[str, list[tuple[int, np.ndarray]]]:
    """Give what may go wrong when ready object `index` should go to its goal, by kind: which object moves, and the pose `[7]` it gets.

    turned: the right object at its goal, a quarter turn off (not where that looks alike); beside: `BESIDE` from its goal in the
    plane; elsewhere: at the free and supported goal of another unplaced object; another: another object, maybe a distractor, where
    the right one belongs. Kinds with no such move are left out, and so are moves after which the object would topple: nobody could
    put that right.
    """
    poses, goal, size = np.asarray(poses, float), np.asarray(scene.goal, float), np.asarray(scene.size, float)
    in_place, shown, others = oracle.placed(task, scene, poses), oracle.wanted(scene), np.arange(len(poses)) != index
    free = ~oracle.in_the_way(scene, poses).any(-1) & oracle.supported(task, scene, in_place)
    angle = rng.uniform(-np.pi, np.pi, _DIRECTIONS)
    step = rng.uniform(*BESIDE, _DIRECTIONS) * np.stack([np.cos(angle), np.sin(angle)])
    shifted = goal[index] + np.pad(step.T, ((0, 0), (0, 5)))
    area = base.Area(base.WORKSPACE.x, base.WORKSPACE.y, float(goal[index, 2] + size[index, 2] / 2 + base.HOVER))
    shifted = shifted[area.holds(shifted, size[index])]
    quarter = transforms.pose_from_yaw(goal[index, :3], geometry.yaw(goal[index]) + rng.choice([-1, 1]) * np.pi / 2)
    kinds = {
        "turned": [(index, quarter)] if scene.symmetry[index] > 0.75 * np.pi else [],
        "beside": [(index, pose) for pose in shifted],
        "elsewhere": [(index, goal[j]) for j in np.flatnonzero(~in_place & free & others)],
        "another": [(int(k), goal[index]) for k in np.flatnonzero((~in_place | ~shown) & oracle.pickable(scene, poses) & others)],
    }
    stable = {kind: [move for move in moves if stands(task, scene, poses, *move)] for kind, moves in kinds.items()}
    return {kind: moves for kind, moves in stable.items() if moves}


def stands(task: base.Task, scene: types.Scene, poses: np.ndarray, index: int, pose: np.ndarray) -> bool:
    """Say whether object `index` stays upright when it is put down at `pose` `[7]`, taking all boxes as upright."""
    others, size = np.arange(len(poses)) != index, np.asarray(scene.size, float)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 17)] * 2), axis=-1).reshape(-1, 2) * size[index, :2]
    points = transforms.apply_pose(pose, np.pad(grid, ((0, 0), (0, 1))))[:, :2]
    boxes = np.concatenate([poses[others], np.asarray(scene.base, float)[None]]), np.concatenate([size[others], [task.base_size]])
    under = np.array([geometry.covers(*box, points) for box in zip(*boxes, strict=True)])
    height = (under * (boxes[0][:, 2] + boxes[1][:, 2] / 2)[:, None]).max(0)
    contact = grid[height > height.max() - _LEVEL]
    return bool((contact.min(0) < -_REST).all() and (contact.max(0) > _REST).all())
