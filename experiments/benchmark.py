"""What every stage costs, alone and together: `python -m experiments.benchmark --task=pallet`.

Times the stages of `benchmark_stages` at the sizes of `configs/<task>.py`, and with `--growth=true` how some grow with a size; a matrix
product and a copy of the same run say how much of the machine's own rate a stage reaches, and `benchmark_targets` what it must show.
Writes `<device>-<task>.json` to `--out` and prints its tables; until all is timed, what there is lies in `<device>-<task>.part.json`.
`--stages=render,fuse` times only these (and the two ceilings); as ratios are of one run, it is refused where it would replace a file
that holds other stages, too.
`--against=FILE` compares with an earlier file by ratios of medians, and ends with status 1 where a stage takes more than `--limit`
times as long or fails; with `--timed=FILE` it is that file that is compared, and nothing is timed. Comparisons that need what is not
installed (PyTorch: extra `benchmark`; OpenGL: Debian's libegl1 and libgl1-mesa-dri) are left out, and the table says so.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import pathlib
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import jax

from experiments import benchmark_stages, benchmark_targets, common, timing
from lala_jax import compiling, options, writers

LIBRARIES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "mujoco", "mujoco-mjx", "numpy")
FLAGS = {
    "task": "pallet",
    "stages": "",
    "growth": False,
    "repeats": 5,
    "against": "",
    "timed": "",
    "limit": 1.3,
    "out": "experiments/results/benchmark",
}


def main(
    config, workdir, *, task: str, stages: str, growth: bool, repeats: int, against: str, timed: str, limit: float, out: str
) -> dict[str, Any]:
    """Time the stages of a task, and compare them with an earlier run's."""
    del workdir
    common.check_task(config, task)
    for flag, value, least in (("--repeats", repeats, 1), ("--limit", limit, 0)):
        if value < least:
            raise options.OptionsError(f"{flag} must be at least {least}, got {value}")
    every, ceilings = benchmark_stages.STAGES, benchmark_stages.CEILINGS
    known = [name for name in every if name not in ceilings]
    wanted = [options.check_choice("--stages", name, known) for name in stages.split(",") if name] or known
    before = read(against) if against else None
    if timed:
        if before is None:
            raise options.OptionsError(f"--timed={timed} is compared with --against=FILE, which is not given")
        result = read(timed, "--timed")
        check_comparable(before, result, wanted, now="--timed holds")
        if slower(before, only(result, wanted), limit):
            raise SystemExit(1)
        return result
    here = machine()
    if before is not None:
        check_comparable(before, {"task": task, **here}, wanted)
    kind = "".join(letter if letter.isalnum() else "-" for letter in here["device"].lower())
    path = pathlib.Path(out) / f"{kind}-{task}.json"
    if path.exists():
        held = read(str(path), "--out")
        if lost := {row["name"] for row in held["stages"]} - {*ceilings, *wanted}:
            left = ", ".join(sorted(lost))
            raise options.OptionsError(f"{path} holds stages that --stages={stages} leaves out: {left}; give another --out")
        if held.get("growth") and not growth:
            raise options.OptionsError(f"{path} holds how cost grows, which this leaves out: give --growth=true or another --out")
    apart = jax.default_backend() == "cpu"  # a GPU's memory is this process's
    rows, grown = [], []
    writers.make_directory(path.parent)

    def report() -> dict[str, Any]:
        return {"task": task, **here, **judged(rows, task), "growth": grown}

    part = path.with_suffix(".part.json")
    for name in (*ceilings, *wanted):
        print(f"{name}: {every[name].label}", flush=True)
        rows.append(timing.timed(name, every, config, repeats, apart=apart))
        print(f"  {cost(rows[-1])}", flush=True)
        writers.write_json(part, report())
    for name in benchmark_stages.GROWTH if growth else ():
        grown.append(benchmark_stages.grow(name, config, repeats, apart=apart))
        writers.write_json(part, report())
    part.replace(path)
    result = report()
    parts = [table(result["stages"]), *([growth_table(grown)] if grown else []), benchmark_targets.table(result["targets"]), str(path)]
    print("".join(f"\n{part}\n" for part in parts))
    if before is not None and slower(before, result, limit):
        raise SystemExit(1)
    return result


def judged(rows: Sequence[Mapping[str, Any]], task: str) -> dict[str, Any]:
    """Give the stages with their shares of the ceilings among them, and what they show of the targets."""
    peaks: dict[str, float] = {}
    for row in rows:
        if (field := benchmark_stages.PEAKS.get(row["name"])) and f"{field}_per_second" in row:
            peaks[field] = max(row[f"{field}_per_second"], peaks.get(field, 0.0))
    shares = [{field: row[f"{field}_per_second"] / peak for field, peak in peaks.items() if f"{field}_per_second" in row} for row in rows]
    targets = [benchmark_targets.judged(target, rows, task, jax.default_backend()) for target in benchmark_targets.TARGETS]
    return {"stages": [{**row, "share": share} for row, share in zip(rows, shares, strict=True)], "targets": targets}


def machine() -> dict[str, Any]:
    """Say what was measured on."""
    device = jax.devices()[0]
    extras = [name for name in ("torch",) if importlib.util.find_spec(name)]
    return {
        "device": device.device_kind,
        "devices": jax.device_count(),
        "processors": os.cpu_count(),
        "processor": processor(),
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": {name: importlib.metadata.version(name) for name in (*LIBRARIES, *extras)},
    }


def processor() -> str:
    """Name the model of the CPU, as Linux tells it, else as Python does."""
    info = pathlib.Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor())


# Tables and comparisons


def cost(row: Mapping[str, Any]) -> str:
    """Write a row's median, or why there is none."""
    one = "an" if row["unit"][0] in "aeiou" else "a"
    return row.get("unavailable") or f"{median(row)} {one} {row['unit']}"


def median(row: Mapping[str, Any]) -> str:
    """Write a row's median alone, or why there is none."""
    return row.get("unavailable") or benchmark_targets.seconds_text(row["seconds"])


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Write the stages as a Markdown table; memory is what XLA reckons for one run, or what a process of its own took for it."""
    lines = []
    for row in rows:
        if "unavailable" in row:
            lines.append([row["label"], cost(row), *[""] * 5])
            continue
        share = [f"{100 * row['share'][field]:.0f}%" if field in row["share"] else "" for field in benchmark_stages.CEILINGS.values()]
        spread = f"{benchmark_targets.seconds_text(row['lowest'])} to {benchmark_targets.seconds_text(row['highest'])}"
        need = row.get("process_memory", row.get("memory"))
        size = "" if need is None else f"{need / 2**20:,.0f} MiB"
        lines.append([row["label"], cost(row), spread, f"{row['runs']}", *share, size])
    return common.table(["stage", "median", "range", "runs", "of the matrix rate", "of the copy rate", "memory"], lines)


def growth_table(grown: Sequence[Mapping[str, Any]]) -> str:
    """Write what grows as a Markdown table."""
    lines = [[one["label"], ", ".join(f"{row['value']}: {median(row)}" for row in one["rows"])] for one in grown]
    return common.table(["", "time"], lines)


def read(path: str, flag: str = "--against") -> dict[str, Any]:
    """Read a file of this benchmark; raises OptionsError, naming the flag that led there, where it is none."""
    try:
        found = json.loads(pathlib.Path(path).read_text())
        return {**found, "stages": list(found["stages"])}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise options.OptionsError(f"{flag}={path} is no file of this benchmark: {type(error).__name__} {error}") from error


def check_comparable(before: Mapping[str, Any], after: Mapping[str, Any], names: Sequence[str], *, now: str = "this is") -> None:
    """Raise OptionsError where an earlier file is of another task or machine, or has no time of any stage in `names`.

    An older file does not name its processor, and is compared with a warning.
    """
    there, here = (f"{one['task']} on {one['device']}, {one['processors']} processors" for one in (before, after))
    if unnamed := [flag for flag, one in (("--against", before), ("--timed", after)) if "processor" not in one]:
        print(f"{' and '.join(unnamed)} without the name of a processor: are both of one machine? Else ratios say nothing", flush=True)
    elif there == here and before["processor"] != after["processor"]:
        there, here = before["processor"], after["processor"]
    if there != here:
        raise options.OptionsError(f"--against holds {there}, {now} {here}: their ratio says nothing")
    if not {row["name"] for row in before["stages"] if "seconds" in row} & set(names):
        raise options.OptionsError(f"--against holds times of none of the stages {', '.join(names)}")


def only(result: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Keep some of the stages, and the ceilings."""
    return {**result, "stages": [row for row in result["stages"] if row["name"] in (*benchmark_stages.CEILINGS, *names)]}


def medians(result: Mapping[str, Any]) -> dict[str, float]:
    """Give the median of each stage that was timed, and of each size of what grows."""
    grown = [{**row, "name": f"{one['name']} {row['value']}"} for one in result.get("growth", ()) for row in one["rows"]]
    return {row["name"]: row["seconds"] for row in (*result["stages"], *grown) if "seconds" in row}


def slower(before: Mapping[str, Any], after: Mapping[str, Any], limit: float) -> list[str]:
    """Print the ratio of each stage's medians, after to before, and name the stages above `limit` and those that no longer run.

    The ceilings are printed, too, but judged not: no code of ours changes them.
    """
    old = medians(before)
    lost = {row["name"]: row["unavailable"] for row in after["stages"] if row.get("failed") and row["name"] in old}
    ratios = {name: seconds / old[name] for name, seconds in medians(after).items() if name in old}
    print(common.table(["stage", "time, ratio"], [[name, f"{ratio:.2f}"] for name, ratio in ratios.items()]))
    found = [name for name, ratio in ratios.items() if ratio > limit and name not in benchmark_stages.CEILINGS]
    if found:
        print(f"more than {limit} times as long: {', '.join(found)}")
    for name, why in lost.items():
        print(f"{name} no longer runs: {why}")
    return [*found, *lost]


def command(argv: Sequence[str] | None = None):
    """Run from the command line."""
    return options.run(main, flags=FLAGS, config_from=common.shipped_config, workdir=".", user_errors=common.USER_ERRORS, argv=argv)


if __name__ == "__main__":
    compiling.keep_memory()  # as the commands do that it is about
    command()
