"""What the tests of the launcher send to workers: they find it by this module's name."""

import json
import os
import pathlib
import signal
import time

from lala_jax import checkpoint, cluster


def note(path):
    """Leave a line for every run."""
    with open(path, "a") as file:
        file.write(f"{os.getpid()}\n")
    return len(pathlib.Path(path).read_text().split())


def ran(path, value=None, *, wait=0.0):
    """Give a value, saying that it ran."""
    note(path)
    time.sleep(wait)
    return value


def killed(path, value, *, times):
    """Kill the own process the first times."""
    if note(path) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return value


def fails(path):
    note(path)
    raise ValueError("broken on purpose")


def stopped(path, value):
    """Leave the first time as training does that was told to stop."""
    if note(path) == 1:
        raise SystemExit("stopped at step 3; the same command goes on from there")
    return value


def saves(path, seconds):
    """Work until told to stop, then take that long to save, as training does."""
    with checkpoint.stop_signals((signal.SIGTERM, signal.SIGINT)) as told:
        note(path)
        while not told():
            time.sleep(0.01)
        time.sleep(seconds)
        path.with_suffix(".saved").touch()
    raise SystemExit("stopped at step 3; the same command goes on from there")


def programs(path):
    """Give the folder in which this process keeps compiled programs."""
    import jax

    note(path)
    return jax.config.jax_compilation_cache_dir


def hold(path):
    """Hold a lock for as long as the process lives."""
    with cluster.exclusive(pathlib.Path(path)):
        print("held", flush=True)
        time.sleep(600)


def row(row, *, base, path, times=0):
    """Score a row's agent, which is its name, killing the worker the first times; "broken" fails."""
    from lala_jax import build, scoring

    if row.name == "broken":
        return fails(path)
    config = row.configs(base)[0]
    summary = scoring.baseline(row.name, build.task(config), seeds=[1, 3], threads=1)
    return killed(path, {name: value for name, value in summary.items() if name != "per_episode"}, times=times)


def killed_too_late(path, value):
    """Leave the part, and be killed before anybody is told; as `killed` does it, the worker's own code has no say in it."""
    note(path)
    part = path.parent / "parts" / f"{path.name}.json"
    part.write_text(json.dumps({"key": 0, "result": value}))
    os.kill(os.getpid(), signal.SIGKILL)


def span(path, meets):
    """Say from when to when it ran: until `meets` runs, too, or for a while."""
    begin, patience = time.time(), 60.0 if meets else 2.0
    note(path)
    while time.time() < begin + patience and not (meets and meets.exists()):
        time.sleep(0.01)
    return begin, time.time()


def variable(path, name):
    """Give a variable of the worker's environment."""
    return ran(path, os.environ.get(name))
