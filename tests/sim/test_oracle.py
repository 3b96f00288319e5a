"""The oracle: its score, its actions and its ways out of a muddle; perfect in a world of perfect moves and through the real primitive."""

from __future__ import annotations

import numpy as np
import pytest
from sim.test_tasks import DISTRACTED

from lala_jax.perception import transforms
from lala_jax.sim import oracle, physics, tasks


@pytest.fixture(scope="module", params=tasks.names())
def task(request):
    return tasks.get(request.param)


def carried(poses, index, action):
    """Object `index` moved rigidly as the action says: about the picked point."""
    turn = transforms.pose_from_yaw(np.zeros(3), float(action.yaw))
    about = transforms.pose_multiply(turn, transforms.pose_from(poses[index, :3] - action.pick, poses[index, 3:]))
    out = poses.copy()
    out[index] = transforms.pose_from(about[:3] + action.place, about[3:])
    return out


def under(scene, poses, pick):
    """The object whose top face holds the picked point."""
    top = poses[:, 2] + scene.size[:, 2] / 2
    local = transforms.apply_pose(transforms.pose_inverse(poses), np.asarray(pick, float))
    hit = (np.abs(local[:, :2]) <= scene.size[:, :2] / 2).all(-1) & (np.abs(top - pick[2]) < 1e-3)
    assert hit.sum() == 1
    return int(np.flatnonzero(hit)[0])


def run(task, scene, poses, choose, rng, budget=30):
    """Carry out chosen actions perfectly until there are none; give the final poses and their number."""
    for count in range(budget):
        action = choose(task, scene, poses, rng)
        if action is None:
            return poses, count
        poses = carried(poses, under(scene, poses, action.pick), action)
    return poses, budget


def start(scene):
    return np.asarray(scene.start, float)


def goal(scene):
    return np.asarray(scene.goal, float)


@pytest.mark.parametrize(
    ("change", "is_placed"),
    [
        ((0.0099, 0, 0, 0), True),
        ((0.0101, 0, 0, 0), False),
        ((0.008, 0.008, 0, 0), False),
        ((0, 0, -0.0099, 0), True),
        ((0, 0, 0.0101, 0), False),
        ((0, 0, 0, 14.9), True),
        ((0, 0, 0, -15.1), False),
        ((0, 0, 0, 90 - 14.9), True),
        ((0, 0, 0, 180 + 14.9), True),
        ((0, 0, 0, 45), False),
    ],
)
def test_tolerances_of_the_score(change, is_placed):
    task = tasks.get("tower")
    scene = task.sample(11)
    poses = goal(scene)
    yaw = transforms.yaw_from_quat(poses[2, 3:]) + np.deg2rad(change[3])
    poses[2] = transforms.pose_from_yaw(poses[2, :3] + change[:3], yaw)
    assert oracle.placed(task, scene, poses).tolist() == [True, True, is_placed, True, True]
    assert oracle.score(task, scene, poses) == (100.0 if is_placed else 80.0)
    assert oracle.done(task, scene, poses) == is_placed


def test_a_long_box_may_be_turned_by_half_a_turn_only():
    task = tasks.get("pallet")
    scene = next(s for s in (task.sample(seed) for seed in range(9)) if s.symmetry[0] > 3)
    for turn, expected in ((np.pi, True), (np.pi / 2, False)):
        poses = goal(scene)
        poses[0] = transforms.pose_from_yaw(poses[0, :3], turn)
        assert oracle.placed(task, scene, poses)[0] == expected


def test_a_tilted_object_is_not_placed(task):
    scene = task.sample(0)
    poses = goal(scene)
    for degrees, expected in ((10, True), (20, False)):
        half = np.deg2rad(degrees) / 2
        tilt = np.array([0, 0, 0, np.cos(half), np.sin(half), 0, 0])
        tilted = poses.copy()
        tilted[0] = transforms.pose_multiply(poses[0], tilt)
        assert oracle.placed(task, scene, tilted)[0] == expected


def test_a_tower_in_the_wrong_order_scores_what_stands_right():
    task = tasks.get("tower")
    scene = task.sample(2)
    poses = goal(scene)[[0, 3, 2, 1, 4]]
    assert oracle.score(task, scene, poses) == 60.0


def test_only_what_is_supported_is_ready_at_the_start(task):
    for seed in range(6):
        scene = task.sample(seed)
        np.testing.assert_array_equal(oracle.ready(task, scene, start(scene)), ~task.supports(scene).any(-1))
    assert not oracle.ready(task, scene, goal(scene)).any()


def test_no_action_when_complete(task):
    scene = task.sample(0)
    assert oracle.act(task, scene, goal(scene), np.random.default_rng(0)) is None


def test_the_oracle_needs_one_perfect_move_an_object(task):
    for seed in range(8):
        scene = task.sample(seed)
        poses, count = run(task, scene, start(scene), oracle.act, np.random.default_rng(seed))
        assert oracle.score(task, scene, poses) == 100.0 and count == task.num_objects


def test_the_oracle_turns_as_little_as_the_symmetry_allows(task):
    scene = task.sample(1)
    for seed in range(5):
        action = oracle.act(task, scene, start(scene), np.random.default_rng(seed))
        assert abs(action.yaw) <= scene.symmetry[under(scene, start(scene), action.pick)] / 2 + 1e-6


def test_a_scrambled_goal_is_taken_apart_and_built_again():
    task = tasks.get("tower")
    scene = task.sample(9)
    poses = goal(scene)[[3, 1, 0, 2, 4]]
    assert not oracle.ready(task, scene, poses).any()
    assert oracle.blockers(task, scene, poses).tolist() == [False, False, False, False, True]
    poses, count = run(task, scene, poses, oracle.act, np.random.default_rng(0))
    assert oracle.score(task, scene, poses) == 100.0 and count <= 10


def test_swapped_boxes_are_parked_and_put_right():
    task = tasks.get("pallet", colors="code")
    scene = task.sample(5)
    lower = np.flatnonzero(scene.goal[:, 2] < 0.08)
    poses = start(scene)
    poses[lower[:2]] = goal(scene)[lower[[1, 0]]]
    poses, count = run(task, scene, poses, oracle.act, np.random.default_rng(0))
    assert oracle.score(task, scene, poses) == 100.0 and count <= 10


def test_a_placed_box_that_crowds_its_neighbour_is_put_again():
    task = tasks.get("pallet")
    scene = task.sample(5)
    poses, last = goal(scene), int(np.flatnonzero(~task.supports(scene).any(0))[0])
    distance = np.linalg.norm(poses[:, :2] - poses[last, :2], axis=-1) + (np.abs(poses[:, 2] - poses[last, 2]) > 0.01)
    neighbour = int(np.argsort(distance)[1])
    poses[last] = start(scene)[last]
    # Turned within the tolerance and shifted towards the free place, its corner stands where the last box belongs.
    towards = goal(scene)[last, :2] - poses[neighbour, :2]
    shift = 0.0099 * np.sign(towards) * (np.abs(towards) == np.abs(towards).max())
    poses[neighbour] = transforms.pose_from_yaw(poses[neighbour, :3] + [*shift, 0], np.deg2rad(14))
    assert oracle.placed(task, scene, poses)[neighbour]
    assert oracle.blockers(task, scene, poses)[neighbour] and not oracle.ready(task, scene, poses).any()
    poses, count = run(task, scene, poses, oracle.act, np.random.default_rng(0))
    assert oracle.score(task, scene, poses) == 100.0 and count == 2


def test_what_lies_outside_the_workspace_is_given_up(task):
    scene = task.sample(0)
    poses = goal(scene)
    last = int(np.flatnonzero(~task.supports(scene).any(0))[0])
    poses[last, :3] = [1.2, 0.0, scene.size[last, 2] / 2]
    assert oracle.act(task, scene, poses, np.random.default_rng(0)) is None


def test_parking_is_clear_of_everything(task):
    scene = task.sample(3)
    poses = start(scene)
    spot = oracle.parking(task, scene, poses, 0, np.random.default_rng(0))
    others = np.concatenate([poses[1:, :2], scene.goal[:, :2]])
    radius = np.hypot(*scene.size[0, :2]) / 2
    assert spot[2] == pytest.approx(scene.size[0, 2] / 2)
    assert np.linalg.norm(others - spot[:2], axis=-1).min() > scene.size[0, :2].min() / 2 + 0.015
    assert (np.abs(spot[:2] - [0.5, 0.0]) < np.array([0.25, 0.5]) - radius / np.sqrt(2)).all()


def test_blind_scores_what_chance_gives():
    task = tasks.get("tower", num_objects=3)
    scores = []
    for seed in range(45):
        scene = task.sample(seed % 9)
        poses, count = run(task, scene, start(scene), oracle.blind, np.random.default_rng(seed))
        scores.append(oracle.score(task, scene, poses))
        assert count == 3
    # One block in three is right by chance; 0.33 +- 4 standard errors of the number of fixed points, whose variance is 1.
    assert np.mean(scores) == pytest.approx(100 / 3, abs=4 * 100 / 3 / np.sqrt(45))


def test_blind_fills_the_pallet():
    task = tasks.get("pallet")
    scene = task.sample(1)
    poses, count = run(task, scene, start(scene), oracle.blind, np.random.default_rng(3))
    assert count == 8
    np.testing.assert_allclose(np.sort(poses[:, 0]), np.sort(scene.goal[:, 0]), atol=1e-5)
    assert oracle.score(task, scene, poses) < 100.0


@pytest.mark.parametrize(("name", "seen"), [("tower", 1), ("pallet", 4)])
def test_the_view_from_above_places_what_it_sees_and_deals_the_rest(name, seen):
    """The top of the tower, the upper layer of the pallet; of the hidden ones, one is right by chance."""
    task, hidden, wrong = tasks.get(name), [], set()
    for seed in range(24):
        scene = task.sample(seed % 6)
        top = goal(scene)[:, 2] > goal(scene)[:, 2].max() - 0.01
        assert top.sum() == seen
        poses, count = run(task, scene, start(scene), oracle.top_view, np.random.default_rng(seed))
        assert count == task.num_objects
        off = np.linalg.norm(poses[:, :3] - goal(scene)[:, :3], axis=-1)
        np.testing.assert_allclose(off[top], 0.0, atol=1e-5)
        hidden.append((off[~top] < 1e-5).sum())
        wrong |= {seed} if hidden[-1] < (~top).sum() else set()
    # The number of fixed points of a random order has mean 1 and variance 1.
    assert np.mean(hidden) == pytest.approx(1.0, abs=4 / np.sqrt(24)) and len(wrong) > 12


@pytest.mark.parametrize("name", DISTRACTED)
def test_distractors_never_count_and_are_never_ready(name):
    plain, task = tasks.get(name), tasks.get(name, distractors=2)
    scene, bare, count = task.sample(4), plain.sample(4), plain.num_objects
    assert oracle.wanted(scene).tolist() == [True] * count + [False] * 2 and oracle.wanted(bare).all()
    done = np.concatenate([goal(scene)[:count], start(scene)[count:]])
    for poses in (start(scene), done, np.concatenate([start(scene)[:2], done[2:]])):
        np.testing.assert_array_equal(oracle.ready(task, scene, poses), [*oracle.ready(plain, bare, poses[:count]), False, False])
        assert oracle.score(task, scene, poses) == oracle.score(plain, bare, poses[:count])
    assert oracle.done(task, scene, done) and oracle.act(task, scene, done, np.random.default_rng(0)) is None
    poses, actions = run(task, scene, start(scene), oracle.act, np.random.default_rng(0))
    assert oracle.score(task, scene, poses) == 100.0 and actions == count
    np.testing.assert_array_equal(poses[count:], start(scene)[count:])


@pytest.mark.parametrize("name", DISTRACTED)
def test_a_distractor_in_the_way_is_parked(name):
    task = tasks.get(name, distractors=2)
    scene = task.sample(4)
    first = int(np.flatnonzero(~task.supports(scene).any(-1))[0])
    poses = start(scene)
    top = scene.base[2] + task.base_size[2] / 2
    poses[-1] = [*goal(scene)[first, :2], top + scene.size[-1, 2] / 2, 1, 0, 0, 0]
    assert not oracle.ready(task, scene, poses)[[first, -1]].any()
    after, _ = run(task, scene, poses, oracle.act, np.random.default_rng(0))
    assert oracle.score(task, scene, after) == 100.0
    assert after[-1, 2] == pytest.approx(scene.size[-1, 2] / 2) and np.linalg.norm(after[-1, :2] - poses[-1, :2]) > 0.04
    np.testing.assert_array_equal(after[-2], poses[-2])


def test_blind_takes_distractors_too_but_puts_nothing_where_they_belong():
    task, taken = tasks.get("tower", num_objects=2, distractors=2), 0
    scene = task.sample(1)
    for seed in range(20):
        poses, count = run(task, scene, start(scene), oracle.blind, np.random.default_rng(seed))
        levels = np.sort(poses[np.linalg.norm(poses[:, :2] - scene.base[:2], axis=-1) < 1e-5, 2])
        np.testing.assert_allclose(levels, goal(scene)[:2, 2], atol=1e-5)
        assert count == 2
        taken += int((poses[2:] != start(scene)[2:]).any(-1).sum())
    assert 8 < taken < 32  # one in two, 20 on average


@pytest.mark.parametrize("seed", [0, 1])
def test_the_oracle_scores_100_through_the_real_primitive(task, seed):
    scene, rng = task.sample(seed), np.random.default_rng(seed)
    world = physics.World(task, scene)
    for _ in range(task.budget):
        action = oracle.act(task, scene, world.poses(), rng)
        if action is None:
            break
        assert world.step(action).reason == "ok"
    assert oracle.score(task, scene, world.poses()) == 100.0
