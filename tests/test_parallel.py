"""Several devices and processes: the same examples, losses and files as with one; state split over devices restores on any number.

Devices are simulated, in processes of their own.
"""

import functools
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import jax
import numpy as np
import parallel_program as program
import pytest
from test_train_step import OVERRIDES, bits

from lala_jax import build, checkpoint, loop, options, parallel, train

ROOT = pathlib.Path(__file__).parent.parent
ROUNDING = "pick_out/bias"  # what is added to all logits of a softmax: its gradient is zero but for rounding
ALONE = ("JAX_", "SLURM_", "OMPI_", "KUBERNETES_", "JOB_COMPLETION_INDEX")


def environment(**more):
    """That of a process of its own, whatever this one runs in; the compilation cache stays, and how programs are compiled."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(ALONE) or "CACHE" in name}
    return {**kept, "JAX_PLATFORMS": "cpu", "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]), **more}


def simulate(devices, *arguments):
    """Run the program on so many devices."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={devices}"
    command = [sys.executable, str(ROOT / "tests" / "parallel_program.py"), *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, env=environment(XLA_FLAGS=flags), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.fixture
def start_pair():
    """Start two processes of one run, on this machine; none outlives the test."""
    started = []
    yield lambda *command: _start(started, *command)
    for process in started:
        with process:
            process.kill()


def _start(started, *command):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    told = [environment(JAX_COORDINATOR_ADDRESS=address, JAX_NUM_PROCESSES="2", JAX_PROCESS_ID=str(i)) for i in range(2)]
    how = {"cwd": ROOT, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    pair = [subprocess.Popen([sys.executable, *map(str, command)], env=env, **how) for env in told]
    started.extend(pair)
    return pair


def finish(pair):
    """Wait for both: what each said, `(out, err)`, and their statuses."""
    said = [process.communicate(timeout=500) for process in pair]
    return said, [process.returncode for process in pair]


def stored(directory, name):
    """What `parallel_program.leave` left: leaves by name, and metrics."""
    return dict(np.load(directory / f"{name}.npz")), json.loads((directory / f"{name}.json").read_text())


def assert_same(found, expected, *, rtol):
    """Compare `(state, metrics of each step)`; a metric may be NaN in both."""
    (leaves, metrics), (run, reference) = found, expected
    assert [sorted(step) for step in metrics] == [sorted(step) for step in reference]
    for step, other in zip(metrics, reference, strict=True):
        np.testing.assert_allclose([step[name] for name in other], list(other.values()), rtol=rtol, err_msg=str(list(other)))
    for name, leaf in checkpoint.named(run).items():
        if not name.endswith(ROUNDING):
            np.testing.assert_allclose(leaves[name], leaf, rtol=rtol, atol=rtol * np.abs(leaf).max(initial=0), err_msg=name)


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    """What the probe left on eight devices."""
    directory = tmp_path_factory.mktemp("eight")
    simulate(8, "devices", directory)
    return directory


@functools.cache
def alone():
    """The probe on one device."""
    return program.advance(program.probe())


@pytest.mark.parametrize("kept", ["whole", "split"])
def test_eight_devices_learn_what_one_does(eight, kept):
    """Batch 8 on one device and 1 on each of eight: augmentation, pictures, noise, maps, metrics with NaN among them, parameters."""
    reds = [step["red"] for step in alone()[1]]
    assert np.isfinite(reds).all() and len(set(reds)) == 3
    assert_same(stored(eight, kept), alone(), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 8])
def test_the_default_agent_learns_the_same(tmp_path, number):
    simulate(number, "agents", tmp_path, number)
    assert_same(stored(tmp_path, "agent"), program.advance(program.agent(number)), rtol=1e-4)


def test_means_leave_out_nan_over_all_shares(tmp_path):
    simulate(8, "reductions", tmp_path)
    assert (tmp_path / "done").exists()


def test_a_batch_that_devices_cannot_share_is_refused(eight):
    assert "train.batch_size=12 cannot be shared alike by 8 devices" in (eight / "refused").read_text()


def test_a_split_state_restores_on_one_device(eight):
    """Eight devices to two and to eight is checked where those are."""
    leaves, _ = stored(eight, "split")
    restored = loop.start_or_resume(program.start(program.probe()), checkpoint.Checkpoints(eight), program.CONFIG, dict)
    assert bits(restored) == [(leaf.dtype, leaf.shape, leaf.tobytes()) for leaf in (leaves[name] for name in checkpoint.named(restored))]
    assert {leaf.sharding.device_set == {jax.devices()[0]} for leaf in jax.tree.leaves(restored)} == {True}


def test_damage_to_a_split_state_is_caught(eight):
    """A flipped bit in any file, and a leaf that is not what was saved."""
    folder, template = eight / "latest", program.start(program.probe())
    for path in [path for path in (folder / "3").rglob("*") if path.is_file() and path.stat().st_size]:
        whole = path.read_bytes()
        damaged = bytearray(whole)
        damaged[len(whole) // 2] ^= 1
        path.write_bytes(damaged)
        with pytest.raises(checkpoint.CheckpointError, match="does not match its checksum"):
            checkpoint.Checkpoints(eight).restore_latest(template)
        path.write_bytes(whole)
    side, text = folder / "3.json", (folder / "3.json").read_text()
    fields = {key: value for key, value in json.loads(text).items() if key != "crc32"}
    fields["leaves"]["params/in"]["crc32"] += 1
    side.write_text(json.dumps({**fields, "crc32": checkpoint._digest(fields)}))
    with pytest.raises(checkpoint.CheckpointError, match="leaf params/in does not match its checksum"):
        checkpoint.load(folder / "3")
    side.write_text(text)
    assert checkpoint.Checkpoints(eight).restore_latest(template)[0] == 3


def test_processes_share_answers_failures_and_checkpoints(start_pair, tmp_path):
    """And what two wrote one reads."""
    said, status = finish(start_pair("tests/parallel_program.py", "processes", tmp_path))
    assert status == [0, 0], said
    assert (tmp_path / "done-0").exists() and (tmp_path / "done-1").exists()
    assert sorted(path.name for path in (tmp_path / "checkpoints" / "latest").iterdir()) == ["2", "2.json"]
    found, *_ = checkpoint.load(tmp_path / "checkpoints")
    np.testing.assert_array_equal(found["own"], [1.0, 2.0, 3.0, 4.0])


# The graph policy sees no pictures, so that its step compiles fast; calibration is left out for the same reason.
SMALL = ("model.name=graph", "model.width=8", "camera.calibrate=false", "data.demos=2", "train.steps=4", "train.log_every=1")
SMALL += ("train.save_every=1", "train.eval_every=9", "train.eval_episodes=1", "eval.episodes=1", "eval.parallel=1", "eval.strips=1")


def said_by_us(out):
    """What a process printed, less what JAX's transport says when it connects."""
    return "".join(line for line in out.splitlines(keepends=True) if not line.startswith("[Gloo]"))


def rows(workdir):
    """The curve's losses by step."""
    lines = [json.loads(line) for line in (workdir / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines if "loss" in line}


def test_two_processes_are_one_run(start_pair, tmp_path):
    """One is told to stop, both do, at one step; started again they finish; one process could have gone on; one set of files."""
    workdir, changes = tmp_path / "run", (*OVERRIDES, *SMALL, f"data.directory={tmp_path / 'data'}")
    arguments = ["--config=configs/tower.py:smoke", f"--workdir={workdir}", *(f"--config.{text}" for text in changes)]
    pair = start_pair("-m", "lala_jax.train", *arguments)
    while not (workdir / "metrics.jsonl").exists() or not rows(workdir):
        assert pair[0].poll() is None, pair[0].communicate()[1]
        time.sleep(0.02)
    pair[1].send_signal(signal.SIGTERM)
    ((out, err), (silence, _)), status = finish(pair)
    stopped = max(rows(workdir))
    assert stopped < 4 and status == [1, 1], err
    assert f"stopped at step {stopped}" in err and "step 1 of 4" in out and said_by_us(silence) == ""
    assert int(checkpoint.load(workdir / "checkpoints", which="latest")[0]["step"]) == stopped

    config = options.load("configs/tower.py:smoke", changes)
    recipe, data, key = build.recipe(config), train.load_states(config), jax.random.key(config.seed)
    fresh = train.start_or_resume(config, recipe, checkpoint.Checkpoints(tmp_path / "none"))
    resumed, losses, late = train.start_or_resume(config, recipe, checkpoint.Checkpoints(workdir / "checkpoints")), {}, {}
    for run, seen in ((fresh, losses), (resumed, late)):
        for number in range(int(run.step) + 1, 5):
            run, metrics = train.step()(recipe, run, data, key, recipe.policy.frozen)
            seen[number] = float(metrics["loss"])
    assert sorted(late) == list(range(stopped + 1, 5))

    ((out, err), (silence, _)), status = finish(start_pair("-m", "lala_jax.train", *arguments))
    assert status == [0, 0], err
    assert "val split, 1 episodes: score" in out and said_by_us(silence) == ""
    np.testing.assert_allclose([rows(workdir)[number] for number in losses], list(losses.values()), rtol=1e-4)
    np.testing.assert_allclose([late[number] for number in late], [losses[number] for number in late], rtol=1e-4)
    lines = (workdir / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [1, 2, 3, 4, 4]  # the last one is the validation
    assert len(list(workdir.glob("events*"))) == 2  # one each time it was started
    assert len(list((tmp_path / "data").glob("*.demo"))) == 1
    assert {path.name for path in (workdir / "checkpoints" / "latest").glob("*.json")} == {"3.json", "4.json"}
    assert json.loads((workdir / "scores-policy-val.json").read_text())["episodes"] == 1 and (workdir / "episode-val-0.webp").exists()


SLURM = {"SLURM_JOB_ID": "9", "SLURM_NTASKS": "8", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
STEP = {**SLURM, "SLURM_STEP_NODELIST": "node[1-2]"}
EXPLICIT = {"JAX_COORDINATOR_ADDRESS": "node1:1234", "JAX_NUM_PROCESSES": "2", "JAX_PROCESS_ID": "1"}
TOLD = {"coordinator_address": "node1:1234", "num_processes": 2, "process_id": 1}


@pytest.mark.parametrize(
    ("environ", "told"),
    [
        ({}, None),
        (SLURM, None),  # a batch script, not a step of srun
        ({**STEP, "SLURM_STEP_NUM_TASKS": "8"}, {"num_processes": 8}),
        (STEP, {"num_processes": 8}),
        ({**STEP, "SLURM_STEP_NUM_TASKS": "1"}, None),  # srun -n 1 in a larger job
        ({**STEP, "JAX_COORDINATOR_ADDRESS": "node1:1234"}, {"num_processes": 8}),  # which JAX reads itself
        ({"OMPI_COMM_WORLD_SIZE": "4", "OMPI_MCA_orte_hnp_uri": "1.0;tcp://10.0.0.1:9"}, {"num_processes": 4}),
        ({"OMPI_COMM_WORLD_SIZE": "2", "OMPI_COMM_WORLD_RANK": "1", "JAX_COORDINATOR_ADDRESS": "node1:1234"}, TOLD),  # Open MPI 5
        ({"OMPI_COMM_WORLD_SIZE": "1"}, None),
        # mpirun in a shell that srun started: four processes of one Slurm task
        ({**STEP, "SLURM_STEP_NUM_TASKS": "1", "OMPI_COMM_WORLD_SIZE": "4", "OMPI_MCA_orte_hnp_uri": ""}, {"num_processes": 4}),
        ({"KUBERNETES_SERVICE_HOST": "10.0.0.1"}, None),  # any pod
        (EXPLICIT, TOLD),
        ({**STEP, **EXPLICIT}, TOLD),
        ({**EXPLICIT, "JAX_NUM_PROCESSES": "1", "JAX_PROCESS_ID": "0"}, None),
    ],
)
def test_what_the_environment_says(environ, told):
    assert parallel.launched(environ) == told


FOUR, OWN = {"CUDA_VISIBLE_DEVICES": "0,1,2,3"}, {"CUDA_VISIBLE_DEVICES": "2"}


@pytest.mark.parametrize(
    ("environ", "devices"),  # None: as many as JAX numbers them, one each
    [
        ({"SLURM_STEP_TASKS_PER_NODE": "4(x2)"}, None),
        ({"SLURM_STEP_TASKS_PER_NODE": "4(x2)", **FOUR}, None),
        ({"SLURM_STEP_TASKS_PER_NODE": "4(x2)", **OWN}, []),  # srun --gpus-per-task=1: each sees its own, as number 0
        ({"SLURM_STEP_TASKS_PER_NODE": "2(x4)", "SLURM_GPUS_PER_TASK": "2", "CUDA_VISIBLE_DEVICES": "0,1"}, []),
        ({"SLURM_STEP_TASKS_PER_NODE": "2(x4)", **FOUR}, [2, 3]),
        ({"SLURM_STEP_TASKS_PER_NODE": "1(x8)", **FOUR}, []),  # all four are the only task's
        ({"SLURM_STEP_TASKS_PER_NODE": "1(x8)"}, []),
        ({"SLURM_STEP_TASKS_PER_NODE": "4,4(x1)"}, None),  # which of them are here is not said
        ({"SLURM_STEP_TASKS_PER_NODE": "1(x8)", "JAX_LOCAL_DEVICE_IDS": "0"}, None),  # which JAX reads itself
    ],
)
@pytest.mark.parametrize("launcher", ["slurm", "mpi"])
def test_every_process_takes_its_own_devices(environ, devices, launcher):
    """As `jax.distributed.initialize` would set them: `[]` and all that it sees, numbers, or None and the one of its place on the node."""
    if launcher == "mpi":
        beside = environ["SLURM_STEP_TASKS_PER_NODE"].partition("(")[0]
        if "SLURM_GPUS_PER_TASK" in environ or "," in beside:
            pytest.skip("Open MPI knows no such thing")
        named = {"SIZE": "8", "LOCAL_RANK": "1" if beside != "1" else "0", "LOCAL_SIZE": beside}
        environ = {**environ, "OMPI_MCA_orte_hnp_uri": "", **{f"OMPI_COMM_WORLD_{name}": value for name, value in named.items()}}
        del environ["SLURM_STEP_TASKS_PER_NODE"]
    else:
        environ = {**STEP, "SLURM_LOCALID": "0" if environ["SLURM_STEP_TASKS_PER_NODE"][0] == "1" else "1", **environ}
    told = parallel.launched(environ)
    assert told.pop("num_processes") == 8 and told == ({} if devices is None else {"local_device_ids": devices})


@pytest.mark.parametrize(
    ("environ", "attached", "devices"),
    [
        ({}, 8, [4, 5, 6, 7]),
        ({}, 2, None),  # one each, as JAX numbers them
        ({}, 0, None),
        (FOUR, 8, [2, 3]),  # the other four are somebody else's
        (OWN, 8, []),
    ],
)
def test_gpus_of_the_node_are_shared_where_nothing_says_which(environ, attached, devices):
    told = parallel.launched({**STEP, "SLURM_LOCALID": "1", "SLURM_STEP_TASKS_PER_NODE": "2(x4)", **environ}, attached=attached)
    assert told == {"num_processes": 8} | ({} if devices is None else {"local_device_ids": devices})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"JAX_PROCESS_ID": None}, "some, but not all of JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES, JAX_PROCESS_ID"),
        ({"JAX_NUM_PROCESSES": None, "JAX_PROCESS_ID": None}, "some, but not all of JAX_COORDINATOR_ADDRESS"),  # nor any scheduler
        ({"JAX_PROCESS_ID": "2"}, "JAX_PROCESS_ID must be from 0 to JAX_NUM_PROCESSES - 1 = 1, got 2"),
        ({"JAX_NUM_PROCESSES": "two"}, "JAX_NUM_PROCESSES must be a whole number, got 'two'"),
        (
            {**dict.fromkeys(EXPLICIT), "OMPI_COMM_WORLD_SIZE": "2"},
            "Open MPI 5 does not tell where .*: set JAX_COORDINATOR_ADDRESS=HOST:PORT",
        ),
    ],
)
def test_a_wrong_environment_is_refused(change, message):
    environ = {name: value for name, value in {**EXPLICIT, **change}.items() if value is not None}
    with pytest.raises(options.OptionsError, match=message):
        parallel.launched(environ)


def test_one_device_has_no_mesh_and_waits_for_nobody():
    tree = {"a": np.arange(3)}
    assert parallel.mesh("n", 7) is None and parallel.here(tree, None) is tree and parallel.constrain(tree, None, shard=True) is tree
    assert parallel.first(lambda: 5) == 5 and parallel.is_first() and parallel.anywhere(True) and not parallel.anywhere(False)
    assert parallel.over_batch(max, None) is max
