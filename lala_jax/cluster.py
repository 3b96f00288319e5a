"""Tasks in processes of their own, here or on a cluster: `--launcher=local`, `--launcher=slurm`, by submitit (extra `cluster`).

Workers start in the directory of the command and share its file system. What a task gives is kept in a file, its part, before anybody is
told, and who runs a task holds its lock: a worker or a command that is killed takes nothing of the others' with it, and a command started
again takes up the parts that are there and waits for workers that still run.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import errno
import json
import os
import pathlib
import re
import shlex
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from lala_jax import options, writers

FLAGS = {"launcher": "", "launcher_options": ""}  # of a command that can fan out
LAUNCHERS = ("", "local", "slurm")
# What --launcher-options may say: tasks at once, further tries of a task that failed, a task's time; of Slurm, as submitit names it.
_OPTIONS: dict[str, type] = {"workers": int, "retries": int, "timeout_min": int}
_SLURM: dict[str, type] = {
    **dict.fromkeys(("partition", "account", "qos", "constraint", "nodelist", "exclude", "setup"), str),
    **{"gpus_per_node": int, "cpus_per_task": int, "mem_gb": float, "signal_delay_s": int},
}
VALID = {"local": _OPTIONS, "slurm": {**_OPTIONS, **_SLURM}}
DEFAULTS = {"local": {"workers": 2}, "slurm": {"workers": 256}}
_GENERIC = ("timeout_min", "gpus_per_node", "cpus_per_task", "mem_gb")  # named alike for all of submitit's executors
_POLL = {"local": 0.1, "slurm": 5.0}  # seconds between looks at what became of the tasks
_FAREWELL = 60.0  # seconds for workers here to end: a training takes a step more and saves
_LINES = 12  # of a failed worker's log that are shown


@dataclasses.dataclass(frozen=True)
class Task:
    """A call that a worker can make; all of it can be pickled, and the function is found by its module's name."""

    name: str
    call: Callable[[], Any]  # gives what JSON holds, where there is a part
    part: pathlib.Path | None = None  # the file that keeps the result; without one the task runs whenever it is asked for
    key: Any = None  # what the result is a result of: a part with another one is passed over
    needs: tuple[str, ...] = ()  # the tasks to be done before; names of no task are taken for done

    def found(self) -> dict[str, Any] | None:
        """Give what the part holds, `key` and `result`; None where there is none of this task."""
        if self.part is None or not self.part.exists():
            return None
        try:
            stored = json.loads(self.part.read_text())
            return stored if stored["key"] == writers.plain(self.key) and "result" in stored else None
        except (ValueError, KeyError, TypeError):  # damaged: to be done again
            return None

    def __call__(self) -> Any:
        """Do the task in a worker, unless it is done by now, and keep the result."""
        from lala_jax import compiling  # imports JAX, which nobody else needs here

        compiling.keep()
        if os.environ.get("SUBMITIT_EXECUTOR") == "local":
            signal.signal(signal.SIGTERM, signal.SIG_DFL)  # what submitit passes over; training has a handler of its own
        try:
            if self.part is None:
                return self.call()
            with exclusive(self.part):
                stored = self.found()
                if stored is None:
                    stored = writers.plain({"key": self.key, "result": self.call()})
                    writers.write_json(self.part, stored)
                return stored["result"]
        except SystemExit as error:
            if isinstance(error.code, str):  # training was told to stop; a number is submitit's own way to leave
                raise RuntimeError(error.code) from error
            raise

    def checkpoint(self) -> Any:
        """Say what submitit puts back into the queue when the time is up or the node is wanted: this task, which goes on from its files."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


@dataclasses.dataclass(frozen=True)
class Launcher:
    """How tasks are run."""

    name: str  # "local" or "slurm"
    workers: int  # tasks at once
    retries: int = 2  # of a task that failed or was killed
    timeout_min: int = 24 * 60  # minutes of a task, after which it is put back into the queue
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of Slurm

    def executor(self, folder: pathlib.Path) -> Any:
        """Make submitit's executor, with its pickles and logs in `folder`; raises OptionsError where there is no Slurm."""
        import submitit

        given = os.environ.get("CUDA_VISIBLE_DEVICES")  # which submitit would empty
        seen = "-u CUDA_VISIBLE_DEVICES" if given is None else f"CUDA_VISIBLE_DEVICES={shlex.quote(given)}"
        python = {"local_python": f"env {seen} {shlex.quote(sys.executable)}"} if self.name == "local" else {}
        try:
            made = submitit.AutoExecutor(folder, cluster=self.name, **python)
        except RuntimeError as error:
            raise options.OptionsError(f"--launcher={self.name}: {error}") from error
        own = {"setup": [self.parameters["setup"]]} if "setup" in self.parameters else {}
        more = {name if name in _GENERIC else f"slurm_{name}": value for name, value in {**self.parameters, **own}.items()}
        if self.name == "slurm":
            more |= {"name": "lala_jax", "slurm_array_parallelism": self.workers}
        made.update_parameters(timeout_min=self.timeout_min, **more)
        return made


def launcher(name: str, text: str) -> Launcher | None:
    """Read `--launcher` and `--launcher-options`, `key=value,...`; None for "", which is this process, task after task.

    Keeps this process off accelerators, which are the workers'. Raises OptionsError for an unknown launcher or option, a wrong value,
    or where the extra is not installed.
    """
    options.check_choice("--launcher", name, LAUNCHERS)
    if not name:
        if text:
            raise options.OptionsError(f"--launcher-options={text} needs --launcher=local or --launcher=slurm")
        return None
    given = _read(text, VALID[name])
    try:
        import submitit  # noqa: F401
    except ModuleNotFoundError as error:
        raise options.OptionsError(f"--launcher={name} needs {error.name}: pip install 'lala_jax[cluster]'") from error
    import jax

    jax.config.update("jax_platforms", "cpu")  # no effect where a computation was made before; workers do not inherit it
    own = {option: value for option, value in given.items() if option in _OPTIONS}
    return Launcher(name, **{**DEFAULTS[name], **own}, parameters={key: value for key, value in given.items() if key not in own})


def _read(text: str, valid: Mapping[str, type]) -> dict[str, Any]:
    """Read `key=value,...`; a comma belongs to the value unless a key and "=" follow it."""
    found = {}
    for part in re.split(r",(?=\w+=)", text) if text else ():
        name, equals, value = part.partition("=")
        options.check_choice("--launcher-options", name, valid)
        least = 0 if name in ("retries", "gpus_per_node") else 1
        try:
            found[name] = valid[name](value)
            if not equals or not value or (valid[name] is not str and not found[name] >= least):
                raise ValueError
        except ValueError:
            wanted = {str: "some text", int: f"a whole number from {least} on", float: f"a number from {least} on"}[valid[name]]
            raise options.OptionsError(f"--launcher-options: {name} must be {wanted}, got {value!r}") from None
    return found


@contextlib.contextmanager
def exclusive(path: pathlib.Path) -> Iterator[None]:
    """Hold `path` + `.lock` while the block runs, waiting for whoever holds it; it is let go when its holder dies, too."""
    import fcntl  # of POSIX

    lock = _lock_of(path)
    lock.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with open(lock, "w") as file:  # for writing, as network file systems want it
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print(f"waiting for the worker that holds {lock}", flush=True)
                fcntl.flock(file, fcntl.LOCK_EX)
            except OSError as error:
                if error.errno not in (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK):
                    raise
                raise options.OptionsError(f"{lock.parent} is on a file system without locks (flock): choose another directory") from error
            if not _is_at(file, lock):
                continue  # its holder removed it meanwhile, and another may hold a new one
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
            return


def _lock_of(path: pathlib.Path) -> pathlib.Path:
    return path.with_name(path.name + ".lock")


def _is_at(file: Any, path: pathlib.Path) -> bool:
    """Say whether an open file is the one at `path`."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def run(launch: Launcher, tasks: Sequence[Task], folder: pathlib.Path) -> Iterator[tuple[str, Any]]:
    """Run tasks in workers and yield `(name, result)` as they come, first of those whose parts are there; logs go to `folder`.

    A task whose worker failed or was killed is run again, `retries` times. Where some are missing in the end, names them with the last
    lines of their logs and raises SystemExit with status 1. Whoever leaves early cancels what still runs. Logs stay unless all is done,
    and so do those of other commands that use the folder.
    """
    waiting: dict[str, Task] = {}
    for task in tasks:
        if (found := task.found()) is None:
            waiting[task.name] = task
        else:
            yield task.name, found["result"]
    if not waiting:
        return
    logs = folder / "logs" / f"{time.time():.0f}-{os.getpid()}"  # its own: files are named by numbers that come again
    with exclusive(logs):  # so that `sweep` of another command leaves it
        yield from _run(launch, waiting, launch.executor(logs), folder, len(tasks))
    shutil.rmtree(logs, ignore_errors=True)


def _run(launch: Launcher, waiting: dict[str, Task], executor: Any, folder: pathlib.Path, count: int) -> Iterator[tuple[str, Any]]:
    """Submit what waits, of `count` tasks, and yield what comes of it."""
    running: dict[str, tuple[Task, Any]] = {}
    tries, missing = collections.Counter(), {}
    try:
        while waiting or running:
            _submit(launch, executor, waiting, running, missing)
            time.sleep(_POLL[launch.name])
            for name in [name for name, (_, job) in running.items() if job.done()]:
                task, job = running.pop(name)
                tries[name] += 1
                result, reason = _outcome(job)
                if reason and (found := task.found()) is not None:  # killed when all was done, or its answer is not to be seen here yet
                    result, reason = found["result"], ""
                if not reason:
                    print(f"{name}: done", flush=True)
                    yield name, result
                elif tries[name] <= launch.retries:
                    print(f"{name}: failed, try {tries[name]} of {launch.retries + 1}; again", flush=True)
                    waiting[name] = task
                else:
                    missing[name] = f"{tries[name]} tries; {reason}"
    finally:
        _cancel(launch, [job for _, job in running.values()])
    if missing:
        _report(missing, count, folder)
        raise SystemExit(1)


def sweep(folder: pathlib.Path) -> None:
    """Remove the logs of ended commands and, where nothing is left in it, the folder of `run`; what other commands use stays."""
    for logs in (folder / "logs").glob("*/"):
        if not _is_held(logs):
            shutil.rmtree(logs, ignore_errors=True)
            _lock_of(logs).unlink(missing_ok=True)  # of a command that was killed
    for one in (folder / "logs", folder):
        with contextlib.suppress(OSError):
            one.rmdir()


def _is_held(path: pathlib.Path) -> bool:
    """Say whether somebody has `exclusive` hold of a path."""
    import fcntl

    try:
        with open(_lock_of(path), "r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False


def _submit(launch: Launcher, executor: Any, waiting: dict[str, Task], running: dict[str, Any], missing: dict[str, str]) -> None:
    """Submit those of the waiting tasks whose needs are done, as many as there is room for; those whose needs are missing are missing."""
    import submitit.core.utils as errors

    while lost := [(task, need) for task in waiting.values() for need in task.needs if need in missing]:
        task, need = lost[0]
        missing[task.name] = f"it needs {need}, which is missing"
        del waiting[task.name]
    ready = [task for task in waiting.values() if not any(need in waiting or need in running for need in task.needs)]
    if waiting and not ready and not running:
        raise ValueError(f"tasks need each other in a circle: {', '.join(waiting)}")
    chosen = ready[: launch.workers - len(running)]
    if not chosen:
        return
    try:
        with _uninterrupted() if launch.name == "local" else contextlib.nullcontext():
            jobs = executor.submit_array(chosen)
    except (errors.FailedJobError, errors.FailedSubmissionError) as error:
        if not running:
            raise options.OptionsError(f"--launcher={launch.name}: {error}") from error
        print(f"not submitted now, tried again later: {error}", flush=True)  # what runs is not given up for it
        return
    for task, job in zip(chosen, jobs, strict=True):
        del waiting[task.name]
        running[task.name] = (task, job)
        print(f"{task.name}: job {job.job_id}", flush=True)


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Start processes that a terminal's Ctrl-C does not reach: submitit would kill within a second what has yet to save."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _cancel(launch: Launcher, jobs: Sequence[Any]) -> None:
    """Stop jobs. Those of this machine are told to, again and again, until they have ended: a training saves first."""
    if launch.name != "local":
        for job in jobs:
            job.cancel(check=False)
        return
    deadline = time.time() + _FAREWELL
    while time.time() < deadline and (left := [job for job in jobs if not job.done()]):
        for job in left:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(job.job_id), signal.SIGTERM)  # submitit's process, which passes it on
        time.sleep(1.0)
    for job in jobs:
        if not job.done():
            print(f"job {job.job_id} still runs and ends when it has saved", flush=True)


def _outcome(job: Any) -> tuple[Any, str]:
    """Give a finished job's result and why there is none, "" where there is."""
    killed = not job.paths.result_pickle.exists()
    if not killed and job.exception() is None:
        return job.result(), ""
    texts = [(path, path.read_text(errors="replace").rstrip()) for path in (job.paths.stderr, job.paths.stdout) if path.exists()]
    path, text = next(((path, text) for path, text in texts if text), (job.paths.folder, "(nothing)"))
    lines = "\n".join(f"    {line}" for line in text.splitlines()[-_LINES:])
    return None, f"the last {'was killed' if killed else 'failed'}, and {path} ends with\n{lines}"


def _report(missing: Mapping[str, str], count: int, folder: pathlib.Path) -> None:
    """Say what is missing, and why."""
    lines = [f"{len(missing)} of {count} tasks are missing; the same command runs them again, the others are kept. Logs are in {folder}."]
    print("\n".join([*lines, *(f"  {name}: {reason}" for name, reason in missing.items())]), file=sys.stderr, flush=True)
