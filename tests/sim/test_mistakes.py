"""Mistakes: each kind is what it says, none is right by accident, and without them the oracle is itself."""

import numpy as np
import pytest
from sim.test_oracle import carried, under
from sim.test_tasks import DISTRACTED

from lala_jax.perception import transforms
from lala_jax.sim import mistakes, oracle, tasks


def half_built(name, seed, **options):
    """A scene with up to two objects that rest on nothing else at their goals."""
    task = tasks.get(name, **options)
    scene = task.sample(seed)
    poses = np.asarray(scene.start, float)
    for index in np.flatnonzero(oracle.ready(task, scene, poses))[:2]:
        poses[index] = scene.goal[index]
    return task, scene, poses


@pytest.mark.parametrize("name", DISTRACTED)
def test_every_mistake_is_of_its_kind_and_wrong(name):
    seen = set()
    for seed in range(20):
        task, scene, poses = half_built(name, seed, distractors=1)
        before, goal = oracle.placed(task, scene, poses), np.asarray(scene.goal, float)
        for index in np.flatnonzero(oracle.ready(task, scene, poses)):
            kinds = mistakes.possible(task, scene, poses, int(index), np.random.default_rng(seed))
            seen |= set(kinds)
            for kind, moves in kinds.items():
                assert moves
                for moved, pose in moves:
                    after = poses.copy()
                    after[moved] = pose
                    placed = oracle.placed(task, scene, after)
                    assert not (placed & ~before).any() and (placed[before].all())
                    assert (moved == index) == (kind != "another")
                    offset = np.linalg.norm(pose[:2] - goal[index, :2])
                    turn = np.abs(transforms.wrap_angle(transforms.yaw_from_quat(pose[3:]) - transforms.yaw_from_quat(goal[index, 3:])))
                    if kind == "turned":
                        assert offset == 0 and turn == pytest.approx(np.pi / 2) and scene.size[index, 0] != scene.size[index, 1]
                    elif kind == "beside":
                        assert 0.02 - 1e-9 <= offset <= 0.06 + 1e-9 and turn == 0
                    elif kind == "elsewhere":
                        target = int(np.flatnonzero((goal == pose).all(-1))[0])
                        free = oracle.ready(task, scene, poses)
                        assert target != index and free[target]
                    else:
                        assert (pose == goal[index]).all() and not (before & oracle.wanted(scene))[moved]
    kinds = {"tower": {"beside", "another"}, "pallet": {"turned", "beside", "elsewhere", "another"}}
    assert seen == kinds.get(name, seen) != set()


def test_what_would_topple_is_told():
    """A cube half over an edge, one beside the tower, one on it; the stand's height counts."""
    task = tasks.get("tower", num_objects=3)
    scene = task.sample(1)
    poses = np.asarray(scene.start, float)
    poses[:2] = scene.goal[:2]
    along = transforms.rotate(np.asarray(scene.base[3:], float), np.array([1.0, 0.0, 0.0]))
    expected = {0.0: True, 0.012: True, 0.018: False, 0.025: False, 0.038: False, 0.042: False, 0.0455: True}
    for shift, stable in expected.items():
        pose = np.asarray(scene.goal[2], float)
        pose[:3] += shift * along
        assert mistakes.stands(task, scene, poses, 2, pose) == stable, shift


@pytest.mark.parametrize("name", tasks.names())
def test_a_share_of_none_is_the_oracle_and_a_share_of_all_is_always_wrong(name):
    task, scene, poses = half_built(name, 5)
    for seed in range(10):
        rngs = [np.random.default_rng(seed) for _ in range(3)]
        expected, same = oracle.act(task, scene, poses, rngs[0]), mistakes.act(task, scene, poses, rngs[1], rngs[2], share=0.0)
        for field in ("pick", "place", "yaw"):
            np.testing.assert_array_equal(getattr(same, field), getattr(expected, field))
        spoiled = mistakes.act(task, scene, poses, np.random.default_rng(seed), rngs[2], share=1.0)
        after = carried(poses, under(scene, poses, spoiled.pick), spoiled)
        assert (after != poses).any() and not (oracle.placed(task, scene, after) & ~oracle.placed(task, scene, poses)).any()
    done = np.asarray(scene.goal, float)
    assert mistakes.act(task, scene, done, *rngs[:2], share=1.0) is None
