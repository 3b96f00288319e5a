"""What the experiments share: rows as data, a JSON file of finished rows to go on from, differences with intervals, Markdown tables.

Every file is `{"task", ..., "rows": [...]}`. A row has `name`, `label`, what identifies it (`overrides`, `seeds`, `checkpoint` or null,
`config`), its scores (`score`, `interval95`, `complete_percent`, `first_failures`, ..., `scores` by seed) and `seconds`, how long it took.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
import math
import pathlib
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from lala_jax import build, checkpoint, options, pretrained, rollout, scoring, train, writers
from lala_jax.sim import tasks

USER_ERRORS = (*build.USER_ERRORS, train.NonFiniteError)
COUNTS = ("actions_by_cause", "first_failures", "lost_objects", "failures_by_reason")  # of a summary


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table: how its config differs. An override may name fields of the config that it changes, `{config.data.directory}`."""

    name: str
    label: str  # in the table
    overrides: tuple[str, ...] = ()
    parts: tuple[tuple[str, ...], ...] = ((),)  # further overrides, each for an equal share of the episodes
    tasks: tuple[str, ...] = ()  # () for all

    def changes(self, config) -> list[list[str]]:
        """Give the overrides of each part."""
        return [[text.format(config=config) for text in (*self.overrides, *part)] for part in self.parts]

    def configs(self, config) -> list:
        """Give the config of each part."""
        return [options.override(config, texts) for texts in self.changes(config)]


@dataclasses.dataclass(frozen=True)
class Job:
    """A row to be filled in: `identity` (JSON) says what it is the result of, `run` gives its fields."""

    name: str
    label: str
    identity: Mapping[str, Any]
    run: Callable[[], Mapping[str, Any]]


def choose(rows: Sequence, names: str, task: str) -> list:
    """Give the first row, with which the others are compared, and those of `names` (comma-separated, "" for all) that apply to the task."""
    valid = [row for row in rows if task in (row.tasks or (task,))]
    wanted = [options.check_choice("--rows", name, [row.name for row in valid]) for name in names.split(",") if name]
    return [row for row in valid if not wanted or row.name in wanted or row is valid[0]]


def numbers(name: str, text: str) -> list[int]:
    """Read a flag of comma-separated whole numbers."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise options.OptionsError(f"{name} must be whole numbers like 500,50,10, got {text!r}") from None


def identity(row: Row, config, seeds: Sequence[int], *, weights: Mapping[str, Any] | None) -> dict[str, Any]:
    """Say what a row of changes to `config` is the result of; `weights` where it does not train its own."""
    own = options.to_dict(row.configs(config)[0])
    return writers.plain({"overrides": row.changes(config), "seeds": [seeds[0], seeds[-1]], "checkpoint": weights, "config": own})


def is_same(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Say whether a stored row is the result of the wanted identity; what makes no difference may differ, and new fields may be missing."""
    there, here = (build.run_settings(one["config"]) for one in (stored, wanted))
    exact = all(stored[name] == wanted[name] for name in ("overrides", "seeds", "checkpoint"))
    return exact and all(there[name] == here[name] for name in there.keys() & here.keys())


def fill(path: pathlib.Path, jobs: Sequence[Job], finish: Callable[[Sequence[dict[str, Any]]], Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Run the jobs whose rows are not in the file, which is written after each, and give all their rows.

    A row of the file with a job's name and another identity is run again and replaced, other rows stay. `finish` may add to the jobs'
    finished rows, and gives the file's other fields.
    """
    stored = {row["name"]: row for row in json.loads(path.read_text())["rows"]} if path.exists() else {}
    rows = []
    for job in jobs:
        row = stored.get(job.name)
        if row is None or not is_same(row, job.identity):
            print(f"{job.name}: {job.label}", flush=True)
            begin, result, device = time.time(), job.run(), jax.devices()[0].device_kind
            row = {"name": job.name, **result, "seconds": time.time() - begin, "device": device, **job.identity}
        stored[job.name] = row | {"label": job.label}
        rows.append(stored[job.name])
        writers.write_json(path, {**finish(rows), "rows": list(stored.values())})
    return rows


# Runs and scores


def shipped_config(flags: Mapping[str, Any]):
    """Give the config that ships for the task that `flags` name."""
    return options.load(f"configs/{options.check_choice('--task', flags['task'], tasks.names())}.py")


def train_seconds(workdir: pathlib.Path) -> float:
    """Sum up the time that a run's training steps took, as its curve says: compiling is in it, validation not."""
    taken = {row["step"]: row["seconds_per_step"] for row in writers.read_metrics(workdir / "metrics.jsonl") if "seconds_per_step" in row}
    return sum((step - before) * taken[step] for before, step in itertools.pairwise([0, *sorted(taken)]))


def load_weights(path: str, config, agent) -> tuple[Any, dict[str, Any]]:
    """Load the averaged parameters of a checkpoint, and say what identifies them."""
    params = scoring.check_checkpoint(path, config, agent)
    crc = 0
    for _, leaf in sorted(checkpoint.named(params).items()):
        crc = zlib.crc32(np.ascontiguousarray(leaf).tobytes(), crc)
    return params, {"step": pretrained.describe(path)["step"], "crc32": crc}


def score(config, params, seeds: Sequence[int]) -> dict[str, Any]:
    """Score weights in the world of the config: `rollout.summary`."""

    def told(done, total):
        print(f"  {done} of {total} episodes", flush=True)

    parallel = min(config.eval.parallel, len(seeds))
    agent, observer = build.build_policy(config), build.observer(config)
    options = {"seeds": seeds, "parallel": parallel, "threads": config.data.threads, "seed": config.seed}
    return scoring.evaluate(agent, params, observer, progress=told, **options)[0]


def shares(seeds: Sequence[int], count: int) -> list[list[int]]:
    """Deal seeds in order to `count` parts as equal as can be."""
    return [part.tolist() for part in np.array_split(np.asarray(seeds), count) if part.size]


def merged(summaries: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Give the summary of all episodes from those of parts."""
    lines = [line for summary in summaries for line in summary["per_episode"]]
    scores = np.array([line["score"] for line in lines])
    mean, half = float(scores.mean()), rollout.half_width(scores)
    counts = {name: collections.Counter() for name in COUNTS}
    for name, counter in counts.items():
        for summary in summaries:
            counter.update(summary[name])
    return {
        "episodes": len(lines),
        "score": mean,
        "interval95": [max(mean - half, 0.0), min(mean + half, 100.0)],
        "complete_percent": 100.0 * float(np.mean([line["complete"] for line in lines])),
        "actions": sum(line["actions"] for line in lines),
        **{name: dict(counter) for name, counter in counts.items()},
        "per_episode": lines,
    }


def row_of(summary: Mapping[str, Any]) -> dict[str, Any]:
    """Give a summary as a row holds it: of the episodes only the score by seed."""
    fields = {name: value for name, value in summary.items() if name != "per_episode"}
    return {**fields, "scores": {str(line["seed"]): line["score"] for line in summary["per_episode"]}}


def difference(scores: Mapping[str, float], reference: Mapping[str, float], *, paired: bool) -> dict[str, Any]:
    """Give the mean of `scores` less that of `reference`, both by seed, with its 95% interval.

    `paired`: the episodes of a seed are of one scene, so that the interval is that of the differences.
    """
    if paired:
        if scores.keys() != reference.keys():
            raise ValueError(f"paired scores need the same seeds, got {len(scores)} and {len(reference)} of them, or others")
        half = rollout.half_width([value - reference[seed] for seed, value in scores.items()])
    else:
        half = math.hypot(*(rollout.half_width(list(one.values())) for one in (scores, reference)))
    mean = float(np.mean(list(scores.values())) - np.mean(list(reference.values())))
    return {"mean": mean, "interval95": [mean - half, mean + half], "paired": paired}


# Tables


def with_interval(value: float, interval: Sequence[float | None], *, signed: bool = False) -> str:
    """Write `81.2 [75.0, 87.4]`; an interval of too few episodes is left out."""
    form = "{:+.1f}" if signed else "{:.1f}"
    low, high = (math.nan if end is None else end for end in interval)
    return form.format(value) + ("" if math.isnan(low) else f" [{form.format(low)}, {form.format(high)}]")


def counted(counts: Mapping[str, int]) -> str:
    """Write the counts that are not 0, the largest first: `3 wrong yaw, 1 missed pick`."""
    return ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda item: -item[1]) if n)


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Write a Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, ["---"] * len(header), *lines))
