"""The commands end to end: what they leave behind, that they go on, and that a wrong request gets one clear message and status 2.

Training runs as a process of its own; what follows runs each module's `__main__` here, which saves the start of a process.
"""

import collections
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import types

import numpy as np
import pytest
from test_train_step import OVERRIDES

from lala_jax import dataset

ROOT = pathlib.Path(__file__).parent.parent
SMALL = ("data.demos=2", "train.log_every=1", "train.save_every=1", "train.eval_every=2", "train.eval_episodes=1")
SMALL += ("eval.episodes=1", "eval.parallel=1", "eval.strips=1")


def tiny(directory, *more, config="configs/tower.py:smoke"):
    """The arguments of a run that takes seconds."""
    return [f"--config={config}", *(f"--config.{text}" for text in (*OVERRIDES, *SMALL, f"data.directory={directory}", *more))]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A finished training: `(data directory, work directory, what it said)`."""
    path = tmp_path_factory.mktemp("cli")
    command = [sys.executable, "-m", "lala_jax.train", f"--workdir={path / 'run'}", *tiny(path / "data")]
    environment = {**os.environ, "JAX_LOG_COMPILES": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    (path / "compilations").write_text(done.stderr)
    return path / "data", path / "run", done.stdout


def contents(path):
    return {file.relative_to(path).as_posix(): file.read_bytes() for file in path.rglob("*") if file.is_file()}


def test_training_leaves_everything_behind(trained):
    data, workdir, said = trained
    demos, meta = dataset.load(data)
    assert len(demos) == 2 and meta["task"] == "tower" and [int(demo.seed) for demo in demos] == [0, 2]
    assert json.loads((workdir / "config.json").read_text())["task"]["num_objects"] == 2
    lines = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "loss" in line] == [1, 2] and [line["step"] for line in lines if "val_score" in line] == [2]
    assert {path.name for path in (workdir / "checkpoints" / "latest").glob("*.json")} == {"1.json", "2.json"}
    assert [path.name for path in (workdir / "checkpoints" / "best").glob("*.json")] == ["2.json"]
    scores = json.loads((workdir / "scores-policy-val.json").read_text())
    assert scores["episodes"] == 1 and scores["seeds"] == [1, 1] and 0 <= scores["score"] <= 100
    assert (workdir / "episode-val-0.webp").stat().st_size > 1000
    assert re.search(r"4 states, step 0\ncompiling the training step\ncompiled in \d+ s; a step needs \d+ MiB of memory\n", said)
    assert "step 2 of 2" in said and "tower policy, val split, 1 episodes: score" in said


def test_every_program_was_compiled_once(trained):
    """Training, validation and scoring: no program of ours is compiled twice for the same shapes, and the step only once."""
    log = (trained[1].parent / "compilations").read_text()
    programs = collections.Counter(
        re.findall(r"Compiling jit\((train_step|act_batch|observe_batch)\) with global shapes and types (.*)", log)
    )
    assert {name for name, _ in programs} == {"train_step", "act_batch", "observe_batch"}
    assert set(programs.values()) == {1} and sum(name == "train_step" for name, _ in programs) == 1


def test_the_same_command_again_finds_it_complete(trained, call):
    data, workdir, _ = trained
    before = contents(workdir / "checkpoints")
    answer = call("lala_jax.train", f"--workdir={workdir}", *tiny(data))
    assert answer.status == 0 and "4 states, step 2" in answer.out and "val split, 1 episodes: score" in answer.out
    assert contents(workdir / "checkpoints") == before


def test_another_setting_needs_another_workdir(trained, call, tmp_path):
    data, workdir, _ = trained
    before = (workdir / "config.json").read_bytes()
    refused(
        call("lala_jax.train", f"--workdir={workdir}", *tiny(data, "optim.learning_rate=0.5")),
        r"another optim.learning_rate \(0.001 there, 0.5 here\)",
    )
    answer = call("lala_jax.train", f"--workdir={workdir}", *tiny(data, "model.width=8"))
    refused(answer, r"another model.width \(\d+ there, 8 here\): choose another --workdir")
    demos, meta = dataset.load(data)
    dataset.save(tmp_path / "own", demos[::-1], task=meta["task"], task_options=meta["task_options"])
    answer = call("lala_jax.train", f"--workdir={workdir}", *tiny(tmp_path / "own"))
    refused(answer, rf"learnt from other demonstrations than those in {tmp_path / 'own'}: choose another --workdir")
    shutil.copytree(data, tmp_path / "moved")
    assert call("lala_jax.train", f"--workdir={workdir}", *tiny(tmp_path / "moved")).status == 0
    assert call("lala_jax.train", f"--workdir={workdir}", *tiny(data)).status == 0
    assert (workdir / "config.json").read_bytes() == before


def test_evaluation_of_a_checkpoint_through_other_cameras(trained, call, tmp_path):
    """The config comes from the checkpoint; split, range, number and cameras from the command line."""
    _, workdir, _ = trained
    where = f"--checkpoint={workdir / 'checkpoints'}"
    options = ["--split=test", "--start=2", "--episodes=2", "--config.camera.preset=paper"]
    answer = call("lala_jax.evaluate", where, f"--workdir={tmp_path}", *options)
    assert answer.status == 0 and "2 of 2 episodes" in answer.out
    scores = json.loads((tmp_path / "scores-policy-test.json").read_text())
    assert scores["seeds"] == [10_003, 10_004] and [line["seed"] for line in scores["per_episode"]] == scores["seeds"]
    assert scores["config"]["camera"]["preset"] == "paper" and scores["config"]["task"]["num_objects"] == 2
    assert (tmp_path / "episode-test-0.webp").exists()


def test_weights_of_another_task_are_told(trained, call, tmp_path):
    where = [f"--checkpoint={trained[1] / 'checkpoints'}", f"--workdir={tmp_path}", "--episodes=1"]
    answer = call("lala_jax.evaluate", *where, "--config.task.name=pallet", "--config.task.num_objects=0")
    assert answer.status == 0 and "checkpoints was trained on tower, this is pallet" in answer.out
    assert ", first to go wrong: 1 " in answer.out and "[nan" not in answer.out


def test_the_oracle_needs_no_checkpoint(trained, call, tmp_path):
    answer = call("lala_jax.evaluate", "--agent=oracle", f"--workdir={tmp_path}", *tiny(trained[0]))
    assert answer.status == 0 and json.loads((tmp_path / "scores-oracle-val.json").read_text())["score"] == 100


def test_collection_goes_on_where_it_stopped(trained, call, tmp_path):
    """Asking for more than there is makes the rest, and touches nothing that is there; asking for less leaves all alone."""
    shutil.copytree(trained[0], tmp_path / "data")
    before = contents(tmp_path / "data")
    answer = call("lala_jax.collect", *tiny(tmp_path / "data", "data.demos=1"))
    assert answer.status == 0 and contents(tmp_path / "data") == before and str(tmp_path / "data") in answer.out
    answer = call("lala_jax.collect", *tiny(tmp_path / "data", "data.demos=3"))
    assert answer.status == 0 and f"{tmp_path / 'data'} holds 2 demonstrations: recording 1 more in simulation" in answer.out
    assert before.items() < contents(tmp_path / "data").items()
    np.testing.assert_array_equal(dataset.seeds(tmp_path / "data"), [0, 2, 4])


def refused(answer, *messages):
    """Status 2, one message that fits a screen, no traceback."""
    assert answer.status == 2, answer
    assert "Traceback" not in answer.err and len(answer.err.splitlines()) <= 24
    for message in messages:
        assert re.search(message, answer.err), answer.err


@pytest.mark.parametrize(
    ("change", "messages"),
    [
        ("train.stpes=3", ["unknown config field train.stpes; did you mean train.steps", "fields of train: .*batch_size"]),
        ("train.steps=many", ["config field train.steps must be an int like 2, got 'many'"]),
        ("train.batch_size=0", ["config field train.batch_size must be above 0, got 0"]),
        ("task.name=castle", ["task.name must be one of 'pallet', 'tower', got 'castle'"]),
        ("task.num_objects=9", ["num_objects=9 is not one of 1..6"]),
        ("task.colors=loud", ["task.colors must be one of 'paper', 'code', 'uniform', got 'loud'"]),
        ("camera.preset=moon", ["camera.preset must be one of 'ring', 'paper', got 'moon'"]),
        ("model.name=lstm", ["model.name must be one of 'goal_aware', 'single', .*got 'lstm'"]),
        ("model.crop=6", ["goal_aware needs map rows, map cols and model.crop in multiples of 4, got 80, 40 and 6"]),
        ("map.cell=0.3", ["MapSpec.x .* not a whole number"]),
        ("optim.clip=0.0", [r"config field optim.clip must be above 0 \(inf for no clipping\), got 0.0"]),
        ("optim.learning_rate=-1.0", ["config field optim.learning_rate must be above 0, got -1.0"]),
        ("optim.warmup=-1", ["config field optim.warmup must be at least 0, got -1"]),
        ("model.trunk_blocks=-1", ["config field model.trunk_blocks must be above 0, got -1"]),
        ("camera.shift=-1.0", ["config field camera.shift must be at least 0, got -1.0"]),
        ("data.demos=-3", ["config field data.demos must be above 0, got -3"]),
        ("data.demos=6000", [r"the train split has 5000 seeds, asked for 0\.\.5999"]),
        ("augment.missing=10.0", ["config field augment.missing must be at least 0 and at most 1, got 10.0"]),
        ("augment.turn=-1.0", ["config field augment.turn must be at least 0, got -1.0"]),
        ("data.threads=-1", ["config field data.threads must be at least 0, got -1"]),
        ("eval.parallel=0", ["config field eval.parallel must be above 0, got 0"]),
        ("eval.split=tset", ["eval.split must be one of 'train', 'val', 'test', got 'tset'; did you mean test"]),
        ("eval.episodes=0", ["at least one seed, got start=0, count=0"]),
        ("train.eval_episodes=1001", [r"the val split has 5000 seeds, asked for 4000\.\."]),
        ("optim.schedule=linear", ["optim.schedule must be one of 'cosine', 'constant', got 'linear'"]),
    ],
)
def test_a_wrong_field_is_refused(call, tmp_path, change, messages):
    refused(call("lala_jax.train", f"--workdir={tmp_path / 'run'}", *tiny(tmp_path / "data", change)), *messages)
    assert not (tmp_path / "data").exists() and not (tmp_path / "run").exists()


def test_a_process_ends_with_status_2(tmp_path):
    """The whole way out, once: what a shell sees."""
    command = [sys.executable, "-m", "lala_jax.collect", "--config=configs/towr.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    answer = types.SimpleNamespace(status=done.returncode, err=done.stderr)
    refused(answer, r"lala_jax.collect: no config file configs/towr.py", "did you mean .*tower.py")


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        ([], ["give --checkpoint=PATH, or --config=FILE.py with --agent=oracle, blind or top_view"]),
        (["--checkpoint=nowhere"], ["no checkpoint at .*nowhere"]),
        (["--chekpoint=nowhere"], ["unknown argument '--chekpoint=nowhere'; did you mean --checkpoint"]),
        (["--config=configs/tower.py", "--agent=random"], ["--agent must be one of 'policy', 'oracle', 'blind', 'top_view', got 'random'"]),
        (["--config=configs/tower.py", "--agent=oracle", "--split=dev"], ["split must be one of 'train', 'val', 'test', got 'dev'"]),
        (["--config=configs/tower.py", "--agent=oracle", "--start=4990"], [r"the val split has 5000 seeds, asked for 4990\.\."]),
        (["--config=configs/tower.py", "--agent=oracle", "--start=-5"], ["a seed range needs start >= 0 .*, got start=-5"]),
        (["--config=configs/tower.py", "--agent=oracle", "--episodes=0"], ["at least one seed, got start=0, count=0"]),
        (["--config=configs/tower.py:small"], [r"config argument must be one of \('', 'smoke', 'paper'\), got 'small'"]),
    ],
)
def test_a_wrong_evaluation_is_refused(call, tmp_path, arguments, messages):
    refused(call("lala_jax.evaluate", f"--workdir={tmp_path / 'out'}", *arguments), *messages)
    assert not (tmp_path / "out").exists()


def test_evaluation_without_a_checkpoint_or_another_agent_is_refused(trained, call, tmp_path):
    """A config alone names no parameters."""
    refused(call("lala_jax.evaluate", f"--workdir={tmp_path / 'out'}", *tiny(trained[0])), "give --checkpoint=PATH")


def test_a_checkpoint_of_another_size_is_refused(trained, call, tmp_path):
    where = f"--checkpoint={trained[1] / 'checkpoints'}"
    refused(
        call("lala_jax.evaluate", where, f"--workdir={tmp_path}", "--config.model.width=8"),
        r"is of another model: \S+ is \(\S.*\) there, \(\S.*\) in the config",
    )


def test_near_misses_of_a_checkpoint_are_told(trained, call, tmp_path):
    own = trained[1] / "checkpoints"
    for wrong in (trained[1], own / "latest", own / "latest" / "7"):
        answer = call("lala_jax.evaluate", f"--checkpoint={wrong}", f"--workdir={tmp_path}")
        refused(answer, rf"did you mean {own}, or one of its steps, {own}/best/\d, .*{own}/latest/2")


def test_what_cannot_be_written_is_told_before_the_work(trained, call, tmp_path):
    (tmp_path / "file").write_text("")
    asked = f"--workdir={tmp_path / 'file' / 'x'}"
    for answer in (
        call("lala_jax.train", asked, *tiny(trained[0])),
        call("lala_jax.evaluate", asked, "--agent=oracle", "--episodes=1", *tiny(trained[0])),
        call("lala_jax.collect", *tiny(tmp_path / "file")),
    ):
        refused(answer, rf"cannot read or write {tmp_path / 'file'}.*: (Not a directory|File exists)")


def test_collection_is_refused_what_cannot_be(call, tmp_path):
    refused(call("lala_jax.collect", *tiny(tmp_path / "data", "data.demos=0")), "config field data.demos must be above 0, got 0")
    refused(call("lala_jax.collect", *tiny(tmp_path / "data", "data.threads=-1")), "config field data.threads must be at least 0, got -1")
    assert not (tmp_path / "data").exists()


def test_truncated_demonstrations_are_refused(trained, call, tmp_path):
    shutil.copytree(trained[0], tmp_path / "data")
    shard = next((tmp_path / "data").glob("*.demo"))
    shard.write_bytes(shard.read_bytes()[:-100])
    for module in ("lala_jax.collect", "lala_jax.train"):
        refused(call(module, f"--workdir={tmp_path / 'run'}", *tiny(tmp_path / "data")), f"{shard.name} is truncated")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("change", "config", "message"),
    [
        ("task.num_objects=3", "configs/tower.py:smoke", r"holds task_options \{'num_objects': 2, .*\}, not \{'num_objects': 3, "),
        ("task.num_objects=8", "configs/pallet.py:smoke", "holds task 'tower', not 'pallet'"),
    ],
)
def test_demonstrations_of_another_task_are_refused(trained, call, tmp_path, change, config, message):
    """Before anything is added to them, also where more are asked for than there are."""
    before = contents(trained[0])
    for demos in ("data.demos=2", "data.demos=9"):
        refused(call("lala_jax.train", f"--workdir={tmp_path / 'run'}", *tiny(trained[0], change, demos, config=config)), message)
    assert contents(trained[0]) == before
