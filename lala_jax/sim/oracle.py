"""The oracle: reads true poses, says what is placed, what may go next, and how. Host-side numpy, one scene at a time.

`poses` are the settled object poses `[N, 7]`, world; boolean results are `[N]` in the scene's order.
"""

from __future__ import annotations

import numpy as np

from lala_jax import types
from lala_jax.perception import transforms
from lala_jax.sim import robot
from lala_jax.sim.tasks import base, geometry

PLANAR = 0.01  # metres: the score's tolerances
HEIGHT = 0.01  # metres
TURN = np.deg2rad(15.0)  # of the yaw, and of the tilt
EDGE = 0.01  # metres: picks keep this far from a face's edge, the cup's radius and a little more
_TOUCH = 0.002  # metres of overlap that do not count as being in the way
_STEP = 0.005  # metres: what ends lower than this above another's bottom is not in its way
_FLAT = np.cos(np.deg2rad(5.0))  # a face tilted further cannot be sucked on
_PARKING_TRIES = 256


def _boxes(scene: types.Scene, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(poses, float), np.asarray(scene.size, float)


def wanted(scene: types.Scene) -> np.ndarray:
    """Say which objects the goal shows; the others are distractors, their goal poses are under the table."""
    return np.asarray(scene.goal)[:, 2] >= 0.0


def placed(task: base.Task, scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Say which objects are at their goal pose: planar, height and yaw errors (modulo symmetry) within tolerance, and upright.

    A distractor counts as placed wherever it is: nothing is left to do with it.
    """
    del task
    poses, goal = np.asarray(poses, float), np.asarray(scene.goal, float)
    turn = transforms.wrap_angle(geometry.yaw(poses) - geometry.yaw(goal), np.asarray(scene.symmetry, float))
    near = np.linalg.norm(poses[:, :2] - goal[:, :2], axis=-1) < PLANAR
    level = np.abs(poses[:, 2] - goal[:, 2]) < HEIGHT
    upright = geometry.matrix(poses)[:, 2, 2] > np.cos(TURN)
    return (near & level & upright & (np.abs(turn) < TURN)) | ~wanted(scene)


def score(task: base.Task, scene: types.Scene, poses: np.ndarray) -> float:
    """Give the share of wanted objects that are placed, 0..100."""
    return share(scene, placed(task, scene, poses))


def share(scene: types.Scene, there: np.ndarray) -> float:
    """Give the share of wanted objects, 0..100, of which `there` `[N]` says that they are placed."""
    return 100.0 * float(there[wanted(scene)].mean())


def done(task: base.Task, scene: types.Scene, poses: np.ndarray) -> bool:
    """Say whether every wanted object is placed."""
    return bool(placed(task, scene, poses).all())


def _on_top(scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Give `[N, N]`: `[i, j]` when object j lies above i and must leave before i can be lifted."""
    poses, size = _boxes(scene, poses)
    half = geometry.extent(poses, size)[:, 2]
    overlap = geometry.gap(poses[:, None], size[:, None], poses, size) < -_TOUCH
    # j's top above i's and its centre higher: true for what rests on i, also leaning against it.
    higher = (poses[:, 2] > poses[:, None, 2]) & ((poses[:, 2] + half) > (poses[:, 2] + half)[:, None] + _STEP)
    return overlap & higher & ~np.eye(len(poses), dtype=bool)


def in_the_way(scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Give `[N, N]`: `[i, j]` when object j stands where i belongs, or above it."""
    poses, size = _boxes(scene, poses)
    goal = np.asarray(scene.goal, float)
    top = poses[:, 2] + geometry.extent(poses, size)[:, 2]
    bottom = goal[:, 2] - geometry.extent(goal, size)[:, 2]
    overlap = geometry.gap(goal[:, None], size[:, None], poses, size) < -_TOUCH
    return overlap & (top > bottom[:, None] + _STEP) & ~np.eye(len(poses), dtype=bool)


def pickable(scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Say which objects have nothing on top and a level top face whose centre is in the workspace and in reach."""
    poses, _ = _boxes(scene, poses)
    level = np.abs(geometry.matrix(poses)[:, 2, :]).max(-1) > _FLAT
    (x, y), xy = (base.WORKSPACE.x, base.WORKSPACE.y), poses[:, :2]
    inside = (xy >= [x[0], y[0]]).all(-1) & (xy < [x[1], y[1]]).all(-1)
    tops = _top_centers(scene, poses) + [0.0, 0.0, base.HOVER]
    return ~_on_top(scene, poses).any(-1) & level & inside & robot.reachable(tops)


def _top_centers(scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    poses, size = _boxes(scene, poses)
    return poses[:, :3] + np.array([0.0, 0.0, 1.0]) * geometry.extent(poses, size)[:, 2:]


def supported(task: base.Task, scene: types.Scene, in_place: np.ndarray) -> np.ndarray:
    """Say of which objects everything that their goal pose rests on is in place."""
    return ~(task.supports(scene) & ~in_place).any(-1)


def ready(task: base.Task, scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Say which objects may be picked and placed right now: unplaced, upright, free on top, supports placed, target free."""
    in_place = placed(task, scene, poses)
    upright = geometry.matrix(poses)[:, 2, 2] > _FLAT
    free = ~in_the_way(scene, poses).any(-1)
    return ~in_place & upright & free & pickable(scene, poses) & supported(task, scene, in_place)


def _must_move(task: base.Task, scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Say what lies on, or in the way of, an unplaced object whose supports are placed, and in turn on these."""
    in_place, on_top = placed(task, scene, poses), _on_top(scene, poses)
    upcoming = ~in_place & supported(task, scene, in_place)
    must = (on_top | in_the_way(scene, poses))[upcoming].any(0)
    for _ in range(len(must)):
        must |= on_top[must].any(0)
    return must


def blockers(task: base.Task, scene: types.Scene, poses: np.ndarray) -> np.ndarray:
    """Say which objects must be moved away first, where nothing is ready: pickable, and on or in the way of what should go next."""
    if ready(task, scene, poses).any():
        return np.zeros(len(poses), bool)
    return _must_move(task, scene, poses) & pickable(scene, poses)


def parking(task: base.Task, scene: types.Scene, poses: np.ndarray, index: int, rng: np.random.Generator) -> np.ndarray | None:
    """Draw a free pose `[7]` on the table for object `index`, clear of the others, of every goal and of the base; None if none is free."""
    poses, size = _boxes(scene, poses)
    goal, others, shown = np.asarray(scene.goal, float), np.arange(len(poses)) != index, wanted(scene)
    taken = np.concatenate([poses[others], goal[shown], np.asarray(scene.base, float)[None]])
    taken_size = np.concatenate([size[others], size[shown], [task.base_size]])
    area = base.Area(base.WORKSPACE.x, base.WORKSPACE.y, size[index, 2] + base.CARRY)
    return base.free_pose(rng, size[index], area, taken, taken_size, tries=_PARKING_TRIES)


def _yaws(now: float, target: float, symmetry: float) -> np.ndarray:
    """Give every yaw that brings `now` to `target` modulo `symmetry`, the smallest turn first, in -pi..pi."""
    turns = transforms.wrap_angle(target - now, symmetry) + symmetry * np.arange(round(2 * np.pi / symmetry))
    return transforms.wrap_angle(turns, 2 * np.pi)


def _carry(pick: np.ndarray, pose: np.ndarray, target: np.ndarray, yaw: np.ndarray | float) -> np.ndarray:
    """Give where the picked points `[..., 3]` go when a turn by `yaw` `[...]` and a shift bring the object from `pose` to `target`."""
    return target[:3] + transforms.rotate(transforms.quat_from_yaw(np.asarray(yaw, float)), pick - pose[:3])


def move(scene: types.Scene, poses: np.ndarray, index: int, target: np.ndarray, rng: np.random.Generator) -> types.PickPlace:
    """Bring object `index` to pose `target` `[7]` by the smallest turn, picked at a random point around the middle of its top face."""
    poses, size = _boxes(scene, poses)
    rotation = geometry.matrix(poses[index])
    up = np.argmax(np.abs(rotation[2]))  # a toppled box is picked by the face that is on top
    sides = [k for k in range(3) if k != up]
    local = np.zeros(3)
    local[up] = np.sign(rotation[2, up]) * size[index, up] / 2
    local[sides] = rng.uniform(-0.5, 0.5, 2) * np.maximum(size[index, sides] / 2 - EDGE, 0.0)
    pick = poses[index, :3] + rotation @ local
    yaw = _yaws(geometry.yaw(poses[index]), geometry.yaw(target), float(np.asarray(scene.symmetry)[index]))[0]
    place = _carry(pick, poses[index], target, yaw)
    return types.PickPlace(pick=pick.astype(np.float32), place=place.astype(np.float32), yaw=np.float32(yaw))


def plan(task: base.Task, scene: types.Scene, poses: np.ndarray, rng: np.random.Generator) -> tuple[int, np.ndarray] | None:
    """Choose an object and the pose `[7]` to bring it to: a ready one to its goal, else a blocker out of the way.

    A blocker that is placed, but not well enough for its neighbour, is put again; another one is parked. None when complete or when
    nothing helps.
    """
    poses, goal = np.asarray(poses, float), np.asarray(scene.goal, float)
    choice = np.flatnonzero(ready(task, scene, poses))
    if len(choice):
        index = int(rng.choice(choice))
        return index, goal[index]
    # What stands on a thing that must move too would only be in the way again.
    again = placed(task, scene, poses) & wanted(scene) & ~in_the_way(scene, poses).any(-1)
    again &= ~_on_top(scene, poses)[_must_move(task, scene, poses)].any(0)
    for index in rng.permutation(np.flatnonzero(blockers(task, scene, poses))):
        target = goal[index] if again[index] else parking(task, scene, poses, int(index), rng)
        if target is not None:
            return int(index), target
    return None


def act(task: base.Task, scene: types.Scene, poses: np.ndarray, rng: np.random.Generator) -> types.PickPlace | None:
    """Choose one action, the move that `plan` chose; None when complete or when nothing helps."""
    chosen = plan(task, scene, poses, rng)
    return None if chosen is None else move(scene, poses, *chosen, rng)


def blind(
    task: base.Task, scene: types.Scene, poses: np.ndarray, rng: np.random.Generator, *, known: np.ndarray | None = None
) -> types.PickPlace | None:
    """Choose an action that ignores which object belongs where: a random object that is nowhere yet to a random supported free place.

    It knows all places but neither order nor sizes, and takes distractors too: what a policy that never looks at the goal's identities
    can reach. Of the objects that are `known` `[N]` bool it knows the place: they go there and nowhere else. None when nothing is
    left to do.
    """
    poses, goal = np.asarray(poses, float), np.asarray(scene.goal, float)
    known = np.zeros(len(poses), bool) if known is None else known
    offset = np.abs(poses[:, None, :3] - goal[None, :, :3])  # [object, place, axis]
    at = (offset[..., :2] < 0.025).all(-1) & (offset[..., 2] < 0.02)
    occupied = at.any(0)
    places = np.flatnonzero(~occupied & wanted(scene) & supported(task, scene, occupied))
    free = ~at.any(1) & pickable(scene, poses)
    for place in rng.permutation(places):
        objects = np.flatnonzero(free & (np.arange(len(poses)) == place if known[place] else ~known))
        if len(objects):
            return move(scene, poses, int(rng.choice(objects)), goal[place], rng)
    return None


def top_view(task: base.Task, scene: types.Scene, poses: np.ndarray, rng: np.random.Generator) -> types.PickPlace | None:
    """Choose an action knowing of the goal what is seen from right above, else perfect: `blind` but for the objects with nothing on top.

    What a policy on a max-height map of the goal can reach.
    """
    return blind(task, scene, poses, rng, known=wanted(scene) & ~_on_top(scene, scene.goal).any(-1))


AGENTS = {"oracle": act, "blind": blind, "top_view": top_view}
