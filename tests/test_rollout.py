"""Closed loop with the real primitive: the oracle solves, the blind agent does not, failures are counted and named."""

import functools
import threading
import time

import jax
import numpy as np
import pytest
from scipy import stats

from lala_jax import build, dataset, defaults, options, recording, rollout, types
from lala_jax.sim import oracle, physics, tasks
from lala_jax.sim.tasks import base, tower


def run(task, seeds, agent=None, **options):
    scenes = [task.sample(seed) for seed in seeds]
    agent = agent or rollout.oracle_agent(task, scenes, seeds)
    return rollout.run(task, scenes, seeds, agent, threads=2, **options)


@pytest.mark.parametrize(("name", "objects"), [("tower", 3), ("pallet", 8)])
def test_oracle_scores_100(name, objects):
    task = tasks.get(name, num_objects=objects)
    episodes = run(task, [0, 2])
    summed = rollout.summary(episodes)
    assert summed["score"] == 100 and summed["complete_percent"] == 100
    assert summed["actions"] == 2 * objects == summed["actions_by_cause"]["right"]
    for episode in episodes:
        assert len(episode.poses) == len(episode.actions) + 1
        assert episode.ready[0].any() and not episode.ready[-1].any()


def test_demo_is_the_episode():
    task = tasks.get("tower", num_objects=2)
    episode = run(task, [4])[0]
    demo = episode.demo()
    assert demo.poses.shape == (3, 2, 7) and demo.placed[-1].all() and demo.score == 100
    np.testing.assert_array_equal(demo.poses[0], np.asarray(episode.poses[0], np.float32))
    np.testing.assert_allclose(demo.action.place[:, 2] > 0, True)


def test_threads_change_nothing():
    task = tasks.get("tower", num_objects=2)
    one, two = (recording.demonstrate(task, [0, 2, 4], threads=threads) for threads in (1, 2))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a.poses, b.poses)


def same(a, b):
    return all(x.tobytes() == y.tobytes() for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def test_without_mistakes_demonstrations_are_the_oracles():
    task, seeds = tasks.get("tower", num_objects=3), [0, 2, 4]
    demos = recording.demonstrate(task, seeds, threads=2)
    assert len(demos) == 3 and all(same(demo, episode.demo()) for demo, episode in zip(demos, run(task, seeds), strict=True))


def test_spoiled_actions_lengthen_demonstrations_but_teach_nothing():
    """They reach the goal all the same, and the states they lead to are labelled by the poses alone."""
    task, seeds = tasks.get("pallet"), [0, 2, 4, 6]
    one, two = (recording.demonstrate(task, seeds, threads=threads, mistakes=0.3) for threads in (1, 2))
    assert len(one) >= 2 and all(same(a, b) for a, b in zip(one, two, strict=True))
    assert sum(len(demo.action.yaw) for demo in one) >= 8 * len(one) + 3
    for demo in one:
        assert demo.score == 100 and demo.placed[-1].all()
        for t, poses in enumerate(demo.poses):
            np.testing.assert_array_equal(demo.ready[t], oracle.ready(task, demo.scene, poses))
            np.testing.assert_array_equal(demo.placed[t], oracle.placed(task, demo.scene, poses))
    foreign = [
        demo.replace(action=jax.tree.map(lambda leaf: np.full_like(leaf, 9), demo.action)) for demo in one
    ]  # other actions, same lessons
    assert same(dataset.stack(one), dataset.stack(foreign))


def test_what_is_recorded_is_told_apart_and_older_recordings_still_read():
    config = defaults.get("", task="tower")
    assert build.task_options(config) == {"num_objects": 5, "colors": "paper"}
    config.task.distractors, config.data.mistakes = 2, 0.25
    assert build.task_options(config) == {"num_objects": 5, "colors": "paper", "distractors": 2, "mistakes": 0.25}
    assert build.task(config).distractors == 2
    old = config.to_dict()
    del old["task"]["distractors"], old["data"]["mistakes"]
    assert build.task_options(old) == {"num_objects": 5, "colors": "paper"}
    config.data.mistakes = 1.0
    with pytest.raises(options.OptionsError, match="data.mistakes must be at least 0 and below 1, got 1.0"):
        build.task_options(config)
    config.data.mistakes, config.task.colors = 0.0, "uniform"
    assert build.task(config).colors == "uniform"
    config.task.distractors = 20
    with pytest.raises(options.OptionsError, match="distractors=20"):
        build.task(config)


def test_a_distractor_is_the_wrong_object_and_scores_nothing():
    task = tasks.get("tower", num_objects=1, distractors=1)
    scene = task.sample(0)
    lift = np.array([0, 0, 0.02], np.float32)
    spot = oracle.parking(task, scene, scene.start, 1, np.random.default_rng(0))[:3]
    action = types.PickPlace(pick=scene.start[1, :3] + lift, place=np.float32(spot + lift), yaw=np.float32(0))
    episode = run(task, [0], constant(action), max_actions=1)[0]
    assert episode.causes == ["wrong object"] and episode.score == 0 and not episode.complete
    assert np.linalg.norm(episode.poses[1][1, :2] - spot[:2]) < 0.01
    solved = run(task, [0])[0]
    assert solved.score == 100 and solved.complete and solved.causes == ["right"]


def constant(action):
    return lambda indices, poses: [action for _ in indices]


@pytest.mark.parametrize(
    ("pick", "reason"),
    [((0.3, 0.45, 0.0), "nothing under the tip"), ((1.4, 0.0, 0.0), "out of the workspace")],
)
def test_a_failing_pick_is_counted(pick, reason):
    task = tasks.get("tower", num_objects=1)
    scene = task.sample(0)
    assert np.linalg.norm(scene.start[0, :2] - np.array(pick[:2])) > 0.06
    action = types.PickPlace(pick=np.array(pick, np.float32), place=np.array([0.5, 0.0, 0.0], np.float32), yaw=np.float32(0))
    summed = rollout.summary(run(task, [0], constant(action), max_actions=2))
    assert summed["score"] == 0 and summed["actions_by_cause"]["missed pick"] == 2
    assert summed["failures_by_reason"] == {reason: 2}


def test_giving_up_ends_the_episode():
    task = tasks.get("tower", num_objects=2)
    episode = run(task, [0], constant(None))[0]
    assert not episode.actions and episode.score == 0
    summed = rollout.summary([episode])  # no action: nothing went wrong first
    assert summed["first_failures"]["none"] == 1 and summed["lost_objects"]["never moved"] == 2


def test_causes_are_told_apart():
    scene = tasks.get("tower", num_objects=2).sample(0)

    def cause(index=0, held=True, ready=(True, False), before=(False, False), after=(False, False), shift=0.0):
        poses = np.array(scene.goal, float)
        poses[:, 0] += shift
        outcome = physics.Outcome(object=index, held_to_place=held, reason="ok", seconds=1.0)
        return rollout.cause(scene, *(np.array(value) for value in (ready, before, after)), poses, outcome)

    assert cause(index=-1) == "missed pick"
    assert cause(held=False) == "lost on the way"
    assert cause(after=(True, False)) == "right"
    assert cause(index=1) == "wrong object"
    assert cause(before=(False, True)) == "knocked over"
    assert cause(before=(True, False)) == "wrong object"  # it was in place already
    assert cause(shift=0.03) == "wrong place"
    assert cause(shift=0.0) == "wrong height"


def test_interval_is_the_normal_one():
    task = tasks.get("tower", num_objects=1)
    episodes = run(task, [0, 2, 4], constant(None))
    for episode, placed in zip(episodes, (True, False, False), strict=True):
        episode.placed[-1] = np.array([placed])
    summed = rollout.summary(episodes)
    half = 1.96 * np.std([100, 0, 0], ddof=1) / np.sqrt(3)
    np.testing.assert_allclose(summed["interval95"], [0.0, min(100, 100 / 3 + half)])


@pytest.mark.parametrize(("same", "successes"), [(0.0, 0), (100.0, 9)])
def test_interval_of_nothing_but_zeros_or_hundreds_is_clopper_and_pearsons(same, successes):
    exact = stats.binomtest(successes, 9).proportion_ci(method="exact")
    np.testing.assert_allclose(rollout.interval([same] * 9), [100 * exact.low, 100 * exact.high])


def test_interval_of_equal_scores_has_the_means_under_which_they_are_not_too_unlikely():
    same, count = 100 / 3, 7  # a third has no exact float
    others = np.concatenate([np.linspace(0, same - 1, 50), np.linspace(same + 1, 100, 50)])

    def chance(mean):
        """The greatest over distributions on `same` and one other score, all with this mean."""
        share = (mean - others) / (same - others)
        return np.max(share[(share >= 0) & (share <= 1)]) ** count

    low, high = rollout.interval([same] * count)
    assert chance(low - 0.01) < 0.025 < chance(low + 0.01)
    assert chance(high + 0.01) < 0.025 < chance(high - 0.01)


def told(scene, *actions):
    """An episode by hand: each action is `(cause, picked object, poses after, placed after)`, None for what stays as it was."""
    count = len(scene.size)
    episode = rollout.Episode(0, scene, [np.array(scene.start, float)], [np.zeros(count, bool)], [np.zeros(count, bool)], [], [], [])
    for cause, index, poses, placed in actions:
        episode.causes.append(cause)
        episode.actions.append(types.PickPlace(pick=np.zeros(3), place=np.zeros(3), yaw=np.zeros(())))
        episode.outcomes.append(physics.Outcome(object=index, held_to_place=index >= 0, reason="ok", seconds=1.0))
        episode.poses.append(episode.poses[-1] if poses is None else poses)
        episode.placed.append(episode.placed[-1] if placed is None else np.array(placed))
        episode.ready.append(np.zeros(count, bool))
    return episode


def moved(poses, index, distance):
    poses = np.array(poses, float)
    poses[index, 0] += distance
    return poses


def test_what_first_went_wrong_and_what_became_of_each_object():
    scene = tasks.get("tower", num_objects=3).sample(0)
    start = np.array(scene.start, float)
    first = moved(start, 0, 0.2)
    episodes = [
        # right, then knocked over by the second action; the third object is only pushed a little
        told(
            scene,
            ("right", 0, first, [True, False, False]),
            ("knocked over", 1, moved(moved(first, 0, 0.001), 2, 0.005), [False, False, False]),
            ("missed pick", -1, None, None),
        ),
        # the third object is shoved aside by an action that is otherwise right; the second is tried twice
        told(
            scene,
            ("right", 0, moved(first, 2, 0.02), [True, False, False]),
            ("lost on the way", 1, None, None),
            ("wrong yaw", 1, None, None),
        ),
        told(scene, ("right", 0, first, [True, False, False])),  # gave up
        told(scene, ("wrong place", 0, None, None), ("right", 0, first, [True, True, True])),  # complete in the end
    ]
    assert rollout.lost_objects(episodes[0]) == ["knocked over", "knocked over", "never moved"]
    assert rollout.lost_objects(episodes[1]) == ["wrong yaw", "right"]
    assert rollout.lost_objects(episodes[2]) == ["never moved"] * 2 and rollout.lost_objects(episodes[3]) == []
    summed = rollout.summary(episodes)
    assert {cause: n for cause, n in summed["first_failures"].items() if n} == {"knocked over": 1, "lost on the way": 1, "none": 1}
    assert {cause: n for cause, n in summed["lost_objects"].items() if n} == {
        "knocked over": 2,
        "wrong yaw": 1,
        "right": 1,
        "never moved": 3,
    }
    assert sum(summed["lost_objects"].values()) == sum(int((~e.placed[-1]).sum()) for e in episodes)


def test_a_distractor_is_never_lost():
    scene = tasks.get("tower", num_objects=1, distractors=1).sample(0)
    episode = told(scene, ("wrong object", 1, moved(scene.start, 1, 0.1), [False, True]))
    assert rollout.lost_objects(episode) == ["never moved"]
    assert rollout.summary([episode])["first_failures"]["wrong object"] == 1


def test_two_collections_of_one_directory_take_turns(tmp_path, monkeypatch):
    """Who comes second waits, and finds that nothing is left to do."""
    monkeypatch.setattr(recording, "demonstrate", functools.partial(slowly, recording.demonstrate))
    config = options.load("configs/tower.py:smoke", [f"data.directory={tmp_path / 'd'}", "data.demos=2", "task.num_objects=2"])
    threads = [threading.Thread(target=recording.collect, args=(config,), kwargs={"quiet": True}) for _ in range(2)]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert sorted(dataset.seeds(tmp_path / "d")) == [0, 2]
    assert not list(tmp_path.glob("*.lock"))


def test_a_task_that_the_oracle_cannot_solve_is_given_up(tmp_path, monkeypatch):
    """After some scenes, saying what happened; not after all of them."""
    monkeypatch.setattr(recording, "HOPE", 4)
    monkeypatch.setattr(recording, "SHARD", 2)
    config = options.load("configs/tower.py:smoke", [f"data.directory={tmp_path / 'd'}", "data.demos=5", "task.num_objects=2"])
    with monkeypatch.context() as heavy:
        heavy.setattr(tower.TowerTask, "object_mass", lambda self, scene: np.full(len(scene.size), 5.0))  # more than the cup holds
        told = "the oracle solves none of the first 4 scenes of task tower: in 2 of them it scores 0; its 6 actions were .*lost on the way"
        with pytest.raises(dataset.DatasetError, match=told):
            recording.collect(config, quiet=True)
    crowded = base.NoFreePose("no free pose for object 1")
    monkeypatch.setattr(tower.TowerTask, "build", lambda self, rng: throw(crowded))
    with pytest.raises(dataset.DatasetError, match="the oracle solves none of the first 4 scenes of task tower: no free pose for object 1"):
        recording.collect(config, quiet=True)


def throw(error):
    raise error


def slowly(call, *args, **kwargs):
    time.sleep(0.3)
    return call(*args, **kwargs)
