"""Tasks in workers: each is done once whatever is killed, what is missing is named, and the results are those of one process."""

import errno
import fcntl
import functools
import json
import os
import pathlib
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time

import cluster_tasks
import jax
import numpy as np
import pytest
from test_scoring import SINGLE, save
from test_train_step import tiny_config

from experiments import ablation, common, main_table, robustness, table1
from lala_jax import build, cluster, dataset, options, pretrain, pretrained, recording, rollout, scoring, train, writers

TESTS = pathlib.Path(__file__).parent
pytest.importorskip("submitit")


@pytest.fixture(autouse=True)
def found_by_workers(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{TESTS.parent}{os.pathsep}{TESTS}")


@pytest.fixture
def local():
    return cluster.launcher("local", "workers=2,retries=1")


def task(path, name, function=cluster_tasks.ran, *args, needs=(), key=0, **options):
    """A task that leaves a line in `<path>/<name>` when it runs, and its part in `<path>/parts`."""
    return cluster.Task(name, functools.partial(function, path / name, *args, **options), path / "parts" / f"{name}.json", key, needs)


def runs(path, *names):
    """How often each ran."""
    return [len((path / name).read_text().split()) if (path / name).exists() else 0 for name in names]


# Workers


def test_a_killed_or_stopped_task_is_run_again(local, tmp_path, capsys):
    tasks = [
        task(tmp_path, "late", cluster_tasks.ran, {"a": (1, float("nan"))}, needs=("killed", "elsewhere")),
        task(tmp_path, "killed", cluster_tasks.killed, 5, times=1),
        task(tmp_path, "stopped", cluster_tasks.stopped, "x"),
    ]
    found = list(cluster.run(local, tasks, tmp_path / "parts"))
    assert dict(found) == {"late": {"a": [1, None]}, "killed": 5, "stopped": "x"}
    assert [name for name, _ in found].index("late") > [name for name, _ in found].index("killed")
    assert runs(tmp_path, "killed", "stopped", "late") == [2, 2, 1]
    assert "killed: failed, try 1 of 2; again" in capsys.readouterr().out
    assert dict(cluster.run(local, tasks, tmp_path / "parts")) == dict(found)  # the parts are there
    again = [task(tmp_path, "late", cluster_tasks.ran, 7, key=1), *tasks[1:]]
    assert dict(cluster.run(local, again, tmp_path / "parts"))["late"] == 7  # a part of another key is not
    assert runs(tmp_path, "killed", "stopped", "late") == [2, 2, 2]
    assert not list((tmp_path / "parts" / "logs").iterdir())  # nobody needs them
    cluster.sweep(tmp_path / "parts")
    assert sorted(path.name for path in (tmp_path / "parts").iterdir()) == ["killed.json", "late.json", "stopped.json"]
    shutil.rmtree(tmp_path / "parts")
    (tmp_path / "parts" / "logs" / "old").mkdir(parents=True)
    with cluster.exclusive(tmp_path / "parts" / "logs" / "used"):
        (tmp_path / "parts" / "logs" / "used").mkdir()
        cluster.sweep(tmp_path / "parts")  # another command is at it
        assert sorted(path.name for path in (tmp_path / "parts" / "logs").iterdir()) == ["used", "used.lock"]
    cluster.sweep(tmp_path / "parts")
    assert not (tmp_path / "parts").exists()


def test_what_is_missing_is_named_and_the_rest_is_kept(local, tmp_path, capsys):
    def tasks(function):
        return [
            task(tmp_path, "fails", function),
            task(tmp_path, "good", cluster_tasks.ran, 1),
            task(tmp_path, "after", cluster_tasks.ran, 2, needs=("fails",)),
            task(tmp_path, "last", cluster_tasks.ran, 3, needs=("after",)),
        ]

    found = {}
    with pytest.raises(SystemExit, match="^1$"):
        found.update(cluster.run(local, tasks(cluster_tasks.fails), tmp_path / "parts"))
    said = capsys.readouterr().err
    assert "3 of 4 tasks are missing" in said and "fails: 2 tries; the last failed" in said and "ValueError: broken on purpose" in said
    assert "after: it needs fails, which is missing" in said and "last: it needs after, which is missing" in said
    assert json.loads((tmp_path / "parts" / "good.json").read_text())["result"] == 1
    assert runs(tmp_path, "fails", "good", "after") == [2, 1, 0]
    (tmp_path / "fails").unlink()
    assert dict(cluster.run(local, tasks(cluster_tasks.ran), tmp_path / "parts")) == {"fails": None, "good": 1, "after": 2, "last": 3}
    assert runs(tmp_path, "fails", "good", "after", "last") == [1, 1, 1, 1]


def test_a_task_that_is_killed_always_is_missing(local, tmp_path, capsys):
    with pytest.raises(SystemExit, match="^1$"):
        list(cluster.run(local, [task(tmp_path, "killed", cluster_tasks.killed, 0, times=9)], tmp_path / "parts"))
    assert runs(tmp_path, "killed") == [2] and "killed: 2 tries; the last was killed, and " in capsys.readouterr().err


def test_tasks_cannot_wait_for_each_other(local, tmp_path):
    tasks = [task(tmp_path, "a", needs=("b",)), task(tmp_path, "b", needs=("a",))]
    with pytest.raises(ValueError, match="in a circle: a, b"):
        list(cluster.run(local, tasks, tmp_path / "parts"))


def test_no_more_workers_than_asked_for(tmp_path):
    """Two tasks at once overlap, with one worker they do not."""
    for workers in (1, 2):
        path = tmp_path / str(workers)
        path.mkdir()
        tasks = [task(path, name, cluster_tasks.span, path / other if workers == 2 else None) for name, other in ("ab", "ba")]
        found = dict(cluster.run(cluster.Launcher("local", workers), tasks, path / "parts"))
        (begin, end), (other, other_end) = found["a"], found["b"]
        assert (max(begin, other) < min(end, other_end)) == (workers == 2)


def test_a_task_that_is_killed_after_its_part_is_there_is_done(local, tmp_path, capsys):
    tasks = [task(tmp_path, "late", cluster_tasks.killed_too_late, 6)]
    assert dict(cluster.run(local, tasks, tmp_path / "parts")) == {"late": 6}
    assert runs(tmp_path, "late") == [1] and "late: done" in capsys.readouterr().out


def start_command(*arguments):
    """`cluster.run` in a process of its own, and of a group of its own, as a terminal starts it."""
    code = "import pickle, signal, sys\nfrom lala_jax import cluster\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "list(cluster.run(*pickle.load(sys.stdin.buffer)))"  # Ctrl-C is ignored where the tests run in the background
    how = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    command = subprocess.Popen([sys.executable, "-c", code], **how)
    pickle.dump(arguments, command.stdin)
    command.stdin.close()
    return command


def test_a_terminal_that_interrupts_lets_trainings_save(local, tmp_path):
    """Ctrl-C goes to the command and to all that it started; saving takes longer than submitit waits."""
    command = start_command(local, [task(tmp_path, "training", cluster_tasks.saves, 2.5)], tmp_path / "parts")
    while not (tmp_path / "training").exists():
        time.sleep(0.05)
    os.killpg(command.pid, signal.SIGINT)
    with command:
        try:
            command.wait(60)
        finally:
            command.kill()
    assert (tmp_path / "training.saved").exists() and ended(int((tmp_path / "training").read_text()))


def test_a_command_started_again_waits_for_workers_of_the_one_that_was_killed(local, tmp_path):
    """The first command is killed once its worker runs; the second gives what that worker found."""
    slow = task(tmp_path, "slow", cluster_tasks.ran, 4, wait=4.0)
    command = start_command(local, [slow], tmp_path / "parts")
    while not (tmp_path / "slow").exists():
        time.sleep(0.05)
    command.kill()
    command.wait()
    assert not slow.part.exists()
    assert dict(cluster.run(local, [slow], tmp_path / "parts")) == {"slow": 4}
    assert runs(tmp_path, "slow") == [1]


@pytest.mark.parametrize("seen", ["1,3", None])
def test_workers_see_the_accelerators_of_the_command(seen, local, tmp_path, monkeypatch):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if seen is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", seen)
    asked = [task(tmp_path, name, cluster_tasks.variable, name) for name in ("CUDA_VISIBLE_DEVICES", "JAX_PLATFORMS")]
    found = dict(cluster.run(local, asked, tmp_path / "parts"))
    assert found == {"CUDA_VISIBLE_DEVICES": seen, "JAX_PLATFORMS": os.environ.get("JAX_PLATFORMS")}


def test_workers_keep_programs_as_commands_do(local, tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    found = dict(cluster.run(local, [task(tmp_path, "here", cluster_tasks.programs)], tmp_path / "parts"))
    assert found == {"here": str(tmp_path / "lala_jax" / "xla")}


def test_who_leaves_early_takes_the_workers_along(local, tmp_path):
    found = cluster.run(local, [task(tmp_path, "slow", cluster_tasks.ran, wait=600.0), task(tmp_path, "fast")], tmp_path / "parts")
    assert next(found) == ("fast", None)
    while not (tmp_path / "slow").exists():
        time.sleep(0.05)
    found.close()
    assert ended(int((tmp_path / "slow").read_text()))


def ended(pid, seconds=60):
    """Wait for a process to end."""
    for _ in range(seconds * 10):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


def test_a_lock_excludes_and_goes_with_its_holder(tmp_path):
    order, inside = [], threading.Event()

    def first():
        with cluster.exclusive(tmp_path / "x"):
            inside.set()
            time.sleep(0.3)
            order.append("first")

    thread = threading.Thread(target=first)
    thread.start()
    inside.wait()
    with cluster.exclusive(tmp_path / "x"):
        order.append("second")
    thread.join()
    assert order == ["first", "second"] and list(tmp_path.iterdir()) == []
    code = f"import cluster_tasks; cluster_tasks.hold({str(tmp_path / 'x')!r})"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        threading.Timer(0.3, holder.kill).start()
        with cluster.exclusive(tmp_path / "x"):
            assert holder.wait() == -signal.SIGKILL


def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch):
    def flock(file, how):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.raises(options.OptionsError, match=f"{tmp_path} is on a file system without locks"), cluster.exclusive(tmp_path / "x"):
        pytest.fail("there is no lock")


def test_slurm(tmp_path, monkeypatch, capsys):
    """Through submitit's job scripts and a stand-in for Slurm: an array, a killed task submitted again, one that needs others."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "jobs").mkdir()
    script = (TESTS / "fake_slurm.py").read_text()
    for name in ("sbatch", "srun", "sacct", "scancel", "fake_slurm.py"):
        (tmp_path / "bin" / name).write_text(f"#!{sys.executable}\n{script}")
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("FAKE_SLURM", str(tmp_path / "jobs"))
    monkeypatch.setitem(cluster._POLL, "slurm", 0.2)
    launch = cluster.launcher("slurm", "partition=gpu,gpus_per_node=1,mem_gb=8,setup=export A=1; export B=$A,timeout_min=90,workers=3")
    tasks = [
        task(tmp_path, "good", cluster_tasks.ran, 1),
        task(tmp_path, "killed", cluster_tasks.killed, 2, times=1),
        task(tmp_path, "late", cluster_tasks.variable, "B", needs=("good",)),
    ]
    assert dict(cluster.run(launch, tasks, tmp_path / "parts")) == {"good": 1, "killed": 2, "late": "1"}
    assert runs(tmp_path, "good", "killed", "late") == [1, 2, 1]
    assert "good: job 1000_0\nkilled: job 1000_1" in capsys.readouterr().out
    first = (tmp_path / "jobs" / "1000.sh").read_text()
    for line in ("partition=gpu", "gpus-per-node=1", "mem=8GB", "time=90", "array=0-1%2", "job-name=lala_jax"):
        assert f"#SBATCH --{line}\n" in first
    assert "array" not in (tmp_path / "jobs" / "1001.sh").read_text()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("ray", "", "--launcher must be one of '', 'local', 'slurm', got 'ray'"),
        ("", "workers=2", "--launcher-options=workers=2 needs --launcher=local or --launcher=slurm"),
        ("local", "partition=gpu", "--launcher-options must be one of 'workers', 'retries', 'timeout_min', got 'partition'"),
        ("slurm", "partitoin=gpu", "got 'partitoin'; did you mean partition"),
        ("local", "workers=0", "workers must be a whole number from 1 on, got '0'"),
        ("local", "retries=-1", "retries must be a whole number from 0 on, got '-1'"),
        ("local", "timeout_min=1.5", "timeout_min must be a whole number from 1 on, got '1.5'"),
        ("slurm", "mem_gb=nan", "mem_gb must be a number from 1 on, got 'nan'"),
        ("slurm", "partition=,workers=2", "partition must be some text, got ''"),
        ("local", "workers", "workers must be a whole number from 1 on, got ''"),
    ],
)
def test_a_wrong_launcher_is_refused(name, text, message):
    with pytest.raises(options.OptionsError, match=message.replace("[", r"\[")):
        cluster.launcher(name, text)


def test_launchers_are_read():
    assert cluster.launcher("", "") is None
    assert cluster.launcher("local", "") == cluster.Launcher("local", workers=2)
    read = cluster.launcher("slurm", "nodelist=a,b,retries=0,setup=module load x,y,mem_gb=2.5")
    assert read == cluster.Launcher("slurm", 256, 0, parameters={"nodelist": "a,b", "setup": "module load x,y", "mem_gb": 2.5})


def test_slurm_and_the_extra_must_be_there(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(options.OptionsError, match='--launcher=slurm: Could not detect "srun"'):
        list(cluster.run(cluster.launcher("slurm", ""), [task(tmp_path, "a")], tmp_path / "parts"))
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(options.OptionsError, match=r"--launcher=local needs submitit: pip install 'lala_jax\[cluster\]'"):
        cluster.launcher("local", "")


# Rows


def without_seconds(path):
    stored = json.loads(path.read_text())
    for row in stored["rows"]:
        del row["seconds"]
    return stored


def told(done, kept):
    return {"done": [row["name"] for row in done], "kept": [row["name"] for row in kept]}


def test_rows_by_workers_are_those_of_one_process(local, tmp_path, capsys):
    """The workers of both rows are killed once."""
    rows = [common.Row("oracle", "one"), common.Row("blind", "two", ("task.num_objects=3",), needs=("oracle",))]
    alone, fanned, config = tmp_path / "alone.json", tmp_path / "fanned.json", tiny_config()
    common.fill(alone, rows, functools.partial(cluster_tasks.row, base=config, path=tmp_path / "a"), told, config=config, seeds=[1, 3])
    given = {"config": config, "seeds": [1, 3], "launch": local}
    work = functools.partial(cluster_tasks.row, base=config, path=tmp_path / "b", times=1)
    broken = common.Row("broken", "three")
    with pytest.raises(SystemExit, match="^1$"):
        common.fill(fanned, [broken, *rows], work, told, **given)
    assert "1 of 3 tasks are missing" in capsys.readouterr().err
    assert without_seconds(fanned) == without_seconds(alone)
    before = runs(tmp_path, "b")
    done = common.fill(fanned, rows, work, told, **given)
    assert runs(tmp_path, "b") == before and [row["label"] for row in done] == ["one", "two"]
    assert not fanned.with_suffix(".parts").exists()


def inline(monkeypatch):
    """Workers are this process: the tasks that were run, by name."""
    ran = {}

    def run(launch, tasks, folder):
        ran.clear()
        ran.update({one.name: one for one in tasks})
        for one in sorted(tasks, key=lambda one: len(one.needs)):
            yield one.name, one()

    monkeypatch.setattr(cluster, "run", run)
    return ran


def test_what_rows_share_comes_before_them(monkeypatch, tmp_path):
    ran, collected, trained = inline(monkeypatch), [], []

    def pretrained_backbone(config, path):
        with writers.Writer(path, tensorboard=False) as writer:
            writer.scalars(1, {"seconds_per_step": 2.0})
        return f"{path}/backbone.npz"

    def fake(config, path):
        trained.append(config)
        with writers.Writer(path, tensorboard=False) as writer:
            writer.scalars(1, {"seconds_per_step": 2.0})
        return summary(build.split_seeds(config.eval.split, config.eval.start, config.eval.episodes))

    monkeypatch.setattr(recording, "collect", lambda config, **_: collected.append(config.data))
    monkeypatch.setattr(pretrain, "pretrain", pretrained_backbone)
    monkeypatch.setattr(common, "check_run", lambda *_: None)
    monkeypatch.setattr(common, "load_weights", lambda *_: (None, {"step": 1}))
    monkeypatch.setattr(common, "score", lambda config, params, seeds: summary(seeds))
    monkeypatch.setattr(train, "train_and_evaluate", fake)
    given = [f"--out={tmp_path}", f"--workdir={tmp_path / 'runs'}", "--launcher=local", f"--config.data.directory={tmp_path / 'd'}"]
    recorded = f"demonstrations in {tmp_path / 'd'}"

    ablation.command([*given, "--task=tower", "--rows=average-turns,rigid,recoveries", "--episodes=1"])
    assert {name: one.needs for name, one in ran.items()} == {
        recorded: (),
        "default": (recorded,),
        "rigid": (recorded,),
        "recoveries": (),  # the only one with demonstrations of its own
        "average-turns": ("default",),
    }
    stored = json.loads((tmp_path / "ablation-tower.json").read_text())
    assert [row["name"] for row in stored["rows"]] == ["default", "rigid", "recoveries", "average-turns"]
    assert all("difference" in row for row in stored["rows"][1:]) and stored["reference"] == "default"
    ablation.command([*given, "--task=tower", "--rows=average-turns,refine", "--episodes=1"])
    assert {name: one.needs for name, one in ran.items()} == {
        recorded: (),
        "refine": (recorded,),
    }

    main_table.command([*given, "--demos=50,500", "--seeds=0", "--episodes=1"])
    assert collected[-1].demos == 500 and ran["50-0"].needs == ran["500-0"].needs == (recorded,)

    table1.command([*given, "--scale=smoke", "--rows=two-stream-scene,two-stream-scene-50,oracle"])
    assert {name: one.needs for name, one in ran.items()} == {
        f"{recorded}-smoke": (),
        "the backbone": (),
        "two-stream-scene": (f"{recorded}-smoke", "the backbone"),
        "two-stream-scene-50": (f"{recorded}-smoke", "the backbone"),
        "oracle": (),
    }
    assert trained[-1].camera.backbone == ran["the backbone"]() == str(tmp_path / "runs" / "smoke-backbone" / "backbone.npz")


def summary(seeds):
    lines = [{"seed": seed, "score": 50.0, "complete": False, "actions": 1, "causes": []} for seed in seeds]
    return rollout.merged([{"per_episode": lines, **dict.fromkeys(rollout.COUNTS, {})}])


def test_robustness_by_workers(tmp_path):
    """A whole series as a user starts it: its functions are found by workers though the command is `__main__`."""
    save(tmp_path / "checkpoints", tiny_config(*SINGLE, "camera.calibrate=false"))
    given = [f"--checkpoint={tmp_path / 'checkpoints'}", "--episodes=2", "--rows=noise"]
    robustness.command([*given, f"--out={tmp_path / 'alone'}"])
    command = [sys.executable, "-m", "experiments.robustness", *given, f"--out={tmp_path / 'fanned'}", "--launcher=local"]
    done = subprocess.run(command, cwd=TESTS.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    files = [tmp_path / name / "robustness-test.json" for name in ("alone", "fanned")]
    assert without_seconds(files[0]) == without_seconds(files[1]) and "| as trained |" in done.stdout
    assert [path.name for path in (tmp_path / "fanned").iterdir()] == ["robustness-test.json"]


# Demonstrations


def contents(path):
    return {file.name: file.read_bytes() for file in path.iterdir()}


def test_demonstrations_by_workers_are_those_of_one_process(local, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "SHARD", 2)

    def config(name, demos):
        return tiny_config(f"data.directory={tmp_path / name}", f"data.demos={demos}")

    for demos in (3, 8):  # goes on after a shard that is not full
        recording.collect(config("alone", demos), quiet=True)
        recording.collect(config("fanned", demos), launch=local)
        assert contents(tmp_path / "alone") == contents(tmp_path / "fanned")
    assert dataset.seeds(tmp_path / "fanned").tolist() == [0, 2, 4, 6, 8, 10, 12, 14]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["alone", "fanned"]
    recording.collect(config("fanned", 8), launch=None)
    assert contents(tmp_path / "alone") == contents(tmp_path / "fanned")


def test_lost_demonstrations_are_replaced_as_in_one_process(local, tmp_path, monkeypatch):
    """Of these seeds some reach no goal, so that more shards are needed than planned."""
    inline(monkeypatch)
    monkeypatch.setattr(recording, "SHARD", 3)
    monkeypatch.setattr(recording, "demonstrate", functools.partial(lost, recording.demonstrate))
    for name, launch in [("alone", None), ("fanned", local)]:
        recording.collect(tiny_config(f"data.directory={tmp_path / name}", "data.demos=8"), quiet=True, launch=launch)
    assert dataset.seeds(tmp_path / "alone").tolist() == [0, 4, 6, 16, 20, 22, 24, 26]
    assert contents(tmp_path / "alone") == contents(tmp_path / "fanned")


def lost(real, task, seeds, **options):
    """Lose a shard and single demonstrations."""
    return [demo for demo in real(task, seeds, **options) if int(demo.seed) not in (2, 8, 10, 12, 14, 18)]


# Episodes


def test_spans_are_whole_chunks():
    assert scoring.spans(10, 3, 2) == [range(0, 6), range(6, 10)]
    assert scoring.spans(10, 3, 9) == [range(0, 3), range(3, 6), range(6, 9), range(9, 10)]
    assert scoring.spans(2, 25, 9) == [range(0, 2)]


def test_evaluation_in_parts_is_that_of_one_process(call, tmp_path, monkeypatch):
    """Cameras that were moved, with noise: what is drawn at random does not depend on the split. The pictures, too."""
    ran = inline(monkeypatch)
    save(tmp_path / "checkpoints", tiny_config(*SINGLE))
    given = [
        f"--checkpoint={tmp_path / 'checkpoints'}",
        "--split=test",
        "--episodes=5",
        "--config.eval.parallel=2",
        "--config.eval.strips=3",
    ]
    given += ["--config.camera.shift=0.03", "--config.camera.depth_noise=true", "--config.camera.calibrate=false"]
    alone = call("lala_jax.evaluate", *given, f"--workdir={tmp_path / 'alone'}")
    fanned = call("lala_jax.evaluate", *given, f"--workdir={tmp_path / 'fanned'}", "--launcher=local")
    assert alone.status == fanned.status == 0 and list(ran) == ["episodes 0-3", "episodes 4-4"]
    assert len(contents(tmp_path / "alone")) == 7  # scores, three episodes, three failures
    assert contents(tmp_path / "alone") == contents(tmp_path / "fanned")


def test_a_checkpoint_that_changes_meanwhile_is_noticed(tmp_path):
    config = tiny_config(*SINGLE)
    params = save(tmp_path, config)
    weights = pretrained.fingerprint(str(tmp_path), params)
    other = pretrained.fingerprint(str(tmp_path), jax.tree.map(lambda leaf: leaf + np.float32(1), params))
    assert weights != other and weights["step"] == 1
    with pytest.raises(scoring.checkpoint.CheckpointError, match="changed meanwhile"):
        scoring.score_span(config, range(1), tmp_path / "x.npz", agent="policy", path=str(tmp_path), weights=other, seeds=[1])
    with pytest.raises(scoring.checkpoint.CheckpointError, match="changed meanwhile"):
        robustness.run(robustness.ROWS[0], base=config, checkpoint=str(tmp_path), weights=other, seeds=[1])


def test_the_device_is_that_of_the_workers(tmp_path, monkeypatch):
    """Which the command, kept off accelerators, does not see."""
    lines = [{"seed": 1, "score": 0.0, "complete": False, "actions": 1}, {"seed": 3, "score": 100.0, "complete": True, "actions": 1}]
    counts = {name: {} for name in rollout.COUNTS}
    found = [{"per_episode": [line], **counts, "device": device} for line, device in zip(lines, "ba", strict=True)]
    monkeypatch.setattr(cluster, "run", lambda launch, tasks, folder: [(task.name, one) for task, one in zip(tasks, found, strict=True)])
    config, local = tiny_config("eval.parallel=1"), cluster.Launcher("local", 2)
    result, _ = scoring.evaluate_in_parts(local, config, tmp_path, agent="blind", path="", weights=None, seeds=[1, 3])
    assert result["device"] == "a, b" and result["score"] == 50.0
    scoring.write_scores(config, result, {}, tmp_path, agent="blind", split="val", seeds=[1, 3], source=None, weights=None)
    assert json.loads((tmp_path / "scores-blind-val.json").read_text())["device"] == "a, b"


def test_agents_without_weights_are_scored_by_workers(call, tmp_path):
    given = ["--config=configs/tower.py:smoke", "--agent=blind", "--config.task.num_objects=2", "--config.eval.parallel=2"]
    answers = [call("lala_jax.evaluate", *given, f"--workdir={tmp_path / name}", *more) for name, more in
               [("alone", ()), ("fanned", ("--launcher=local",))]]  # fmt: skip
    assert [answer.status for answer in answers] == [0, 0]
    assert contents(tmp_path / "alone") == contents(tmp_path / "fanned")
    shutil.rmtree(tmp_path / "fanned")
    refused = call("lala_jax.evaluate", *given, f"--workdir={tmp_path / 'fanned'}", "--launcher=pbs")
    assert refused.status == 2 and "--launcher must be one of '', 'local', 'slurm', got 'pbs'" in refused.err
