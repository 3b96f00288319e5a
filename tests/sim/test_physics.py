import functools
import itertools
import os

import mujoco
import numpy as np
import pytest

from lala_jax import types
from lala_jax.sim import physics, robot, suction, tasks

CUBE = 0.04


@functools.cache
def task():
    return tasks.get("tower", num_objects=3)


@functools.cache
def scene():
    """Three cubes and a stand at round numbers."""
    poses = [pose(0.40, -0.20, CUBE / 2, 0.3), pose(0.55, -0.25, CUBE / 2, -1.0), pose(0.50, 0.10, CUBE / 2, 0.0)]
    goal = [pose(0.60, 0.25, 0.005 + CUBE * (i + 0.5), 0.7) for i in range(3)]
    return types.Scene(
        size=np.full((3, 3), CUBE),
        color=np.eye(3),
        base=pose(0.60, 0.25, 0.0025, 0.7),
        start=np.array(poses),
        goal=np.array(goal),
        symmetry=np.full(3, np.pi / 2),
    )


@pytest.fixture
def world():
    return physics.World(task(), scene())


def pose(x, y, z, yaw):
    return np.array([x, y, z, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def yaw_of(poses):
    return 2.0 * np.arctan2(poses[..., 6], poses[..., 3])


def wrapped(angle, period):
    return (angle + period / 2) % period - period / 2


def tilt_of(poses):
    return np.arccos(np.clip(1.0 - 2.0 * (poses[..., 4] ** 2 + poses[..., 5] ** 2), -1.0, 1.0))


def action(start, goal, *, offset=(0.0, 0.0)):
    """Bring a cube from pose `start` to pose `goal`, picked `offset` metres beside its centre, in its own axes."""
    turn = wrapped(yaw_of(goal) - yaw_of(start), np.pi / 2)
    points = []
    for center, yaw in ((start, yaw_of(start)), (goal, yaw_of(start) + turn)):
        c, s = np.cos(yaw), np.sin(yaw)
        points.append(center[:3] + [c * offset[0] - s * offset[1], s * offset[0] + c * offset[1], CUBE / 2])
    return types.PickPlace(pick=points[0], place=points[1], yaw=turn)


def build(world, offset=(0.006, -0.008)):
    actions, states = [], [world.poses()]
    for i in range(3):
        actions.append(action(world.poses()[i], scene().goal[i], offset=offset))
        outcome = world.step(actions[-1])
        assert outcome.ok, outcome
        assert outcome.object == i
        assert outcome.held_to_place
        states.append(world.poses())
    return actions, states


def test_perfect_actions_build_a_tower_that_stays(world):
    build(world)
    poses, goal = world.poses(), scene().goal
    assert np.linalg.norm(poses[:, :2] - goal[:, :2], axis=-1).max() < 1e-3
    assert np.abs(poses[:, 2] - goal[:, 2]).max() < 2e-4
    assert np.abs(wrapped(yaw_of(poses) - yaw_of(goal), np.pi / 2)).max() < np.deg2rad(0.5)
    assert tilt_of(poses).max() < np.deg2rad(0.5)
    awake(world)
    mujoco.mj_step(world.model, world.data, round(10.0 / world.model.opt.timestep))
    np.testing.assert_allclose(world.poses(), poses, atol=1e-5)


def awake(world):
    """Simulate at all times what rests as well."""
    world.model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    world.reset(world.poses())


@pytest.mark.parametrize("over", [0.0, 0.024, 0.029])  # metres along x off the middle of the cube below, whose edge is at 0.026
def test_what_sleeps_does_as_it_does_awake(world, monkeypatch, over):
    """It wakes when it is picked, put something on, and knocked over; most of the time all sleeps but the arm and what it holds."""
    other, counts = physics.World(task(), scene()), []
    awake(other)
    real = mujoco.mj_step
    monkeypatch.setattr(mujoco, "mj_step", lambda model, data, n=1: [real(model, data, n), counts.append(data.ntree_awake)][0])
    places = [scene().goal[0], scene().goal[1] + [over, *[0.0] * 6], pose(0.45, 0.3, CUBE / 2, 0.2)]
    for i, place in enumerate(places):
        done = action(world.poses()[i], place)
        counts.clear()
        mine = world.step(done)
        assert np.median(counts) <= 2 and max(counts) >= 2, counts
        theirs = other.step(done)
        assert mine.ok and (mine.object, mine.reason) == (theirs.object, theirs.reason) and abs(mine.seconds - theirs.seconds) < 0.05
        np.testing.assert_allclose(world.poses(), other.poses(), atol=5e-4 if over < 0.026 else 1e-2)  # no fall is like another
    fallen = tilt_of(world.poses()).max() > 0.1 or np.abs(world.poses()[1, 2] - scene().goal[1, 2]) > 0.01
    assert fallen == (over > 0.026)


def test_an_action_is_a_function_of_the_poses_bit_for_bit(world):
    actions, states = build(world)
    other = physics.World(task(), scene())
    for i in (2, 0, 1):
        other.reset(states[i])
        other.step(actions[i])
        np.testing.assert_array_equal(other.poses(), states[i + 1])


def test_outcomes_do_not_depend_on_the_number_of_threads():
    results = []
    for threads in (1, 2):
        worlds = physics.Worlds([physics.World(task(), scene()) for _ in range(3)], threads=threads)
        actions = [action(scene().start[i], scene().goal[0]) for i in range(2)]
        results.append((worlds.step([*actions, None]), [world.poses() for world in worlds.worlds]))
    assert results[0][0] == results[1][0]
    assert results[0][0][2] is None
    np.testing.assert_array_equal(results[0][1], results[1][1])
    np.testing.assert_array_equal(results[0][1][2], scene().start)


def disturbed(monkeypatch, disturb):
    """Do something to the data before each of MuJoCo's steps, told which one it is."""
    real, number = mujoco.mj_step, itertools.count()

    def step(model, data, count=1):
        disturb(next(number), data)
        real(model, data, count)

    monkeypatch.setattr(mujoco, "mj_step", step)


@pytest.mark.parametrize("speed", [np.nan, 1e11, 1e8, 1e5])
@pytest.mark.parametrize("when", [20, 300, 520])
def test_what_diverges_is_undone_and_said(world, monkeypatch, tmp_path, when, speed):
    """On the way there, with a cube in hand, and after it: an outcome, not an exception, and the next action is as if nothing had been."""
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log
    done = action(world.poses()[0], scene().goal[0])
    with monkeypatch.context() as patch:
        disturbed(patch, lambda number, data: number == when and data.qvel.__setitem__(slice(-18, None), speed))
        outcome = world.step(done)
    assert outcome.reason == "unstable" and not outcome.held_to_place and outcome.seconds >= 0
    np.testing.assert_allclose(world.poses(), scene().start, atol=1e-12)
    assert world.step(done).ok


def test_what_does_not_come_to_rest_is_stopped(world, monkeypatch):
    """A cube that turns and turns: two seconds more, then it is where it is."""
    usual = physics.World(task(), scene()).step(action(scene().start[0], scene().goal[0]))
    disturbed(monkeypatch, lambda number, data: data.qvel.__setitem__(world._free_speed[2, 5], 30.0))
    outcome = world.step(action(scene().start[0], scene().goal[0]))
    assert outcome.ok and usual.seconds + 1.0 < outcome.seconds < usual.seconds + physics._MAX_SETTLE + 0.1
    assert not np.allclose(world.poses()[2], scene().start[2], atol=1e-2)


def test_worlds_take_the_cores_that_are_theirs(monkeypatch):
    """Not those of the machine, nor those of the one where a config was written."""
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 6}, raising=False)
    assert [physics.Worlds([], threads=threads)._threads for threads in (0, 2)] == [3, 2]


def test_worlds_refuses_what_cannot_be():
    with pytest.raises(ValueError, match="threads"):
        physics.Worlds([], threads=-1)
    with pytest.raises(ValueError, match="1 worlds, got 0 actions"):
        physics.Worlds([None]).step([])


@pytest.mark.parametrize("yaw", [-3.0, 0.8, 2.5, 2 * np.pi + 0.4])
def test_yaw_turns_the_held_object_about_the_picked_point(world, yaw):
    start, offset = scene().start[2], np.array([0.01, 0.0])  # its yaw is 0
    pick = start[:3] + [*offset, CUBE / 2]
    place = np.array([0.45, 0.0, CUBE])
    assert world.step(types.PickPlace(pick=pick, place=place, yaw=yaw)).ok
    end = world.poses()[2]
    assert abs(wrapped(yaw_of(end) - yaw, 2 * np.pi)) < np.deg2rad(0.5)
    c, s = np.cos(yaw), np.sin(yaw)
    np.testing.assert_allclose(end[:2], place[:2] - offset[0] * np.array([c, s]), atol=1e-3)


def beside(distance):
    """A point on cube 2's top, `distance` metres from its centre along x, an axis of the cube."""
    return scene().start[2][:3] + [distance, 0.0, CUBE / 2]


FREE = np.array([0.45, 0.0, 0.04])


@pytest.mark.parametrize(
    ("pick", "place", "reason"),
    [
        ((0.70, -0.20, 0.0), FREE, "nothing under the tip"),
        ((0.70, -0.20, 0.15), FREE, "nothing under the tip"),  # z is a hint
        ((0.60, 0.25, 0.005), FREE, "nothing under the tip"),  # the stand is no object
        (beside(CUBE / 2 - 0.005), FREE, "tip at an edge"),
        (beside(0.0), (0.80, 0.0, 0.0), "out of the workspace"),
        ((0.2, 0.0, 0.0), FREE, "out of the workspace"),
        (beside(0.0), (0.74, 0.49, 0.28), "out of reach"),
    ],
)
def test_an_action_that_fails_says_why_and_moves_nothing(world, pick, place, reason):
    outcome = world.step(types.PickPlace(pick=np.array(pick), place=np.array(place), yaw=0.0))
    assert (outcome.reason, outcome.object, outcome.held_to_place, outcome.ok) == (reason, -1, False, False)
    assert reason in physics.REASONS
    np.testing.assert_allclose(world.poses(), scene().start, atol=2e-4)


@pytest.mark.parametrize("margin", [0.0, 0.002])
def test_the_cup_needs_its_radius_of_face(world, margin):
    near = CUBE / 2 - suction.CUP_RADIUS - 5e-4  # half a millimetre for the arm's error
    assert world.step(types.PickPlace(pick=beside(near - margin), place=FREE, yaw=0.0)).ok
    world.reset(scene().start)
    far = near + 1e-3 + margin
    assert world.step(types.PickPlace(pick=beside(far), place=FREE, yaw=0.0)).reason == "tip at an edge"


def test_descent_is_sensed_by_contact(world):
    start = scene().start
    place = np.append(start[0][:2], 0.0)  # on top of cube 0, though the hint says the table
    assert world.step(types.PickPlace(pick=beside(0.0), place=place, yaw=0.0)).ok
    np.testing.assert_allclose(world.poses()[2][:3], [*start[0][:2], 1.5 * CUBE], atol=1e-3)


def test_a_weak_cup_loses_its_object(world, monkeypatch):
    monkeypatch.setattr(suction, "HOLDING_FORCE", 0.01)
    outcome = world.step(types.PickPlace(pick=beside(0.0), place=FREE, yaw=0.0))
    assert (outcome.reason, outcome.object, outcome.held_to_place) == ("lost on the way", 2, False)


def test_a_blocked_arm_gives_up(world, monkeypatch):
    monkeypatch.setattr(physics, "_BLOCKED", 1e-5)
    outcome = world.step(types.PickPlace(pick=beside(0.0), place=FREE, yaw=0.0))
    assert outcome.reason == "blocked"
    np.testing.assert_allclose(world.poses(), scene().start, atol=2e-4)


def test_every_action_ends_with_the_arm_at_home_and_at_rest(world):
    world.step(action(scene().start[0], scene().goal[0]))
    arm = robot.Arm(world.model)
    np.testing.assert_array_equal(world.data.qpos[arm.qpos], robot.HOME)
    assert not world.data.qvel.any()
    assert not world.data.eq_active.any()


@pytest.mark.parametrize("field", ["pick", "place", "yaw"])
def test_an_action_that_is_not_finite_is_refused_by_name(world, field):
    values = {"pick": beside(0.0), "place": FREE, "yaw": 0.0}
    values[field] = values[field] * np.nan
    with pytest.raises(ValueError, match=f"PickPlace.{field}"):
        world.step(types.PickPlace(**values))
    with pytest.raises(ValueError, match="poses must be finite"):
        world.reset(np.zeros((2, 7)))


def test_attaching_does_not_move_the_object(world):
    suction.attach(world.model, world.data, 1)
    mujoco.mj_forward(world.model, world.data)
    rows = world.data.efc_pos[: world.data.ne]
    assert world.data.ne == 6
    np.testing.assert_allclose(rows, 0.0, atol=1e-6)
    suction.detach(world.model, world.data, 1)
    mujoco.mj_forward(world.model, world.data)
    assert world.data.ne == 0


def test_gap_below_is_the_drop_that_a_ray_measures(world):
    poses = scene().start.copy()
    poses[0] = pose(0.55, -0.25, 0.2, 0.4)  # above cube 1
    world.reset(poses)
    moving = world.model.geom_bodyid == world.model.body("object0").id
    own = np.zeros(world.model.ngeom, bool)
    ray = mujoco.mj_ray(world.model, world.data, poses[0][:3], np.array([0, 0, -1.0]), None, 1, world.model.body("object0").id, None)
    np.testing.assert_allclose(suction.gap_below(world.model, world.data, moving, own), ray - CUBE / 2, atol=1e-9)
    poses[0] = pose(0.60, -0.30, 0.2, 0.4)  # beside it: bounding circles overlap, the squares do not
    poses[1] = pose(0.56, -0.26, CUBE / 2, np.pi / 4)
    poses[0][3:] = pose(0, 0, 0, np.pi / 4)[3:]
    world.reset(poses)
    np.testing.assert_allclose(suction.gap_below(world.model, world.data, moving, own), 0.2 - CUBE / 2, atol=1e-9)
