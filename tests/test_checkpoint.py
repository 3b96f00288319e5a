"""Checkpoints: bit-identical, never half, never silently wrong, never of another model."""

import json
import os
import pathlib
import signal
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

from lala_jax import checkpoint

FACTS = {"config": {"model": {"width": 4, "size": (2, 3)}}, "input_spec": {"channels": 7}}


@struct.dataclass
class State:
    step: jax.Array
    params: dict
    opt: optax.OptState
    rest: tuple


def make_state(value=0, *, width=4):
    """A state with the kinds of leaves that training has, in bits that depend on `value`."""
    key = jax.random.fold_in(jax.random.key(0), value)
    params = {
        "dense": {"kernel": jax.random.normal(key, (width, 5)), "bias": jnp.full((5,), value, jnp.bfloat16)},
        "none": jnp.zeros((0, 2)),
    }
    return State(step=jnp.int32(value), params=params, opt=optax.adam(1e-3).init(params), rest=(np.int64(2**40 + value), True, 0.1))


def bits(tree):
    return [(np.asarray(leaf).dtype, np.shape(leaf), np.asarray(leaf).tobytes()) for leaf in jax.tree.leaves(tree)]


def payload_files(folder, step):
    """The files under a step that hold the arrays' bytes."""
    return [path for path in sorted((folder / str(step)).rglob("*")) if path.is_file() and path.parent.name == "d"]


@pytest.fixture
def directory(tmp_path):
    checkpoints = checkpoint.Checkpoints(tmp_path, keep=3)
    for step in (10, 20, 30):
        checkpoints.save_latest(step, make_state(step), **FACTS)
    return tmp_path


def test_restore_is_bit_identical(directory):
    step, state = checkpoint.Checkpoints(directory).restore_latest(make_state())
    assert step == 30 and bits(state) == bits(make_state(30))
    assert jax.tree.structure(state) == jax.tree.structure(make_state(30))
    assert isinstance(state.params["dense"]["kernel"], jax.Array) and type(state.rest[1]) is bool and type(state.rest[2]) is float


def test_restore_into_shapes_and_shardings(tmp_path):
    state = {"params": {"w": jnp.arange(8.0)}}
    checkpoint.Checkpoints(tmp_path).save_latest(1, state, **FACTS)
    sharding = jax.sharding.SingleDeviceSharding(jax.devices()[-1])
    template = {"params": {"w": jax.ShapeDtypeStruct((8,), jnp.float32, sharding=sharding)}}
    _, restored = checkpoint.Checkpoints(tmp_path).restore_latest(template)
    assert restored["params"]["w"].sharding == sharding and bits(restored) == bits(state)
    assert bits(checkpoint.Checkpoints(tmp_path).restore_latest(jax.eval_shape(lambda: state))[1]) == bits(state)


def test_nothing_saved_yet(tmp_path):
    assert checkpoint.Checkpoints(tmp_path / "new").restore_latest(make_state()) is None
    with pytest.raises(checkpoint.CheckpointError, match="no checkpoint at"):
        checkpoint.load(tmp_path / "new")


def test_a_path_is_enough(directory):
    checkpoint.Checkpoints(directory).save_best(20, make_state(20), 40.0, **FACTS)
    for path, step in [(directory, 20), (directory / "latest" / "10", 10)]:
        state, config, input_spec = checkpoint.load(path)
        assert bits(state["params"]) == bits(make_state(step).params)
        assert jax.tree.structure(state["params"]) == jax.tree.structure(make_state(step).params)
        assert config == {"model": {"width": 4, "size": [2, 3]}} and input_spec == {"channels": 7}
    assert int(checkpoint.load(directory, which="latest")[0]["step"]) == 30
    assert bits(checkpoint.load(directory, make_state())[0]) == bits(make_state(20))
    facts = checkpoint.describe(directory)
    assert facts["step"] == 20 and facts["score"] == 40.0 and facts["leaves"]["params/dense/kernel"]["shape"] == [4, 5]
    with pytest.raises(checkpoint.CheckpointError, match="one of 'best', 'latest', got 'newest'"):
        checkpoint.load(directory, which="newest")


def test_only_the_newest_stay(directory):
    checkpoint.Checkpoints(directory, keep=2).save_latest(40, make_state(40), **FACTS)
    assert sorted(path.name for path in (directory / "latest").iterdir()) == ["30", "30.json", "40", "40.json"]
    with pytest.raises(checkpoint.CheckpointError, match="keep must be at least 1, got 0"):
        checkpoint.Checkpoints(directory, keep=0)


def test_best_is_the_best(tmp_path):
    checkpoints = checkpoint.Checkpoints(tmp_path)
    saved = [checkpoints.save_best(step, make_state(step), score, **FACTS) for step, score in [(1, 5.0), (2, 5.0), (3, 4.0), (4, 6.0)]]
    assert saved == [True, True, False, True]  # of two equal scores the later one stays
    assert sorted(path.name for path in (tmp_path / "best").iterdir()) == ["4", "4.json"]
    assert not checkpoint.Checkpoints(tmp_path).save_best(5, make_state(5), 5.5, **FACTS)
    with pytest.raises(checkpoint.CheckpointError, match="score of step 6 must be finite, got nan"):
        checkpoints.save_best(6, make_state(6), float("nan"), **FACTS)
    (tmp_path / "best" / "4.json").write_text("{")
    assert checkpoints.save_best(7, make_state(7), 1.0, **FACTS)
    assert sorted(path.name for path in (tmp_path / "best").iterdir()) == ["7", "7.json"]


def test_another_model_is_named(directory):
    checkpoints = checkpoint.Checkpoints(directory)
    message = r"leaf params/dense/kernel is float32 \[4, 5\] in the checkpoint, float32 \[6, 5\] here"
    with pytest.raises(checkpoint.MismatchError, match=message):
        checkpoints.restore_latest(make_state(width=6))
    with pytest.raises(checkpoint.MismatchError, match=message):
        checkpoint.load(directory, make_state(width=6))
    other = make_state()
    cast = other.replace(step=jnp.float32(0))
    with pytest.raises(checkpoint.MismatchError, match=r"leaf step is int32 \[\] in the checkpoint, float32 \[\] here"):
        checkpoints.restore_latest(cast)
    more = other.replace(params={**other.params, "more": jnp.zeros(3)})
    with pytest.raises(checkpoint.MismatchError, match=r"leaf params/more is absent in the checkpoint, float32 \[3\] here"):
        checkpoints.restore_latest(more)


@pytest.mark.parametrize("seed", range(3))
def test_every_flipped_byte_is_caught(directory, seed, caplog):
    """Flip one bit anywhere under the newest step: the step before is taken."""
    rng = np.random.default_rng(seed)
    files = [path for path in (directory / "latest" / "30").rglob("*") if path.is_file() and path.stat().st_size]
    files += [directory / "latest" / "30.json"] + payload_files(directory / "latest", 30) * 2
    for _ in range(15):
        path = files[rng.integers(len(files))]
        whole = path.read_bytes()
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        step, state = checkpoint.Checkpoints(directory).restore_latest(make_state())
        harmless = path.suffix == ".json" and step == 30  # white space turned into other white space
        assert (step == 20 or harmless) and bits(state) == bits(make_state(step))
        path.write_bytes(whole)
    assert "passing over" in caplog.text


def test_leaves_are_compared_too(directory):
    """A payload whose files are as written, but whose arrays are not what was saved."""
    side = directory / "latest" / "30.json"
    fields = {key: value for key, value in json.loads(side.read_text()).items() if key != "crc32"}
    fields["leaves"]["params/dense/kernel"]["crc32"] += 1
    side.write_text(json.dumps({**fields, "crc32": checkpoint._digest(fields)}))
    assert checkpoint.Checkpoints(directory).restore_latest(make_state())[0] == 20
    with pytest.raises(checkpoint.CheckpointError, match="leaf params/dense/kernel does not match its checksum"):
        checkpoint.load(directory / "latest" / "30")


def test_a_run_goes_on_past_damage(directory):
    """The damaged newest step is passed over, replaced, and never counted among those kept."""
    for path in payload_files(directory / "latest", 30):
        path.write_bytes(path.read_bytes()[:-8])
    checkpoints = checkpoint.Checkpoints(directory, keep=2)
    assert checkpoints.restore_latest(make_state())[0] == 20
    checkpoints.save_latest(25, make_state(25), **FACTS)
    assert checkpoint.Checkpoints(directory).restore_latest(make_state())[0] == 25
    assert sorted(path.name for path in (directory / "latest").iterdir()) == ["20", "20.json", "25", "25.json"]


@pytest.mark.parametrize("damage", ["side missing", "side truncated", "side of another version", "payload missing", "payload emptied"])
def test_a_broken_step_is_passed_over(directory, damage):
    side = directory / "latest" / "30.json"
    if damage == "side missing":
        side.unlink()
    elif damage == "side truncated":
        side.write_bytes(side.read_bytes()[:100])
    elif damage == "side of another version":
        fields = {**json.loads(side.read_text()), "version": 9}
        fields["crc32"] = checkpoint._digest(fields)
        side.write_text(json.dumps(fields))
    elif damage == "payload missing":
        os.rename(side.with_suffix(""), directory / "elsewhere")
    else:
        for path in side.with_suffix("").rglob("*"):
            if path.is_file():
                path.write_bytes(b"")
    assert checkpoint.Checkpoints(directory).restore_latest(make_state())[0] == 20
    assert int(checkpoint.load(directory)[0]["step"]) == checkpoint.describe(directory)["step"] == 20


def test_nothing_intact(directory):
    for step in (10, 20, 30):
        for path in payload_files(directory / "latest", step):
            path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(checkpoint.CheckpointError, match=r"(?s)no intact checkpoint.*30.*20.*10"):
        checkpoint.Checkpoints(directory).restore_latest(make_state())
    for read in (checkpoint.load, checkpoint.describe):
        with pytest.raises(checkpoint.CheckpointError, match="no intact checkpoint"):
            read(directory)


def test_a_newer_run_is_not_overwritten(directory):
    with pytest.raises(checkpoint.CheckpointError, match="holds step 30 already, newer than 5"):
        checkpoint.Checkpoints(directory).save_latest(5, make_state(5), **FACTS)


def test_saving_the_same_step_again(directory):
    before = {path: path.stat().st_mtime_ns for path in (directory / "latest").rglob("*")}
    checkpoint.Checkpoints(directory, keep=3).save_latest(30, make_state(30), **FACTS)
    assert {path: path.stat().st_mtime_ns for path in (directory / "latest").rglob("*")} == before
    checkpoint.Checkpoints(directory, keep=3).save_latest(30, make_state(31), **FACTS)
    step, state = checkpoint.Checkpoints(directory).restore_latest(make_state())
    assert step == 30 and bits(state) == bits(make_state(31))


def test_states_that_cannot_be_stored(tmp_path):
    checkpoints = checkpoint.Checkpoints(tmp_path)
    for state, message in [
        ({"key": jax.random.key(0)}, "leaf key is a typed PRNG key"),
        ({"f": len}, "leaf f is builtin_function_or_method"),
        ({}, "no leaves"),
        ({"a": {"b": 1}, "a/b": 2}, "both named 'a/b'"),
    ]:
        with pytest.raises(checkpoint.CheckpointError, match=message):
            checkpoints.save_latest(1, state, **FACTS)
    assert checkpoints.restore_latest({"a": 1}) is None


def test_signals_become_a_question():
    before = signal.getsignal(signal.SIGTERM)
    with checkpoint.stop_signals() as stopped:
        assert not stopped()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stopped()
    assert signal.getsignal(signal.SIGTERM) is before


PROGRAM = """
import sys, numpy as np
from lala_jax import checkpoint
checkpoints = checkpoint.Checkpoints(sys.argv[1], keep=2)
step = (checkpoints.restore_latest({"w": np.zeros(200_000)}) or (0, None))[0]
print(step, flush=True)
with checkpoint.stop_signals() as stopped:
    while not stopped():
        step += 1
        checkpoints.save_latest(step, {"w": np.full(200_000, float(step))}, config={}, input_spec={})
        print(step, flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_killed_run_loses_no_committed_step(tmp_path, number):
    root = pathlib.Path(checkpoint.__file__).resolve().parent.parent
    command = [sys.executable, "-c", PROGRAM, str(tmp_path)]
    known = 0
    for reports in (3, 6) if number == signal.SIGKILL else (4,):
        with subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True) as process:
            seen = [int(process.stdout.readline()) for _ in range(reports)]
            process.send_signal(number)
            seen += [int(line) for line in process.stdout]
        assert process.returncode == (0 if number == signal.SIGTERM else -signal.SIGKILL)
        assert seen[0] >= known
        known = seen[-1]
    step, state = checkpoint.Checkpoints(tmp_path).restore_latest({"w": np.zeros(200_000)})
    assert step >= known and (state["w"] == step).all()
    assert step == known or number == signal.SIGKILL
