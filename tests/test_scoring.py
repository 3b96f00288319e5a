"""Closed-loop scores do not depend on how many episodes are observed at once; a checkpoint of another model is refused by name."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_train_step import tiny_config

from lala_jax import build, checkpoint, cluster, options, pictures, pretrained, rollout, scoring, types
from lala_jax.sim import render, scene
from lala_jax.sim.tasks import base

SINGLE = ("model.name=single", "model.stages=1", "model.multi_action=false", "model.max_height=true")
SEEDS = [1, 3, 5]


def drawn_params(agent):
    """Parameters of the size that `init` gives, drawn by numpy: they need not be good, and `init` is slow to compile."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    return jax.tree.map(lambda s: jnp.asarray(rng.normal(0, np.prod(s.shape[:-1]) ** -0.5, s.shape), jnp.float32), shapes)


@pytest.fixture(scope="module")
def built():
    config = tiny_config(*SINGLE)
    agent = build.build_policy(config)
    return agent, drawn_params(agent), build.observer(config)


@pytest.fixture(scope="module")
def alone(built):
    """Every episode observed on its own, with pictures: `(summary, pictures, episodes)`."""
    return scored(built, parallel=1, strips=2)


def scored(built, *, parallel, strips=0):
    episodes, said = [], []
    real = rollout.run

    def run(*args, **options):
        done = real(*args, **options)
        episodes.extend(done)
        return done

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rollout, "run", run)
        summary, drawn = scoring.evaluate(
            *built, seeds=SEEDS, parallel=parallel, threads=1, strips=strips, progress=lambda done, total: said.append((done, total))
        )
    assert said[-1] == (3, 3)
    return summary, drawn, episodes


def crowd(monkeypatch, *crowded):
    """Leave no room in the scenes of some seeds."""
    real = base.Task.sample

    def sample(self, seed):
        if seed in crowded:
            raise base.NoFreePose(f"no free pose in {seed}")
        return real(self, seed)

    monkeypatch.setattr(base.Task, "sample", sample)


def test_scenes_without_room_are_passed_over(built, alone, monkeypatch, tmp_path, capsys):
    """By policies and the oracle alike, the first and the only one of a chunk among them; the others' scores are what they were."""
    crowd(monkeypatch, 1, 5)
    summary, drawn = scoring.evaluate(*built, seeds=SEEDS, parallel=2, threads=1, strips=1)
    assert summary["per_episode"] == [line for line in alone[0]["per_episode"] if line["seed"] == 3] and summary["episodes"] == 1
    config, task = tiny_config(*SINGLE), built[2].task
    assert [line["seed"] for line in scoring.baseline("oracle", task, seeds=SEEDS, threads=1)["per_episode"]] == [3]
    scoring.write_scores(config, summary, {}, tmp_path, agent="policy", split="val", seeds=SEEDS, source=None, weights=None)
    assert "2 of the 3 scenes have no free pose for every object: passed over" in capsys.readouterr().out
    crowd(monkeypatch, *SEEDS)
    with pytest.raises(base.NoFreePose, match="none of the scenes of seeds 1 to 5 has a free pose"):
        scoring.baseline("oracle", task, seeds=SEEDS, threads=1)


@pytest.mark.parametrize("agent", ["policy", "blind"])
def test_workers_pass_over_scenes_as_one_process_does(agent, built, monkeypatch, tmp_path):
    """Also a worker all of whose scenes have no room; it is an error only where all workers' have none."""
    config, task = tiny_config(*SINGLE, "eval.parallel=1"), built[2].task
    monkeypatch.setattr(cluster, "run", lambda launch, tasks, folder: [(task.name, task.call()) for task in tasks])
    monkeypatch.setattr(scoring, "check_checkpoint", lambda *given: built[1])
    monkeypatch.setattr(pretrained, "fingerprint", lambda *given: None)

    def fanned():
        what = {"agent": agent, "path": "", "weights": None, "seeds": SEEDS}
        return scoring.evaluate_in_parts(cluster.Launcher("local", 3), config, tmp_path, **what)[0]

    crowd(monkeypatch, 1)
    if agent == "policy":
        alone, _ = scoring.evaluate(*built, seeds=SEEDS, parallel=1, threads=1)
    else:
        alone = scoring.baseline(agent, task, seeds=SEEDS, threads=1)
    assert alone["episodes"] == 2 and {name: value for name, value in fanned().items() if name != "device"} == alone
    crowd(monkeypatch, *SEEDS)
    with pytest.raises(base.NoFreePose, match="none of the scenes of seeds 1 to 5 has a free pose"):
        fanned()


@pytest.mark.parametrize("parallel", [2, 3])  # 2 leaves an episode over, which is padded
def test_parallel_changes_nothing(built, alone, parallel):
    summary, drawn, episodes = scored(built, parallel=parallel)
    assert summary == alone[0] and drawn == {}
    assert [episode.seed for episode in episodes] == SEEDS
    for one, many in zip(alone[2], episodes, strict=True):
        assert len(one.actions) == len(many.actions) > 0
        for a, b in zip(one.actions, many.actions, strict=True):
            jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-5), a, b)
        np.testing.assert_allclose(one.poses[-1], many.poses[-1], atol=1e-4)


@pytest.mark.parametrize("threads", [2, 3, 9])
def test_episodes_side_by_side_are_as_one_after_another(built, monkeypatch, threads):
    """The same actions and thoughts, by as many calls as there are threads, episodes and places; all of one program."""
    scenes, calls = [built[2].task.sample(seed) for seed in SEEDS], []
    starts = np.stack([one.start for one in scenes])
    one, several = (scoring.PolicyAgent(*built, scenes, parallel=3, threads=n, key=jax.random.key(0)) for n in (1, threads))
    real = scoring.act_batch
    monkeypatch.setattr(scoring, "act_batch", lambda *given: [calls.append(given[-2:]), real(*given)][1])
    for indices, spans in [([0, 1, 2], {2: [(0, 2), (2, 1)]}), ([2, 0], {}), ([1], {})]:
        wanted = one(indices, starts[indices])
        calls.clear()
        jax.tree.map(np.testing.assert_array_equal, several(indices, starts[indices]), wanted)
        assert sorted(calls) == spans.get(threads, [(i, 1) for i in range(len(indices))])
    moments = [(0, starts[0]), (2, starts[2]), (1, starts[1]), (0, scenes[0].goal)]
    for mine, theirs in zip(several.think_again(moments), one.think_again(moments), strict=True):
        jax.tree.map(np.testing.assert_array_equal, mine, theirs)


def test_summary_counts_what_happened(alone):
    summary, _, episodes = alone
    assert summary["episodes"] == 3 and summary["actions"] == sum(len(episode.actions) for episode in episodes)
    assert summary["score"] == np.mean([episode.score for episode in episodes])
    assert sum(summary["actions_by_cause"].values()) == summary["actions"]
    assert [line["seed"] for line in summary["per_episode"]] == SEEDS


def test_strips_are_drawn_for_the_first_episodes_and_the_first_failures(alone):
    """Also where the cameras were calibrated; what failed among the first is drawn once and has both names."""
    _, drawn, episodes = alone
    failed = [i for i, episode in enumerate(episodes) if episode.score < 100][: scoring.FAILURES]
    assert sorted(drawn) == [("episode", 0), ("episode", 1), *(("failure", n) for n in range(len(failed)))]
    for (kind, number), picture in drawn.items():
        episode = episodes[failed[number] if kind == "failure" else number]
        assert picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[-1] == 3
        assert picture.shape[0] > 100 * len(episode.actions) or picture.shape[1] > 100 * len(episode.actions)
        assert np.ptp(picture) > 100


@pytest.mark.parametrize("changes", [("camera.calibrate=false",), ("camera.shift=0.03", "camera.turn=3.0")])
def test_episodes_are_drawn_as_their_own_cameras_saw_them(built, changes):
    """Of a batch of three the second is drawn: its views, its goal, and the thoughts that led to its actions."""
    agent, params, _ = built
    observer = build.observer(tiny_config(*SINGLE, *changes))
    scenes = [observer.task.sample(seed) for seed in SEEDS]
    actor = scoring.PolicyAgent(agent, params, observer, scenes, parallel=3, key=jax.random.key(0))
    episode = rollout.run(observer.task, scenes, SEEDS, actor, threads=1)[1]
    moments = [(1, poses) for poses in episode.poses[:-1]]
    for action, (_, heat) in zip(episode.actions, actor.think_again(moments), strict=True):
        cell = np.unravel_index(np.argmax(heat.pick), heat.pick.shape)
        np.testing.assert_allclose(types.world_from_index(observer.spec, np.array(cell)), action.pick[:2], atol=1e-5)
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "episode_strip", lambda panels, final, goal, caption: seen.append((len(panels), goal)))
        scoring.episode_pictures(actor, {1: episode})
    count, goal = seen[0]
    camera = observer.camera if actor.rig is None else jax.tree.map(lambda leaf: leaf[1], actor.rig.background.camera)
    model, data = scene.geom_template(observer.task)
    told = scenes[1]
    full = render.render(*scene.place(model, data, size=told.size, color=told.color, poses=told.goal, base=told.base), camera)
    assert count == len(episode.actions) and np.mean(np.abs(goal.rgb - full.rgb).max(-1) > 0.02) < 0.01


def test_a_privileged_policy_is_told_where_things_are():
    """Of two episodes at different moments, each is told its own objects; what is placed or may go next is not said."""
    config, told = tiny_config("model.name=graph"), []
    agent, observer = build.build_policy(config), build.observer(config)
    scenes = [observer.task.sample(seed) for seed in SEEDS[:2]]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(agent.model), "apply", lambda self, variables, state: _spied(state, told))
        actor = scoring.PolicyAgent(agent, {}, observer, scenes, parallel=3, key=jax.random.key(0))
        poses = np.stack([scenes[1].goal, scenes[0].start]).astype(np.float32)
        actions = actor([1, 0], poses)
    for action, now, scene_ in zip(actions, poses, scenes[::-1], strict=True):
        np.testing.assert_allclose(action.pick[:2], now[-1, :2], atol=1e-6)
        np.testing.assert_allclose(action.place[:2], scene_.goal[-1, :2], atol=1e-6)
    assert told and not any(np.any(said) for said in told)


def _spied(state, told):
    """Logits that send the last object home; what is said of placed and ready objects goes to `told`."""
    jax.debug.callback(lambda *said: told.append(said), state.placed, state.ready)
    return jnp.zeros((len(state.size),) * 2).at[-1, -1].set(1.0)


def test_scores_and_pictures_are_written(alone, tmp_path, capsys):
    summary, drawn, _ = alone
    config = tiny_config(*SINGLE)
    for left in ("failure-val-7.webp", "failure-test-0.webp"):
        (tmp_path / left).write_bytes(b"of earlier scores")
    weights = {"step": 3, "crc32": 7}
    scoring.write_scores(config, summary, drawn, tmp_path, agent="policy", split="val", seeds=SEEDS, source="there", weights=weights)
    stored = json.loads((tmp_path / "scores-policy-val.json").read_text())
    assert stored["score"] == summary["score"] and stored["seeds"] == [1, 5]
    assert stored["checkpoint"] == "there" and stored["weights"] == weights
    assert options.to_dict(options.from_dict(stored["config"])) == options.to_dict(config)
    names = sorted(f"{kind}-val-{number}.webp" for kind, number in drawn)
    assert sorted(path.name for path in tmp_path.glob("*.webp")) == sorted(["failure-test-0.webp", *names])
    assert "episode-val-1.webp" in names
    assert f"score {summary['score']:.1f}" in capsys.readouterr().out


def save(path, config, step=1):
    """A checkpoint of a fresh policy of `config`, as training leaves it."""
    params = drawn_params(build.build_policy(config))
    stored = {"config": options.to_dict(config), "input_spec": build.input_spec(config)}
    checkpoint.Checkpoints(path).save_best(step, {"average": params}, 50.0, **stored)
    return params


def test_a_checkpoint_comes_back(tmp_path):
    config = tiny_config(*SINGLE)
    params = save(tmp_path, config)
    loaded = scoring.check_checkpoint(str(tmp_path), config, build.build_policy(config))
    assert jax.tree.structure(loaded) == jax.tree.structure(params)
    jax.tree.map(np.testing.assert_array_equal, loaded, params)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("model.width=8", r"is of another model: key_net/\S+/kernel is \(.*\) there, \(.*\) in the config"),
        ("model.name=two_stream", r"is of another model: key_net/current/\S+ is None there, \(.*\) in the config"),
        ("map.cell=0.025", r"expects the input .*'rows': 80.*, the config makes .*'rows': 40"),
        ("map.slices=7", r"expects the input .*'slices': 14.*, the config makes .*'slices': 7"),
        ("model.channels=5", r"key_net/.*/expand/kernel is \(1, 1, 4, 2\) there, \(1, 1, 4, 5\) in the config"),
    ],
)
def test_a_checkpoint_of_another_model_is_refused(tmp_path, change, message):
    save(tmp_path, tiny_config(*SINGLE))
    other = tiny_config(*SINGLE, change)
    with pytest.raises(checkpoint.MismatchError, match=message):
        scoring.check_checkpoint(str(tmp_path), other, build.build_policy(other))


def test_an_unknown_agent_is_refused():
    with pytest.raises(options.OptionsError, match="agent must be one of 'oracle', 'blind', 'top_view', got 'random'"):
        scoring.baseline("random", build.task(tiny_config()), seeds=SEEDS, threads=1)


def test_the_blind_agent_falls_behind_the_oracle():
    task = build.task(tiny_config())
    oracle, blind = (scoring.baseline(name, task, seeds=list(range(1, 13, 2)), threads=1) for name in ("oracle", "blind"))
    assert oracle["score"] == 100 > blind["score"]
