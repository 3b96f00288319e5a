"""What the benchmark must show: times of two cores or of a large GPU, and ratios of two stages of one run."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from experiments import common

Row = Mapping[str, Any]
EPISODES = 100  # of a closed loop


@dataclasses.dataclass(frozen=True)
class Target:
    """A bound on what `compute` makes of the rows of `stages`, or of all measured rows where none is named."""

    label: str
    bound: float
    unit: str  # a key of UNITS
    stages: tuple[str, ...]
    compute: Callable[..., float]
    at_least: bool = False
    task: str = ""  # the only one that it is about
    platform: str = ""  # the only one of JAX's that it is about


def ratio(row: Row, other: Row, *, field: str = "seconds") -> float:
    return row[field] / other[field]


def least_ratio(row: Row, again: Row, other: Row, *, field: str = "seconds") -> float:
    """Compare with the better of two ways of one thing."""
    return min(row[field], again[field]) / other[field]


def seconds(row: Row, *, of: int = 1) -> float:
    return of * row["seconds"]


def again(*rows: Row) -> float:
    return sum(row["recompiled"] for row in rows)


cpu, gpu = (functools.partial(Target, platform=platform) for platform in ("cpu", "gpu"))
times = functools.partial(cpu, unit="times", compute=ratio, at_least=True)
BOTH = ("train-paper-torch", "train-paper-torch-given-back", "train-paper-network")
LARGE = ("train-paper-bfloat16",)
TARGETS = (
    times("mujoco.Renderer's time over ours, 4 views of 640 x 480", 10, stages=("render-mujoco", "render")),
    cpu("render, unproject and fuse an observation, batch 8", 0.025, "s", ("observe",), seconds),
    times("conv2d of PyTorch, time over our correlation's", 20, stages=("correlate-torch", "correlate")),
    times("direct convolution of JAX, likewise", 20, stages=("correlate-direct", "correlate")),
    times("paper's step in PyTorch, time over ours", 6, stages=BOTH, compute=least_ratio),
    times("paper's step in PyTorch, memory over ours", 1, stages=BOTH, compute=functools.partial(least_ratio, field="process_memory")),
    gpu("paper's step in bfloat16, a sample", 0.01, "s", LARGE, seconds),
    gpu("20,000 samples of it", 240, "s", LARGE, functools.partial(seconds, of=20_000)),
    gpu(
        "its rate over a matrix product's",
        0.35,
        "%",
        (*LARGE, "matmul-bfloat16"),
        functools.partial(ratio, field="flops_per_second"),
        at_least=True,
    ),
    gpu("training step, a sample, batch 64", 0.001, "s", ("train-many",), seconds),
    gpu("render, unproject and fuse an observation, batch 64", 0.0005, "s", ("observe-many",), seconds),
    Target("a demonstration of a tower", 0.5, "s", ("collect",), seconds, task="tower"),
    Target(f"closed loop of {EPISODES} episodes", 180, "s", ("evaluate",), functools.partial(seconds, of=EPISODES)),
    cpu("input pipeline's share of the training step", 0.15, "%", ("inputs", "train"), ratio),
    Target("programs compiled again after a first run", 0, "", (), again),
    Target("starting Python and importing lala_jax", 0.3, "s", ("import",), seconds),
    cpu("first training step from a cold start", 60, "s", ("first-step",), seconds),
    cpu("first training step with kept programs", 15, "s", ("first-step-cached",), seconds),
)


def judged(target: Target, rows: Sequence[Row], task: str, platform: str) -> dict[str, Any]:
    """Say what was measured and whether the target is met, or `unavailable`: why that cannot be said."""
    found = {"label": target.label, "bound": target.bound, "unit": target.unit, "at_least": target.at_least}
    by_name = {row["name"]: row for row in rows}
    if target.task not in ("", task):
        return {**found, "unavailable": f"measured with --task={target.task}"}
    if target.platform not in ("", platform):
        return {**found, "unavailable": f"about a {target.platform.upper()}"}
    for name in target.stages:
        if name not in by_name:
            return {**found, "unavailable": f"{name} was not timed"}
        if "unavailable" in by_name[name]:
            return {**found, "unavailable": f"{name}: {by_name[name]['unavailable']}"}
    chosen = [by_name[name] for name in target.stages] or [row for row in rows if "unavailable" not in row]
    try:
        value = target.compute(*chosen)
    except KeyError as error:
        return {**found, "unavailable": f"this machine does not tell {error}"}
    return {**found, "value": value, "met": value >= target.bound if target.at_least else value <= target.bound}


def table(targets: Sequence[Mapping[str, Any]]) -> str:
    """Write what `judged` gave as a Markdown table."""
    lines = []
    for one in targets:
        write = UNITS[one["unit"]]
        bound = f"at {'least' if one['at_least'] else 'most'} {write(one['bound'])}"
        measured = [one["unavailable"], "unknown"] if "unavailable" in one else [write(one["value"]), "yes" if one["met"] else "MISSED"]
        lines.append([one["label"], measured[0], bound, measured[1]])
    return common.table(["what it must show", "measured", "target", "met"], lines)


def seconds_text(seconds: float) -> str:
    """Write a time with three digits: `12.3 ms`."""
    scale, unit = next(pair for pair in ((1.0, "s"), (1e3, "ms"), (1e6, "us")) if seconds * pair[0] >= 1.0 or pair[1] == "us")
    return f"{seconds * scale:.3g} {unit}"


UNITS: Mapping[str, Callable[[float], str]] = {
    "s": seconds_text,
    "times": "{:.3g} times".format,
    "%": "{:.1%}".format,
    "": "{:.0f}".format,
}
