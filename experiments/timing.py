"""Time one thing, here or in a process of its own: medians, rates and memory."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import json
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from lala_jax import compiling, options

WARM, SECONDS = 5.0, 20.0  # after so long a stage is warm, and is not repeated again
LEAST = 3  # runs of a median, if so many are asked for, however long they take
ONCE = 60.0  # seconds of a first run that stays the only one
LIMIT = 900.0  # seconds that a process of its own may take
COMPILED = "/jax/core/compile/backend_compile_duration"  # what JAX says when it has compiled a program, or read a kept one
STATUS = pathlib.Path("/proc/self/status")  # where Linux says how much memory a process takes, and how much it took at most


class Unavailable(RuntimeError):
    """What a stage needs is not on this machine; or the stage `failed`."""

    def __init__(self, reason: str, *, failed: bool = False):
        super().__init__(reason)
        self.failed = failed


@dataclasses.dataclass(frozen=True)
class Work:
    """Something to time."""

    run: Callable[[], Any]  # does it once and waits for the result
    count: int = 1  # things that one run does
    facts: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of one run: flops, bytes, memory; and compile_seconds
    close: Callable[[], Any] = lambda: None  # gives back what it took
    cold: bool = False  # what its first run takes is asked for, compiling and all: there is no other
    more: Callable[[], Any] = lambda: None  # goes on like a run that is `cold`: what compiles then was compiled before


@dataclasses.dataclass(frozen=True)
class Stage:
    """A row: what is timed, and what one of it is."""

    label: str
    unit: str
    prepare: Callable[[Any], Work]
    alone: bool = False  # in a process of its own on any machine; it may be slow or run out of memory
    needs: tuple[str, ...] = ()  # modules that such a process imports first
    environment: Mapping[str, str] = dataclasses.field(default_factory=dict)  # of such a process, where the user's does not say
    platform: str = ""  # the only one of JAX's that it is for


def compiled(function: Callable[..., Any], *arguments: Any, count: int = 1) -> Work:
    """Compile a function of arrays for its arguments: its run, and what XLA counts of it."""
    program, facts = compiling.build(compiling.jit(function), *arguments)
    return Work(lambda: jax.block_until_ready(program(*arguments)), count, facts)


def stepping(step, run: Any, *inputs: Any, count: int = 1) -> Work:
    """Compile `step(run, *inputs)`, jitted, which gives the next run and metrics: each of its runs takes one step more."""
    program, facts = compiling.build(step, run, *inputs)
    held = [run]

    def take():
        held[0], metrics = program(held[0], *inputs)
        jax.block_until_ready((held[0], metrics))

    return Work(take, count, facts)


def measured(work: Work, repeats: int) -> dict[str, Any]:
    """Run some work up to `repeats` times, LEAST or for SECONDS, after as many to warm up, for WARM: seconds a thing, and rates.

    One run is not enough to warm up: it may be the fifth that finds all its memory kept. A first run of over ONCE is the only one,
    as is that of work that is `cold`.
    """

    def clocked() -> float:
        start = time.perf_counter()
        work.run()
        return time.perf_counter() - start

    with contextlib.closing(work):
        begin, first = time.perf_counter(), clocked()
        before, runs = len(compilations()), [first]
        if not work.cold and first <= ONCE:
            for _ in range(1, repeats):
                if time.perf_counter() - begin > WARM:
                    break
                clocked()
            runs, begin = [], time.perf_counter()
            while len(runs) < repeats and (len(runs) < LEAST or time.perf_counter() - begin < SECONDS):
                runs.append(clocked())
        work.more()
    runs = [seconds / work.count for seconds in runs]
    again = len(compilations()) - before
    seconds = float(np.median(runs))
    rates = {f"{name}_per_second": work.facts[name] / work.count / seconds for name in ("flops", "bytes") if name in work.facts}
    spread = {"seconds": seconds, "lowest": min(runs), "highest": max(runs), "runs": len(runs), "count": work.count}
    return {**spread, "recompiled": again, **work.facts, **rates}


@functools.cache
def compilations() -> list[str]:
    """Give the names of the programs that JAX compiled in this process since the first call: the list grows."""
    names: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, _, fun_name="", **__: names.append(fun_name) if event == COMPILED else None
    )
    return names


def timed(name: str, stages: Mapping[str, Stage], config, repeats: int, *, apart: bool = False) -> dict[str, Any]:
    """Time a stage: a row with the median and the extremes of a thing in seconds; or why it could not run.

    With `apart` every stage has a process of its own, as a command has: what others left in memory is not in its way, and its own use of
    memory can be told. A row of a stage that broke down, took over LIMIT or more memory than there is, is also `failed`.
    """
    stage = stages[name]
    row = {"name": name, "label": stage.label, "unit": stage.unit}
    try:
        if stage.platform not in ("", jax.default_backend()):
            raise Unavailable(f"needs a {stage.platform.upper()}")
        if stage.alone or apart:
            return row | alone(name, stage, config, repeats)
        before = device_memory()
        return row | measured(stage.prepare(config), repeats) | device_memory(before)
    except Unavailable as error:
        return {**row, "unavailable": str(error), **({"failed": True} if error.failed else {})}
    except jax.errors.JaxRuntimeError as error:  # such as memory that a device does not have: the other stages count
        return {**row, "unavailable": str(error).partition("\n")[0][:300], "failed": True}


def device_memory(before: Mapping[str, float] | None = None) -> dict[str, float]:
    """Give the most bytes that this process has had on the device so far, where the device counts them.

    Gives nothing where that is no more than it was `before`: the peak is that of an earlier stage.
    """
    peak = float((jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0))
    return {"device_memory_peak": peak} if peak > (before or {}).get("device_memory_peak", 0) else {}


# A process of its own


def alone(name: str, stage: Stage, config, repeats: int) -> dict[str, Any]:
    """Time a stage of `benchmark_stages.served` in a new process, which `serve`s it; raises Unavailable if it fails or takes over LIMIT."""
    request = json.dumps({"name": name, "config": options.to_dict(config), "repeats": repeats})
    command = [sys.executable, "-m", "experiments.benchmark_stages"]
    try:
        done = subprocess.run(
            command, input=request, capture_output=True, text=True, timeout=LIMIT, check=False,
            env={**stage.environment, **os.environ, "JAX_ENABLE_COMPILATION_CACHE": "false"},
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise Unavailable(f"not done after {LIMIT:.0f} s", failed=True) from None
    if done.returncode:
        raise Unavailable(ended(done), failed=True)
    row = json.loads(done.stdout.splitlines()[-1])
    if "unavailable" in row:
        raise Unavailable(row["unavailable"], failed=row.get("failed", False))
    return row


def ended(done: subprocess.CompletedProcess[str]) -> str:
    """Say with which status a process ended, and the last line of its errors."""
    last = (done.stderr.strip().splitlines() or [""])[-1]
    return f"ended with status {done.returncode}: {last[:300]}"


def serve(stages: Mapping[str, Stage]) -> None:
    """Time the stage that standard input asks for, and write its row as the last line of standard output.

    On Linux `process_memory` is the most that running it took, in bytes, over what the process took once the modules were imported;
    compiling is not in it, but for what it left. Nothing is told of what starts processes: theirs is not known.
    """
    request = json.load(sys.stdin)
    stage, config = stages[request["name"]], options.from_dict(request["config"])
    try:
        for module in stage.needs:
            try:
                importlib.import_module(module)
            except ImportError as error:
                raise Unavailable(f"needs {module}: {error}") from error
        before = memory("VmRSS")
        work = stage.prepare(config)
        forget_peak()
        others = None if before is None else faults_of_children()
        row = measured(work, request["repeats"]) | device_memory()
        if before is not None and faults_of_children() == others:
            row["process_memory"] = memory("VmHWM") - before
    except Unavailable as error:
        row = {"unavailable": str(error), **({"failed": True} if error.failed else {})}
    print(f"\n{json.dumps(row)}", flush=True)


def memory(field: str) -> float | None:
    """Read a field of `STATUS` in bytes: VmRSS, what this process takes now, or VmHWM, the most since `forget_peak`; None elsewhere."""
    if not STATUS.exists():
        return None
    return 1024.0 * next(int(line.split()[1]) for line in STATUS.read_text().splitlines() if line.startswith(f"{field}:"))


def faults_of_children() -> int:
    """Count the pages that processes which this one started and waited for have asked for: more after one of them; on Unix."""
    import resource

    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_minflt


def forget_peak() -> None:
    """Let VmHWM begin at what this process takes now."""
    if STATUS.exists():
        STATUS.with_name("clear_refs").write_text("5")
