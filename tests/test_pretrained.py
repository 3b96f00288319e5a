"""Published weights: the same bits, never damaged silently, and a reported score that is repeated or contradicted, not believed."""

import hashlib
import json
import pathlib
import shlex
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_cli import contents, refused
from test_scoring import SINGLE, save
from test_train_step import tiny_config

from lala_jax import build, checkpoint, evaluate, options, pretrained, publish, scoring, writers

SEEDS = [10_002, 10_003]


def tiny(*more):
    return tiny_config(*SINGLE, "eval.strips=0", "eval.parallel=2", *more)


def bits(tree):
    return {name: (str(leaf.dtype), leaf.shape, np.asarray(leaf).tobytes()) for name, leaf in checkpoint.named(tree).items()}


def scored(config, path, workdir, **flags):
    """Evaluate through the function that the command calls; flags that are not given are the command's."""
    return evaluate.main(config, str(workdir), **{**evaluate.FLAGS, "checkpoint": str(path), **flags})


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A checkpoint of a policy that can do nothing and its scores on two test episodes: `(checkpoint, file of scores, parameters)`."""
    path = tmp_path_factory.mktemp("run")
    config = tiny()
    params = save(path / "checkpoints", config, step=7)
    scored(config, path / "checkpoints", path / "eval", split="test", start=1, episodes=2)
    return path / "checkpoints", path / "eval" / "scores-policy-test.json", params


@pytest.fixture
def published(run, tmp_path):
    publish.publish(str(run[0]), [str(run[1])], tmp_path / "tiny")
    return tmp_path / "tiny"


def edit(path, **fields):
    path.write_text(json.dumps({**json.loads(path.read_text()), **fields}))


def test_float32_comes_back_bit_for_bit(run, published):
    params, config, input_spec = pretrained.load(published)
    assert bits(params) == bits(run[2]) and jax.tree.structure(params) == jax.tree.structure(run[2])
    assert input_spec == writers.plain(build.input_spec(tiny()))
    assert build.run_settings(config) == build.run_settings(writers.plain(options.to_dict(tiny())))
    assert (
        bits(pretrained.load(run[0])[0]) == bits(params)
        and pretrained.describe(run[0])["step"] == pretrained.describe(published)["step"] == 7
    )
    assert pretrained.card(run[0]) is None
    loaded = scoring.check_checkpoint(str(published), tiny(), build.build_policy(tiny()))
    assert bits(loaded) == bits(run[2])


def test_bfloat16_comes_back_rounded_once(run, published, tmp_path):
    publish.publish(str(run[0]), [str(run[1])], tmp_path / "half", dtype="bfloat16")
    rounded = jax.tree.map(lambda leaf: leaf.astype(jnp.bfloat16).astype(jnp.float32), run[2])
    assert bits(pretrained.load(tmp_path / "half")[0]) == bits(rounded) != bits(run[2])
    sizes = [(path / "weights.npz").stat().st_size for path in (tmp_path / "half", published)]
    assert sizes[1] - sizes[0] == 2 * pretrained.card(published)["parameters"]
    assert "rounded to bfloat16" in (tmp_path / "half" / "README.md").read_text()


def test_publishing_again_gives_the_same_files(run, published):
    """Also from the published weights themselves, with scores of theirs."""
    before = contents(published)
    assert set(before) == {"weights.npz", "card.json", "README.md"}
    backup = published.with_name("tiny.old")
    backup.mkdir()  # of a user
    publish.publish(str(run[0]), [str(run[1])], published)
    assert contents(published) == before
    backup.rmdir()
    assert "source" not in json.loads(before["card.json"])["data"]
    scored(options.from_dict(pretrained.describe(published)["config"]), published, published.parent / "eval")
    publish.publish(str(published), [str(published.parent / "eval" / "scores-policy-test.json")], published)
    assert (published / "weights.npz").read_bytes() == before["weights.npz"]
    assert sorted(path.name for path in published.parent.iterdir()) == ["eval", "tiny"]


def test_the_card_says_what_and_how(run, published):
    card = json.loads((published / "card.json").read_text())
    assert card["sha256"] == hashlib.sha256((published / "weights.npz").read_bytes()).hexdigest()
    assert card["data"]["task"] == "tower" and card["data"]["objects"] == 2 and card["data"]["demonstrations"] == 6
    assert card["training"]["seed"] == 0 and card["training"]["steps"] == 2
    assert card["scores"][0]["seeds"] == SEEDS and card["scores"][0]["file"] == str(run[1])
    text = (published / "README.md").read_text()
    for part in (*card["commands"].values(), str(run[1]), "10002 to 10003", "Apache-2.0", f"{card['parameters']:,} parameters"):
        assert part in text


def test_the_training_command_trains_this(published):
    """Its flags turn the task's config into one that makes the same run."""
    card = pretrained.card(published)
    words = shlex.split(card["commands"]["train"])
    assert words[:3] == ["python", "-m", "lala_jax.train"]
    overrides = [word.removeprefix("--config.") for word in words if word.startswith("--config.")]
    config = options.load(words[3].removeprefix("--config="), overrides)
    assert build.run_settings(writers.plain(options.to_dict(config))) == build.run_settings(card["config"])
    usual = publish.training_command(writers.plain(options.to_dict(options.load("configs/pallet.py"))))
    assert usual == "python -m lala_jax.train --config=configs/pallet.py --workdir=runs/pallet"


def test_evaluation_repeats_the_reported_score(run, published, tmp_path, capsys):
    """From the card alone: its split, its seeds; then the verdict."""
    config = evaluate.stored_config({"checkpoint": str(published)})
    result = scored(config, published, tmp_path / "again")
    stored = json.loads((tmp_path / "again" / "scores-policy-test.json").read_text())
    assert stored["split"] == "test" and stored["seeds"] == SEEDS and result["score"] == json.loads(run[1].read_text())["score"]
    assert "reproduced: equal to the reported score" in capsys.readouterr().out
    scored(config, published, tmp_path / "one", episodes=1)
    assert (
        "not compared with the reported score, which is of test seeds 10002 to 10003, not test seeds 10002 to 10002"
        in capsys.readouterr().out
    )


def test_a_contradicted_score_ends_with_status_1(published, tmp_path, capsys):
    card = json.loads((published / "card.json").read_text())
    edit(published / "card.json", scores=[{**card["scores"][0], "score": 100.0, "interval95": [99.0, 100.0]}])
    with pytest.raises(SystemExit) as caught:
        scored(evaluate.stored_config({"checkpoint": str(published)}), published, tmp_path / "again")
    assert caught.value.code == 1 and "DIFFERS by more than the interval" in capsys.readouterr().out
    assert (tmp_path / "again" / "scores-policy-test.json").exists()


WORLD = {"seed": 0, "task": {"name": "tower"}, "camera": {"preset": "ring"}, "map": {"cell": 0.1}, "model": {"width": 4}}
CARD = {"config": WORLD, "scores": [{"split": "test", "seeds": SEEDS, "episodes": 2, "score": 90.0, "interval95": [88.0, 92.0]}]}


@pytest.mark.parametrize(
    ("changes", "fine", "text"),
    [
        ({}, True, "reproduced: equal to the reported score of 90.0"),
        ({"score": 91.9}, True, "reproduced: 91.9 differs from the reported 90.0 [88.0, 92.0], but lies within the interval"),
        ({"score": 87.9}, False, "NOT reproduced: 87.9 DIFFERS by more than the interval from the reported 90.0 [88.0, 92.0]"),
        ({"score": 92.1}, False, "NOT reproduced: 92.1 DIFFERS by more than the interval from the reported 90.0 [88.0, 92.0]"),
        ({"camera": {"preset": "paper"}}, True, "which has another camera.preset ('ring' there, 'paper' here)"),
        ({"model": {"width": 4, "more": True}}, True, "which has another model.more (None there, True here)"),
        ({"model": {"width": 4, "dtype": "float32"}}, True, "reproduced: equal"),  # the card is older than the field
        ({"model": {"width": 4, "dtype": "bfloat16"}}, True, "which has another model.dtype ('float32' there, 'bfloat16' here)"),
        ({"seed": 1, "score": 0.0}, True, "which has another seed (0 there, 1 here)"),
        ({"eval": {"parallel": 3}}, True, "reproduced: equal"),
        ({"split": "val", "score": 0.0}, True, "which is of test seeds 10002 to 10003, not val seeds 10002 to 10003"),
        ({"seeds": [10_002, 10_003, 10_004], "score": 0.0}, True, "which is of test seeds 10002 to 10003, not test seeds 10002 to 10004"),
    ],
)
def test_verdicts(changes, fine, text):
    asked = {"split": "test", "seeds": SEEDS, "score": 90.0, **changes}
    config = {**WORLD, **{name: value for name, value in changes.items() if name in WORLD or name == "eval"}}
    found = pretrained.verdict(CARD, config, split=asked["split"], seeds=asked["seeds"], result={"score": asked["score"]})
    assert found[0] is fine and text in found[1]
    assert ("not compared" in found[1]) == ("which" in text)


@pytest.mark.parametrize("seed", range(3))
def test_a_flipped_bit_is_refused(published, seed):
    rng = np.random.default_rng(seed)
    file = published / "weights.npz"
    damaged = bytearray(file.read_bytes())
    damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
    file.write_bytes(damaged)
    with pytest.raises(checkpoint.CheckpointError, match=r"weights\.npz is damaged: its SHA-256"):
        pretrained.load(published)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: (path / "weights.npz").unlink(), r"weights\.npz cannot be read"),
        (lambda path: (path / "card.json").unlink(), r"card\.json is missing or damaged"),
        (lambda path: (path / "card.json").write_text("{"), r"card\.json is missing or damaged"),
        (lambda path: (path / "card.json").write_text("[]"), r"card\.json is missing or damaged"),
        (lambda path: (path / "card.json").write_text('{"version": 1}'), r"card\.json is damaged: no field sha256, dtype, step, config"),
        (lambda path: edit(path / "card.json", version=2), r"card\.json has format version 2, this code reads version 1"),
        (lambda path: edit(path / "card.json", dtype="float8"), r"card\.json is damaged: dtype 'float8' is not one of float32, bfloat16"),
        (lambda path: edit(path / "card.json", dtype="bfloat16"), r"weights\.npz is not what its card says: leaf \S+ is float32"),
        (lambda path: other_weights(path, b"text"), r"weights\.npz is not what lala_jax\.publish writes"),
    ],
)
def test_damage_is_named(published, damage, message):
    damage(published)
    with pytest.raises(checkpoint.CheckpointError, match=message):
        pretrained.load(published)


def other_weights(path, content):
    (path / "weights.npz").write_bytes(content)
    edit(path / "card.json", sha256=hashlib.sha256(content).hexdigest())


def test_another_input_or_model_is_refused(published):
    other = tiny("map.slices=7")
    with pytest.raises(checkpoint.MismatchError, match="expects the input .*'slices': 14.*, the config makes .*'slices': 7"):
        scoring.check_checkpoint(str(published), other, build.build_policy(other))
    other = tiny("model.width=8")
    with pytest.raises(checkpoint.MismatchError, match=r"is of another model: \S+ is \(.*\) there, \(.*\) in the config"):
        scoring.check_checkpoint(str(published), other, build.build_policy(other))


def test_names_are_looked_up_in_the_package(published, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(pretrained, "WEIGHTS", tmp_path / "weights")
    with pytest.raises(checkpoint.CheckpointError, match="no pretrained policy 'tiny'; this installation has none"):
        pretrained.load("pretrained/tiny")
    for name in ("tiny", "tiny.tmp", "small"):
        shutil.copytree(published, tmp_path / "weights" / name)
    assert pretrained.names() == ["small", "tiny"]
    assert bits(pretrained.load("pretrained/tiny")[0]) == bits(pretrained.load(published)[0])
    for wrong in ("castle", "tiny/best", "..", ""):
        with pytest.raises(checkpoint.CheckpointError, match=f"no pretrained policy '{wrong}'; valid: pretrained/small, pretrained/tiny"):
            evaluate.stored_config({"checkpoint": f"pretrained/{wrong}"})
    (tmp_path / "pretrained" / "tiny").mkdir(parents=True)
    with pytest.raises(checkpoint.CheckpointError, match="no checkpoint at"):  # the working directory comes first
        pretrained.load("pretrained/tiny")


def test_scores_of_the_same_weights_elsewhere_are_taken(run, published, tmp_path):
    card = publish.publish(str(published), [str(run[1])], tmp_path / "out")  # the scores name the run's checkpoint
    assert card["sha256"] == pretrained.card(published)["sha256"]
    rounded = tmp_path / "rounded"
    publish.publish(str(run[0]), [str(run[1])], rounded, dtype="bfloat16")
    with pytest.raises(options.OptionsError, match="holds scores of .*, not of .*rounded"):
        publish.publish(str(rounded), [str(run[1])], tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"checkpoint": "runs/other/checkpoints", "weights": ...}, "holds scores of runs/other/checkpoints, not of"),  # an older file
        ({"weights": {"step": 7, "crc32": 1}}, r"holds scores of .*checkpoints, when it held {'step': 7, 'crc32': 1}, not of"),
        ({"agent": "oracle", "checkpoint": None, "weights": None}, "holds scores of oracle, not of"),
        ({"config": {"model": {"width": 99}}}, r"holds scores of another model.width \(99 there, 4 here\)"),
        ({"config": {"task": {"name": "pallet"}}}, r"holds scores of another task.name \('pallet' there, 'tower' here\)"),
        ({"config": {"camera": {"preset": "paper"}}}, r"another camera.preset \('paper' there, 'ring' here\)"),
        ({"interval95": [None, None]}, "a score without an interval"),
        ({"seeds": [10_002, 10_002]}, "2 episodes of the test split are not seeds 10002 to 10002"),
        ({"score": ...}, "is no file of scores: KeyError 'score'"),
    ],
)
def test_scores_of_something_else_are_refused(run, tmp_path, change, message):
    fields = json.loads(run[1].read_text())
    groups = {group: {**fields["config"][group], **values} for group, values in change.get("config", {}).items()}
    changed = {**fields, **change, "config": {**fields["config"], **groups}}
    (tmp_path / "scores.json").write_text(json.dumps({name: value for name, value in changed.items() if value is not ...}))
    with pytest.raises(options.OptionsError, match=message):
        publish.publish(str(run[0]), [str(tmp_path / "scores.json")], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_is_not_published_weights_is_left_alone(run, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "README.md").write_text("mine")
    with pytest.raises(options.OptionsError, match="holds something else than published weights"):
        publish.publish(str(run[0]), [str(run[1])], tmp_path / "out")
    assert (tmp_path / "out" / "README.md").read_text() == "mine"


def test_a_failed_write_leaves_what_was_there(run, published, monkeypatch):
    before = contents(published)
    real = publish.os.replace

    def fail(source, target):
        if pathlib.Path(target) == published and pathlib.Path(source).name == "new":
            raise OSError("the disk is full")
        real(source, target)

    monkeypatch.setattr(publish.os, "replace", fail)
    with pytest.raises(OSError, match="full"):
        publish.publish(str(run[0]), [str(run[1])], published, dtype="bfloat16")
    assert contents(published) == before
    assert [path.name for path in published.parent.iterdir()] == ["tiny"]


def test_too_large_or_not_float32_is_refused(run, tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "LARGEST", 1000)
    with pytest.raises(checkpoint.CheckpointError, match=r"at most 1,000; try --dtype=bfloat16"):
        publish.publish(str(run[0]), [str(run[1])], tmp_path / "out")
    with pytest.raises(checkpoint.CheckpointError, match="leaf a/b is int32: only float32"):
        pretrained.pack({"a": {"b": np.zeros(3, np.int32)}}, "float32")
    with pytest.raises(options.OptionsError, match="--dtype must be one of 'float32', 'bfloat16', got 'float16'"):
        publish.publish(str(run[0]), [str(run[1])], tmp_path / "out", dtype="float16")


ROW = {"score": 81.25, "interval95": [70.0, 92.5], "complete_percent": 40.0, "episodes": 50}


def test_other_worlds_are_tabled(run, tmp_path):
    file = tmp_path / "robustness.json"
    rows = {"one camera missing": {**ROW, "per_episode": []}}
    file.write_text(json.dumps({"task": "tower", "split": "test", "checkpoint": str(run[0]), "rows": [], "conditions": rows}))
    card = publish.publish(str(run[0]), [str(run[1])], tmp_path / "out", robustness=str(file))
    stored = {"file": str(file), "split": "test", "conditions": [{"condition": "one camera missing", **ROW}]}
    assert card["robustness"] == stored and pretrained.card(tmp_path / "out") == card
    assert "| one camera missing | 50 | 81.2 [70.0, 92.5] | 40% |" in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"task": "pallet", "checkpoint": "", "conditions": {}}, "holds scores of pallet, .*, not of tower"),
        ({"task": "tower", "checkpoint": "runs/other", "conditions": {}}, "holds scores of tower, runs/other, not of tower"),
        ({"dark": {}}, "is no table of conditions"),
        ([], "is no table of conditions"),
    ],
)
def test_wrong_tables_are_refused(run, tmp_path, table, message):
    (tmp_path / "robustness.json").write_text(json.dumps(table))
    with pytest.raises(options.OptionsError, match=message):
        publish.publish(str(run[0]), [str(run[1])], tmp_path / "out", robustness=str(tmp_path / "robustness.json"))


def test_the_command(run, tmp_path, call):
    given = [f"--checkpoint={run[0]}", f"--scores={run[1]}", f"--out={tmp_path / 'out'}"]
    said = call("lala_jax.publish", *given).out
    assert "parameters, float32, 0." in said and f"python -m lala_jax.evaluate --checkpoint={tmp_path / 'out'}" in said
    for arguments, message in [
        (given[:2], "give --out=PATH"),
        (given[1:2], "give --checkpoint=PATH and --out=PATH"),
        ([*given, "--config.model.width=8"], "leave --config out"),
        ([f"--checkpoint={tmp_path}", *given[1:]], "no checkpoint at"),
        ([given[0], f"--scores={tmp_path}/none.json", given[2]], "cannot read .*none.json"),
    ]:
        refused(call("lala_jax.publish", *arguments), message)


def test_the_card_names_what_others_trained():
    card = pretrained.card("pretrained/tower")
    for changes, told in (
        ({}, "no other data, no pretrained parts. "),
        ({"camera": {"backbone": "mine.npz", "stage": "conv2"}}, "but frozen pretrained parts: features of mine.npz (conv2). "),
        ({"model": {"name": "cliport"}}, "but frozen pretrained parts: features of resnet50_imagenet_v1, MiniLM's sentences. "),
        ({"train": {"start": "pretrained/tower"}}, "no pretrained parts; begun from the weights pretrained/tower. "),
        ({"model": {"name": "cliport", "clip": "RN50.npz"}}, "but frozen pretrained parts: CLIP's towers (RN50.npz). "),
    ):
        config = {**card["config"], **{group: card["config"][group] | own for group, own in changes.items()}}
        assert told in publish.model_card(card | {"config": config})
    text = publish.model_card(card | {"data": card["data"] | {"source": "by hand, on our UR5e"}})
    assert f"{card['data']['demonstrations']} demonstrations: by hand, on our UR5e; no pretrained parts. Training seed" in text
    assert not [words for words in ("oracle", "never run", "never show", "no other data") if words in text]
    assert "of simulation only" in text


def test_the_weights_in_the_package_are_whole():
    """Both of the paper's tasks have some: they load, fit the config, are small, and have all three files."""
    assert pretrained.names() == ["pallet", "tower"]
    for name in pretrained.names():
        card = pretrained.card(f"pretrained/{name}")
        assert card is not None and card["name"] == name == card["config"]["task"]["name"] and card["scores"]
        folder = pretrained.WEIGHTS / name
        assert {path.name for path in folder.iterdir()} == {"weights.npz", "card.json", "README.md"}
        assert (folder / "weights.npz").stat().st_size <= publish.LARGEST
        assert (folder / "README.md").read_text() == publish.model_card(card)
        config = options.from_dict(card["config"])
        scoring.check_checkpoint(f"pretrained/{name}", config, build.build_policy(config))
