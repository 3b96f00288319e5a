"""The experiments: every row's config builds, finished rows are kept, intervals are what they say, and one series runs end to end."""

import json
import math

import clip_reference
import clip_tokens
import jax
import numpy as np
import pytest
from PIL import Image
from test_rollout import constant, run
from test_scoring import SINGLE, save
from test_train_step import tiny_config

from experiments import ablation, common, main_table, robustness, table1
from lala_jax import build, checkpoint, loop, observe, options, rollout, train, writers
from lala_jax.sim import scene, tasks
from lala_jax.sim.tasks import base as task_base
from lala_jax.sim.tasks import tower

SEEDS = [1, 3, 5]


@pytest.fixture
def unseen(monkeypatch):
    """Observers are not asked to render, which takes seconds each."""
    monkeypatch.setattr(observe.Observer, "check", lambda self: None)


def shipped(task):
    return common.shipped_config({"task": task})


def test_weights_are_rounded_where_the_row_says_so(monkeypatch):
    row = next(row for row in robustness.ROWS if row.name == "bfloat16")
    given, seen = {"w": np.float32([1.0, 1 / 3, -2.7])}, []
    empty = {name: {} for name in rollout.COUNTS} | {"per_episode": [{"seed": 1, "score": 0.0, "actions": 1, "complete": False}]}
    monkeypatch.setattr(common, "score", lambda config, params, seeds: seen.append(params) or empty)
    robustness.run(row, base=tiny_config(), checkpoint="", weights={}, seeds=SEEDS, params=given)
    (rounded,) = seen
    assert rounded["w"].dtype == np.float32
    cut = (given["w"].view(np.uint32) + 0x7FFF + (given["w"].view(np.uint32) >> 16 & 1)) & np.uint32(0xFFFF0000)  # to nearest, ties to even
    np.testing.assert_array_equal(np.asarray(rounded["w"]).view(np.uint32), cut)


@pytest.mark.parametrize("module", [robustness, ablation])
@pytest.mark.parametrize("task", tasks.names())
def test_every_row_builds(module, task, unseen):
    """A misspelt field or a wrong value is found here, and no row is another one's double, but for what says that it is."""
    doubles = ("default-again", "bfloat16")
    rows, built = [row for row in common.choose(module.ROWS, "", task) if row.name not in doubles], set()
    for row in rows:
        for config in row.configs(shipped(task)):
            built.add(json.dumps(options.to_dict(config)))
            assert build.recipe(config).observer == build.observer(config)
            if module is robustness:
                assert build.build_policy(config) == build.build_policy(shipped(task))
    assert len(built) == sum(len(row.parts) for row in rows)


def test_the_runs_of_the_main_table_build(unseen):
    rows = main_table.plan([500, 50, 10], [0, 1, 2])
    assert [row.name for row in rows] == ["500-0", "500-1", "500-2", "50-0", "10-0"]
    configs = [row.configs(shipped("tower"))[0] for row in rows]
    assert [(config.data.demos, config.seed) for config in configs] == [(500, 0), (500, 1), (500, 2), (50, 0), (10, 0)]
    assert all(build.recipe(config).batch_size == 8 for config in configs)


@pytest.mark.parametrize("scale", table1.SCALES)
@pytest.mark.parametrize("task", tasks.names())
def test_every_row_of_the_table_builds(task, scale, unseen):
    base = options.override(shipped(task), table1.shared(shipped(task), scale))
    rows, built = common.choose(table1.plan(scale), "", task, reference=False), set()
    assert len({row.name for row in rows}) == len({row.label for row in rows}) == len(rows)
    for row in rows:
        config = row.configs(base)[0]
        if row.agent == "policy":
            if table1.can_run(row):
                build.recipe(config)
            if not row.clip:
                built.add(json.dumps(options.to_dict(config)))
            assert config.data.demos == (table1.FEW[scale] if row.few else base.data.demos) and config.seed == base.seed
    others = sum(row.agent == "policy" and not row.scene and not row.clip for row in rows)
    assert len(built) == others  # no row is another one's double, but for where its backbone or its trunk comes from
    budgets = {(config.train.steps, config.train.batch_size) for config in (row.configs(base)[0] for row in rows)}
    assert budgets == {(base.train.steps, base.train.batch_size)}


def test_rows_are_chosen_by_name():
    assert [row.name for row in common.choose(robustness.ROWS, "noise", "tower")] == ["nominal", "noise"]
    assert "tower-3" not in [row.name for row in common.choose(robustness.ROWS, "", "pallet")]
    with pytest.raises(options.OptionsError, match="--rows must be one of 'nominal', .*got 'nois'; did you mean noise"):
        common.choose(robustness.ROWS, "nois", "pallet")
    with pytest.raises(options.OptionsError, match="--seeds must be whole numbers like 500,50,10, got '0,one'"):
        main_table.numbers("--seeds", "0,one")
    recoveries = next(row for row in ablation.ROWS if row.name == "recoveries").configs(shipped("pallet"))[0]
    assert recoveries.data.directory == "data/pallet-mistakes"


# Rows that are kept


def filled(path, config, *rows, weights=None, fails=(), error=KeyboardInterrupt):
    """Fill a file with rows of changes to `config`: what was run, and the rows."""
    ran = []

    def work(row):
        if row.name in fails:
            raise error
        ran.append(row.name)
        return {"score": 50.0}

    def finish(done, kept):
        return {"count": len(done), "kept": [row["name"] for row in kept]}

    try:
        done = common.fill(path, rows, work, finish, config=config, seeds=SEEDS, weights=weights)
    except KeyboardInterrupt:
        done = None
    return ran, done


def test_finished_rows_are_kept_and_changed_ones_run_again(tmp_path, capsys):
    path, config = tmp_path / "there" / "rows.json", tiny_config()
    first, second, third = (common.Row(name, name, overrides) for name, overrides in [("a", ()), ("b", ("seed=3",)), ("c", ())])
    assert filled(path, config, first, second, third, fails=("c",)) == (["a", "b"], None)  # stopped in the third
    assert json.loads(path.read_text())["count"] == 2
    ran, rows = filled(path, config, first, second, third)
    assert ran == ["c"] and [row["name"] for row in rows or ()] == ["a", "b", "c"]
    assert filled(path, config, first, second, third)[0] == []
    capsys.readouterr()
    assert filled(path, config, first, common.Row("b", "another label", ("seed=4",)), third)[0] == ["b"]
    assert f"{path} holds b of other settings: replaced once they are run" in capsys.readouterr().out
    stored = json.loads(path.read_text())["rows"]
    assert [(row["name"], row["label"], row["overrides"]) for row in stored] == [
        ("a", "a", [[]]),
        ("b", "another label", [["seed=4"]]),
        ("c", "c", [[]]),
    ]
    assert filled(path, config, third)[0] == []
    stored = json.loads(path.read_text())
    assert len(stored["rows"]) == 3 and stored["count"] == 1 and stored["kept"] == ["a", "b", "c"]  # what was not asked for stays
    assert filled(path, config, third, weights={"step": 1})[0] == ["c"]
    assert json.loads(path.read_text())["kept"] == ["c"]  # the others are of other weights
    filled(path, tiny_config("camera.turn=1.0"), first)
    assert json.loads(path.read_text())["kept"] == ["a"]  # "b" is of other settings
    filled(path, config, third)
    assert json.loads(path.read_text())["kept"] == ["b", "c"]
    older = json.loads(path.read_text())
    older["rows"][1]["overrides"] = [["model.gone=1"]]
    path.write_text(json.dumps(older))
    filled(path, config, first)
    assert json.loads(path.read_text())["kept"] == ["a", "c"]


@pytest.mark.parametrize("error", [loop.NonFiniteError("step 7: loss is nan"), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: too much")])
def test_a_row_that_fails_leaves_the_others(error, tmp_path):
    """As with workers: all others are run, but those that need it, and the command says what is missing."""
    path, config = tmp_path / "rows.json", tiny_config()
    rows = [common.Row("a", "a"), common.Row("b", "b", needs=("a",)), common.Row("c", "c")]
    with pytest.raises(SystemExit, match="2 of 3 rows are missing; .*\n  a: .*\n  b: it needs a, which is missing") as left:
        filled(path, config, *rows, fails=("a",), error=error)
    assert str(error).partition(":")[0] in str(left.value)
    assert [row["name"] for row in json.loads(path.read_text())["rows"]] == ["c"]
    assert filled(path, config, *rows)[0] == ["a", "b"]


def test_what_identifies_a_row(tmp_path):
    path, row = tmp_path / "rows.json", common.Row("a", "a")
    weights = {"step": 3, "crc32": 7}

    def ran(config=tiny_config(), **options):  # noqa: B008
        return filled(path, config, row, **options)[0] == ["a"]

    assert ran() and not ran()
    assert not ran(tiny_config("eval.parallel=3", "data.threads=2", "train.log_every=9"))  # makes no difference
    moved = "camera.turn=1.0"
    assert ran(tiny_config(moved)) and not ran(tiny_config(moved, "data.threads=2")) and ran()
    assert ran(tiny_config(moved)) and ran(tiny_config(moved, "eval.parallel=3")) and ran()  # how the cameras err is drawn otherwise
    assert ran(tiny_config("train.eval_every=7")) and ran()  # another checkpoint may be the best
    elsewhere = tiny_config("data.directory=elsewhere")  # as many demonstrations, maybe others
    assert ran(elsewhere) and not ran(elsewhere) and ran()
    assert ran(weights=weights) and not ran(elsewhere, weights=dict(weights))
    assert not ran(weights=dict(weights)) and ran(weights={**weights, "crc32": 8}) and ran()
    older = json.loads(path.read_text())
    del older["rows"][0]["config"]["model"]["max_height"]  # the row is older than a field
    path.write_text(json.dumps(older))
    assert not ran()
    assert not common.is_same(older["rows"][0], {**older["rows"][0], "seeds": [1, 7]})


def test_a_row_of_a_pretrained_backbone_depends_on_how_that_is_made(tmp_path):
    named = {row.name: row for row in table1.plan("smoke")}
    config = options.override(shipped("tower"), table1.shared(shipped("tower"), "smoke"))
    longer, path = options.override(config, ["pretrain.mask=0.25"]), tmp_path / "rows.json"
    rows = named["two-stream-scene"], named["two-stream"]
    assert filled(path, config, *rows)[0] == ["two-stream-scene", "two-stream"] and filled(path, config, *rows)[0] == []
    assert filled(path, longer, *rows)[0] == ["two-stream-scene"]


def test_a_row_whose_code_changed_runs_again_in_a_directory_of_its_own(tmp_path):
    path, config = tmp_path / "rows.json", tiny_config()
    old, new = common.Row("a", "a"), common.Row("a", "a", revision=2)
    assert filled(path, config, old)[0] == ["a"]
    older = json.loads(path.read_text())
    del older["rows"][0]["revision"]  # a file from before there were any
    path.write_text(json.dumps(older))
    assert filled(path, config, old)[0] == [] and filled(path, config, new)[0] == ["a"]
    assert filled(path, config, new)[0] == [] and filled(path, config, old)[0] == ["a"]
    assert old.folder == "a" and new.folder == "a-r2"


def test_an_old_revision_of_a_row_that_is_not_asked_for_does_not_count(tmp_path):
    path, config, counted = tmp_path / "rows.json", tiny_config(), []

    def finish(done, kept):
        counted.append([row["name"] for row in kept])
        return {}

    for rows, known in ((("a", "b"), ()), (("a",), [common.Row("b", "b")]), (("a",), [common.Row("b", "b", revision=1)])):
        asked = [common.Row(name, name) for name in rows]
        common.fill(path, asked, lambda row: {"score": 50.0}, finish, config=config, seeds=SEEDS, known=known)
    assert counted[-2:] == [["a", "b"], ["a"]] and len(common.read(path)) == 2


def test_two_commands_write_to_one_file(tmp_path):
    """What another one added while a row ran stays."""
    path, config = tmp_path / "rows.json", tiny_config()

    def work(row):
        assert row.name == "a"
        assert filled(path, config, common.Row("b", "b"))[0] == ["b"]  # meanwhile
        return {"score": 1.0}

    rows = common.fill(path, [common.Row("a", "a")], work, lambda *_: {}, config=config, seeds=SEEDS)
    assert [row["name"] for row in rows] == ["a"]
    assert {row["name"]: row["score"] for row in json.loads(path.read_text())["rows"]} == {"a": 1.0, "b": 50.0}


# Numbers


def test_intervals_of_differences():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 100, 40), rng.uniform(0, 100, 40)
    first, second = ({str(seed): value for seed, value in enumerate(values)} for values in (a, b))
    paired = common.difference(first, dict(reversed(second.items())), paired=True)  # by seed, whatever the order
    half = 1.96 * np.std(a - b, ddof=1) / np.sqrt(40)
    np.testing.assert_allclose([paired["mean"], *paired["interval95"]], (a - b).mean() + np.array([0, -half, half]))
    apart = common.difference(first, second, paired=False)
    half = 1.96 * np.sqrt(np.var(a, ddof=1) / 40 + np.var(b, ddof=1) / 40)
    np.testing.assert_allclose([apart["mean"], *apart["interval95"]], (a - b).mean() + np.array([0, -half, half]))
    with pytest.raises(ValueError, match="the same seeds"):
        common.difference(first, {"1": 2.0}, paired=True)


@pytest.mark.parametrize(("one", "other"), [(100.0, 100.0), (60.0, 90.0), (0.0, 100.0)])
def test_intervals_of_differences_without_spread(one, other):
    """Means under which so many equal differences have a chance of 2.5% are the ends: all else at the other end of what is possible."""
    first, second = ({str(seed): value for seed in range(9)} for value in (one, other))
    found, same = common.difference(first, second, paired=True), one - other
    low, high = found["interval95"]
    assert found["mean"] == same
    for end, farthest in ((low, -100.0), (high, 100.0)):
        share = (end - farthest) / (same - farthest) if same != farthest else 0.025 ** (1 / 9)
        assert share**9 == pytest.approx(0.025)
    down, up = (np.subtract(rollout.interval([score] * 9), score) for score in (one, other))
    apart = common.difference(first, second, paired=False)["interval95"]
    np.testing.assert_allclose(apart, [same - math.hypot(down[0], up[1]), same + math.hypot(down[1], up[0])])


def test_quarters_are_dealt_in_order():
    assert robustness.shares(list(range(10)), 4) == [[0, 1, 2], [3, 4, 5], [6, 7], [8, 9]]
    assert robustness.shares([7, 9], 4) == [[7], [9]]


def test_merged_quarters_equal_one_summary():
    task = tasks.get("tower", num_objects=2)
    episodes = run(task, [0, 2]) + run(task, [4], constant(None))
    scenes = [task.sample(6)]
    episodes += rollout.run(task, scenes, [6], rollout.oracle_agent(task, scenes, [6], "blind"), threads=1)
    parts = [[episodes[i] for i in share] for share in robustness.shares(range(4), 3)]
    assert rollout.merged([rollout.summary(part) for part in parts]) == rollout.summary(episodes)
    assert rollout.merged([rollout.summary(episodes)]) == rollout.summary(episodes)
    row = common.row_of(rollout.summary(episodes))
    assert row["scores"]["4"] == 0 and list(row["scores"]) == ["0", "2", "4", "6"] and "per_episode" not in row


def test_which_worlds_have_the_same_scenes():
    config = tiny_config()
    same = {row.name: robustness.same_scenes(config, row.configs(config)[0], SEEDS) for row in robustness.ROWS}
    assert {name for name, found in same.items() if not found} == {"colors", "tower-3", "tower-4", "tower-6"}


def test_scenes_that_are_passed_over_in_one_world_only_are_not_the_same(monkeypatch):
    config, real = tiny_config(), task_base.Task.sample
    other = options.override(config, ["task.distractors=1"])
    for crowded, same in (({0, 1}, True), ({0}, False), ({1}, False)):  # distractors of the worlds in which a scene has no room

        def sample(self, seed, crowded=crowded):
            if seed == SEEDS[1] and self.distractors in crowded:
                raise task_base.NoFreePose("no free pose")
            return real(self, seed)

        monkeypatch.setattr(task_base.Task, "sample", sample)
        assert robustness.same_scenes(config, other, SEEDS) is same


def test_worlds_that_a_users_task_or_cameras_lack(monkeypatch, capsys):
    """A task without distractors, three cameras instead of four."""
    rows = {row.name: row for row in robustness.worlds(shipped("tower"))}
    assert list(rows.values()) == list(robustness.ROWS) and all(robustness.can_be_built(row, shipped("tower")) for row in rows.values())
    monkeypatch.setitem(scene.PRESETS, "three", (scene.PRESETS["ring"][0][:3], scene.PRESETS["ring"][1]))
    rows = {row.name: row for row in robustness.worlds(options.override(shipped("tower"), ["camera.preset=three"]))}
    assert rows["missing"].parts == (("camera.missing=0",), ("camera.missing=1",), ("camera.missing=2",))
    assert rows["missing"].label == "one camera of three missing, each in a third"
    monkeypatch.setattr(tower.TowerTask, "build_distractors", task_base.Task.build_distractors)
    assert [row.name for row in robustness.ROWS if not robustness.can_be_built(row, shipped("tower"))] == ["distractors"]
    assert "distractors is left out: task tower has no build_distractors" in capsys.readouterr().out
    monkeypatch.delitem(scene.PRESETS, "three")
    with pytest.raises(options.OptionsError, match=r"camera.preset must be one of 'ring', 'paper', got 'three'"):
        robustness.worlds(options.override(shipped("tower"), ["camera.preset=three"]))


def test_training_seconds_are_those_of_the_curve(tmp_path):
    with writers.Writer(tmp_path, tensorboard=False) as writer:
        for step, seconds in [(10, 3.0), (20, 1.0), (30, 1.0), (20, 2.0), (35, 1.0)]:  # stopped after 30, gone on from 10
            writer.scalars(step, {"loss": 1.0, "seconds_per_step": seconds})
            writer.scalars(step, {"val_score": 50.0})
    assert common.train_seconds(tmp_path) == 10 * 3 + 10 * 2 + 10 * 1 + 5 * 1


def test_tables():
    text = common.table(["", "score"], [["a", rollout.with_interval(50, [40.04, 60])], ["b", rollout.with_interval(1, [None, None])]])
    assert text.splitlines() == ["|  | score |", "| --- | --- |", "| a | 50.0 [40.0, 60.0] |", "| b | 1.0 |"]
    assert rollout.with_interval(-2, [-3, 1], signed=True) == "-2.0 [-3.0, +1.0]"
    assert rollout.counted({"wrong yaw": 1, "wrong place": 3, "none": 0}) == "3 wrong place, 1 wrong yaw"


# Whole series


@pytest.fixture
def trains(monkeypatch):
    """Training takes no time here: `(workdir, config)` of every run."""
    runs = []

    def fake(config, workdir):
        runs.append((workdir, config))
        with writers.Writer(workdir, tensorboard=False) as writer:
            writer.scalars(config.train.steps, {"seconds_per_step": 2.0})
        seeds = build.split_seeds(config.eval.split, config.eval.start, config.eval.episodes)
        return told(seeds, 90.0 if config.model.multi_action else 60.0)

    monkeypatch.setattr(train, "train_and_evaluate", fake)
    return runs


def told(seeds, score):
    lines = [{"seed": s, "score": score + s % 4, "complete": False, "actions": 1, "causes": ["wrong yaw"]} for s in seeds]
    return rollout.merged([{"per_episode": lines, **{name: {"wrong yaw": len(seeds)} for name in rollout.COUNTS}}])


def test_the_ablation_trains_each_row_once(trains, monkeypatch, tmp_path, capsys):
    loaded, checked = [], []
    monkeypatch.setattr(common, "load_weights", lambda path, *_: (loaded.append(path), {"step": 5, "crc32": 1}))
    monkeypatch.setattr(common, "check_run", lambda path, config: checked.append((path, config.train.steps)))
    monkeypatch.setattr(common, "score", lambda config, _, seeds: told(seeds, 95.0 if config.model.average_turns else 0.0))
    given = ["--task=tower", "--steps=5", "--episodes=4", "--seed=2", f"--workdir={tmp_path / 'runs' / '<task>'}", f"--out={tmp_path}"]
    rows = ablation.command([*given, "--rows=one-hot,average-turns"])
    runs = tmp_path / "runs" / "tower"
    assert [name for name, _ in trains] == [str(runs / "default"), str(runs / "one-hot-r2")]
    assert loaded == [str(runs / "default" / "checkpoints")] and checked == [(loaded[0], 5)]
    for _, config in trains:
        assert (config.train.steps, config.train.eval_every, config.seed, config.data.demos) == (5, 5, 2, 500)
        assert (config.eval.split, config.eval.start, config.eval.episodes) == ("val", 100, 4)
    assert [row["difference"]["mean"] for row in rows[1:]] == [-30, 5] and rows[1]["train_seconds"] == 10
    stored = json.loads((tmp_path / "ablation-tower.json").read_text())
    assert stored["steps"] == 5 and [row["seeds"] for row in stored["rows"]] == [[201, 207]] * 3
    assert "| one-hot labels | 62.0 [60.9, 63.1] | 0% | -30.0 [-72.2, +48.3] | 10 |" in capsys.readouterr().out
    ablation.command([*given, "--rows=one-hot,slices"])
    assert [name for name, _ in trains[2:]] == [str(runs / "slices")]
    before = (tmp_path / "ablation-tower.json").read_bytes()
    with pytest.raises(SystemExit, match="2"):
        ablation.command([*given, "--steps=6", "--rows=one-hot"])
    assert "ablation-tower.json holds rows of --steps=5: give another --out" in capsys.readouterr().err
    assert (tmp_path / "ablation-tower.json").read_bytes() == before and len(trains) == 3


def test_the_main_table_averages_over_seeds(trains, tmp_path, capsys):
    given = ["--demos=50,10", "--seeds=0,1", "--episodes=3", f"--workdir={tmp_path / 'runs' / '<task>'}", f"--out={tmp_path}"]
    rows = main_table.command(given)
    assert [name for name, _ in trains] == [str(tmp_path / "runs" / f"tower-{name}") for name in ("50-0", "50-1", "10-0")]
    stored = json.loads((tmp_path / "main.json").read_text())
    assert [row["seeds"] for row in stored["rows"]] == [[10_001, 10_003]] * 3 and stored["split"] == "test"
    assert stored["means"][0]["train_seeds"] == [0, 1] and stored["means"][0]["score"] == rows[0]["score"]
    assert stored["means"][0]["deviation"] == 0 and stored["means"][1]["deviation"] is None
    assert "| 50 demonstrations, mean of 2 seeds | 92.0 (deviation 0.0) |" in capsys.readouterr().out
    assert len(main_table.command(given)) == 3 and len(trains) == 3


def test_the_table_holds_every_row_of_both_tasks(trains, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(table1.scoring, "baseline", lambda name, task, *, seeds, threads: told(seeds, {"blind": 20.0}.get(name, 40.0)))
    given = ["--scale=smoke", f"--workdir={tmp_path / 'runs' / '<task>'}", f"--out={tmp_path}"]
    rows = table1.command([*given, "--task=pallet", "--rows=ours,blind,top_view,graph"])
    assert [name for name, _ in trains] == [str(tmp_path / "runs/pallet" / f"smoke-{name}") for name in ("ours", "graph")]
    assert [row["name"] for row in rows] == ["ours", "graph", "blind", "top_view"] and rows[2]["samples"] == 0
    assert rows[0]["samples"] == 4 and rows[0]["train_seconds"] == 4 and rows[0]["parameters"] > 1000
    table1.command([*given, "--rows=two-stream"])
    config = trains[-1][1]
    assert config.task.name == "tower" and config.model.max_height and not config.model.multi_action and config.camera.backbone
    text = (tmp_path / "smoke.md").read_text()
    assert text.strip() in capsys.readouterr().out
    text, _, differences = text.partition("\n\n")
    assert "| graph policy on true poses | ours, the default agent |  | +0.0 [" in differences
    header, _, *lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    assert header == ["", "parameters", "tower", "complete", "training, s", "published", "pallet", "complete", "training, s", "published"]
    named = {line[0]: line[1:] for line in lines}
    assert list(named) == [entry.label for entry in table1.ROWS if entry.name in ("ours", "two-stream", "graph", "blind", "top_view")]
    assert named["LALA two stream"][4] == "15.8" and named["LALA two stream"][5:] == [""] * 4
    assert named["blind: places well, ignores identities"][1:5] == [""] * 4  # of the tower it was not asked for
    assert len(table1.command([*given, "--rows=two-stream"])) == 1 and len(trains) == 3  # nothing runs again
    held = (tmp_path / "smoke-tower.json").read_bytes()
    with pytest.raises(SystemExit, match="2"):
        table1.command([*given, "--rows=two-stream", "--seed=1", "--split=val"])
    assert "smoke-tower.json holds rows of --split=test --seed=0: give another --out" in capsys.readouterr().err
    assert (tmp_path / "smoke-tower.json").read_bytes() == held and len(trains) == 3
    path = tmp_path / "smoke-pallet.json"
    older = json.loads(path.read_text())
    older["rows"][0]["overrides"][0].append("model.width=9")
    older["rows"][1]["seeds"] = [1, 5]
    older["rows"][2]["config"]["train"]["steps"] = 3  # of the scale, which was another then
    path.write_text(json.dumps(older))
    table1.write(tmp_path, "smoke", [10_001, 10_002], bases())
    assert "left out of the table, as they are of other settings or seeds: blind, graph, ours in " in capsys.readouterr().out
    named = [line.split("|")[1].strip() for line in (tmp_path / "smoke.md").read_text().splitlines()[2:]]
    assert named == [entry.label for entry in table1.ROWS if entry.name in ("two-stream", "top_view")]


def test_the_table_is_written_of_what_is_there_when_a_row_fails(trains, monkeypatch, tmp_path):
    ran = train.train_and_evaluate

    def fails(config, workdir):
        if config.model.name == "two_stream":
            raise loop.NonFiniteError("step 7: loss is nan")
        return ran(config, workdir)

    monkeypatch.setattr(train, "train_and_evaluate", fails)
    with pytest.raises(SystemExit, match="two-stream: step 7: loss is nan"):
        table1.command(["--scale=smoke", "--rows=two-stream,graph", f"--workdir={tmp_path / 'runs'}", f"--out={tmp_path}"])
    assert "graph policy on true poses" in (tmp_path / "smoke.md").read_text()


def test_the_results_of_two_tasks_are_not_mixed_in_one_file(trains, tmp_path, capsys):
    """Where --out is one directory for both; nothing is trained, nothing lost."""
    given = ["--demos=10", "--seeds=0", "--episodes=2", f"--workdir={tmp_path / 'runs'}", f"--out={tmp_path}"]
    main_table.command([*given, "--task=tower"])
    held = (tmp_path / "main.json").read_bytes()
    with pytest.raises(SystemExit, match="2"):
        main_table.command([*given, "--task=pallet"])
    assert "main.json holds rows of --task=tower: give another --out" in capsys.readouterr().err
    assert (tmp_path / "main.json").read_bytes() == held and len(trains) == 1


def test_a_row_says_what_it_ran_and_what_its_backbone_cost(trains, monkeypatch, tmp_path):
    def fake(config, workdir):
        with writers.Writer(workdir, tensorboard=False) as writer:
            writer.scalars(config.pretrain.steps, {"seconds_per_step": 5.0})
        return f"{workdir}/backbone.npz"

    monkeypatch.setattr(table1.pretrain, "pretrain", fake)
    (row,) = table1.command(["--scale=smoke", "--rows=two-stream-scene", f"--workdir={tmp_path / 'runs' / '<task>'}", f"--out={tmp_path}"])
    ((directory, config),) = trains
    assert directory == str(tmp_path / "runs/tower/smoke-two-stream-scene")
    ran = options.fields(options.to_dict(config)) | {"camera.backbone": "smoke-backbone/backbone.npz"}
    assert config.camera.backbone == f"{tmp_path}/runs/tower/smoke-backbone/backbone.npz"
    assert options.fields(row["config"]) | row["ran"] == writers.plain(ran)
    assert (row["pretrain_samples"], row["pretrain_seconds"], row["samples"], row["train_seconds"]) == (4, 10.0, 4, 4.0)
    assert "| 4 + 10 |" in (tmp_path / "smoke.md").read_text()


def test_differences_are_of_the_same_scenes():
    first, second, third = (
        {"scores": dict(zip("abc", scores, strict=True))} for scores in ([0.0, 10.0, 15.0], [10.0, 30.0, 20.0], [1.0] * 3)
    )
    found = table1.differences({"tower": {"single": first, "single-visible": second}, "pallet": {"single-visible": third}})
    mean, half = 35 / 3, 1.96 * np.std([10, 20, 5], ddof=1) / math.sqrt(3)
    own = f"{mean:+.1f} [{mean - half:+.1f}, {mean + half:+.1f}]"
    assert found.splitlines()[2:] == [f"| single stream, height slices | LALA single stream | {own} |  |"]
    assert table1.differences({"tower": {"single": first, "lateral": third}}) == ""


def test_rows_are_compared_with_others_that_have_what_they_are_compared_in():
    rows = {row.name: row for row in table1.ROWS}
    compared = [row for row in table1.ROWS if row.against]
    assert {row.name for row in compared} >= {name for name in rows if name.startswith(("ours-one", "ours-no", "two-stream-"))}
    for row, other in ((one, rows[name]) for one in compared for name in one.against):
        assert set(row.tasks) <= set(other.tasks or tasks.names()) and not other.tasks and other.agent == row.agent == "policy"
        assert row.family == other.family or row.name == "graph"


def bases():
    """The configs that the rows of both tasks change, at the smallest scale."""
    config = shipped("tower")
    return table1.bases(options.override(config, [*table1.shared(config, "smoke"), "eval.split=test"]), "smoke")


def test_the_checkpoint_of_another_run_is_not_taken_for_the_first_rows(tmp_path):
    config = tiny_config(*SINGLE)
    save(tmp_path, config)
    common.check_run(str(tmp_path), options.override(config, ["eval.parallel=3"]))
    with pytest.raises(checkpoint.CheckpointError, match=r"is of a run with another seed \(0 there, 4 here\)"):
        common.check_run(str(tmp_path), options.override(config, ["seed=4"]))


def test_the_table_is_of_the_papers_tasks():
    with pytest.raises(options.OptionsError, match="--task must be one of 'tower', 'pallet', got 'mine'"):
        table1.main(shipped("tower"), "nowhere", **{**table1.FLAGS, "task": "mine"})


def test_bars_are_as_long_as_the_scores(tmp_path):
    def drawn(*scores):
        rows = [{"score": score, "interval95": [None, None], "published": None} for score in scores]
        table1.bars({"tower": dict(zip(("ours", "single"), rows, strict=False))}, tmp_path / "bars.webp")
        pixels = np.asarray(Image.open(tmp_path / "bars.webp").convert("RGB")).astype(int)
        return (np.abs(pixels - (31, 119, 180)).max(-1) < 40).sum()

    def whisker(low):
        row = {"score": 40.0, "interval95": [low, 80.0], "published": None}
        table1.bars({"tower": {"ours": row}}, tmp_path / "bars.webp")
        return (np.asarray(Image.open(tmp_path / "bars.webp").convert("RGB")).astype(int).max(-1) < 60).sum()

    assert whisker(0.0) > whisker(40.0)  # an interval that begins at 0 has a lower end
    assert drawn(80.0, 80.0) == pytest.approx(2 * drawn(40.0, 40.0), rel=0.05)
    assert drawn(80.0, 0.0) == pytest.approx(drawn(40.0, 40.0), rel=0.05)


@pytest.fixture
def uncached():
    """Many large programs: they are not written to the compilation cache, and go when the test ends."""
    jax.config.update("jax_enable_compilation_cache", False)
    yield
    jax.config.update("jax_enable_compilation_cache", True)
    jax.clear_caches()


# A row of each kind; the others compile for minutes.
ALWAYS = ("ours", "single", "transporter", "two-stream-scene", "graph", "blind", "top_view", "oracle")


@pytest.mark.parametrize(
    "name", [row.name if row.name in ALWAYS else pytest.param(row.name, marks=pytest.mark.slow) for row in table1.ROWS]
)
def test_every_row_runs_end_to_end(name, tmp_path, uncached):
    """From demonstrations to the row, at a scale where scores mean nothing."""
    row = next(row for row in table1.ROWS if row.name == name)
    sizes = {"blocks": (1, 1, 1, 1), "width": 4, "side": 32, "embed": 6, "positions": 77, "text_width": 8, "layers": 1}
    tensors = clip_reference.state(np.random.default_rng(0), vocab=len(clip_tokens.vocabulary()), **sizes)
    files = clip_tokens.fields(tmp_path, tensors) if row.clip else ()
    config = shipped("tower")
    config.task.num_objects, config.data.directory = 2, str(tmp_path / "data")
    base = options.override(config, [*table1.shared(config, "smoke"), "eval.split=test"])
    row = next(row for row in table1.plan("smoke", files) if row.name == name)
    if not table1.can_run(row, files):
        pytest.skip(f"the extra {row.extra} is not installed")
    found = table1.run(row, base, tmp_path / "run", build.split_seeds("test", 0, 2))
    assert found["episodes"] == 2 and list(found["scores"]) == ["10001", "10002"]
    assert found["parameters"] is None or found["parameters"] > 300 and found["samples"] == 4 and found["train_seconds"] > 0


def test_robustness_end_to_end(tmp_path, capsys, monkeypatch):
    """A policy that knows nothing in two worlds, one of them in parts; a second call runs nothing."""
    save(tmp_path / "checkpoints", tiny_config(*SINGLE, "camera.calibrate=false"))
    given = [f"--checkpoint={tmp_path / 'checkpoints'}", "--episodes=2", f"--out={tmp_path}", "--rows=missing"]
    rows = robustness.command(given)
    assert [row["name"] for row in rows] == ["nominal", "missing"]
    stored = json.loads((tmp_path / "robustness-test.json").read_text())
    assert stored["rows"] == rows and stored["reference"] == "nominal"
    assert rows[1]["overrides"] == [[f"camera.missing={k}"] for k in range(4)]
    for row in rows:
        assert row["seeds"] == [10_001, 10_002] and list(row["scores"]) == ["10001", "10002"] and row["episodes"] == 2
        assert sum(row["lost_objects"].values()) == 4 - sum(row["scores"].values()) / 50
    assert rows[1]["drop"]["paired"] and "drop" not in rows[0]
    assert stored["conditions"]["as trained"]["score"] == rows[0]["score"]
    assert "| one camera of four missing, each in a quarter | " in capsys.readouterr().out
    monkeypatch.setattr(common, "score", None)
    assert robustness.command(given) == rows


@pytest.mark.parametrize("content", ['{"rows": [{"na', "[]", '{"rows": [1]}', '{"rows": [{"label": "a"}]}'])
def test_a_damaged_file_is_named_and_stays(content, tmp_path, capsys):
    (tmp_path / "ablation-tower.json").write_text(content)
    with pytest.raises(SystemExit, match="2"):
        ablation.command(["--task=tower", f"--out={tmp_path}"])
    assert "ablation-tower.json is damaged or no file of rows (" in capsys.readouterr().err
    assert (tmp_path / "ablation-tower.json").read_text() == content


def test_a_wrong_request_ends_with_one_message(tmp_path, capsys):
    for command, arguments, message in [
        (robustness.command, [], "give --checkpoint=PATH"),
        (robustness.command, [f"--checkpoint={tmp_path}"], "no checkpoint"),
        (
            robustness.command,
            ["--checkpoint=pretrained/tower", "--config.eval.split=val"],
            "--config.eval.split=val would have no effect: the field is set by --split",
        ),
        (ablation.command, ["--task=castle"], "--task must be one of 'pallet', 'tower', got 'castle'"),
        (ablation.command, ["--config=configs/tower.py"], "--task=pallet, but the config is of 'tower': give --task=tower"),
        (table1.command, ["--config=configs/pallet.py"], "--task=tower, but the config is of 'pallet': give --task=pallet"),
        (main_table.command, ["--config=configs/pallet.py"], "--task=tower, but the config is of 'pallet': give --task=pallet"),
        (main_table.command, ["--demos=many"], "--demos must be whole numbers"),
        (table1.command, ["--config.train.steps=9"], "--config.train.steps=9 would have no effect: the field is set by --scale=cpu"),
        (table1.command, ["--config.seed=1"], "--config.seed=1 would have no effect: the field is set by --seed"),
        (ablation.command, ["--config.train.steps=9"], "--config.train.steps=9 would have no effect: the field is set by --steps"),
        (main_table.command, ["--config.data.demos=9"], "--config.data.demos=9 would have no effect: the field is set by --demos"),
        (table1.command, ["--scale=big"], "--scale must be one of 'smoke', 'cpu', 'paper', got 'big'"),
    ]:
        with pytest.raises(SystemExit, match="2"):
            command(arguments)
        assert message in capsys.readouterr().err
