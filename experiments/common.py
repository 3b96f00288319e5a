"""What the experiments share: rows as data, a JSON file of finished rows to go on from, differences with intervals, Markdown tables.

Every file is `{"task", ..., "rows": [...]}`. A row has `name`, `label`, what identifies it (`overrides`, `seeds`, `checkpoint` or null,
`config`), its scores (`score`, `interval95`, `complete_percent`, `first_failures`, ..., `scores` by seed) and `seconds`, how long it took.
"""

from __future__ import annotations

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

from lala_jax import build, checkpoint, loop, options, pretrained, rollout, scoring, train, writers
from lala_jax.sim import tasks

USER_ERRORS = (*build.USER_ERRORS, loop.NonFiniteError)


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


def choose(rows: Sequence, names: str, task: str) -> list:
    """Give the first row, with which the others are compared, and those of `names` (comma-separated, "" for all) that apply to the task."""
    valid = [row for row in rows if task in (row.tasks or (task,))]
    wanted = [options.check_choice("--rows", name, [row.name for row in valid]) for name in names.split(",") if name]
    return [row for row in valid if not wanted or row.name in wanted or row is valid[0]]


def identity(row: Row, config, seeds: Sequence[int], *, weights: Mapping[str, Any] | None) -> dict[str, Any]:
    """Say what a row of changes to `config` is the result of; `weights` where it does not train its own."""
    own = options.to_dict(row.configs(config)[0])
    return writers.plain({"overrides": row.changes(config), "seeds": [seeds[0], seeds[-1]], "checkpoint": weights, "config": own})


def is_same(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Say whether a stored row is the result of the wanted identity; what makes no difference may differ, and new fields may be missing."""
    there, here = (build.run_settings(one["config"]) for one in (stored, wanted))
    exact = all(stored[name] == wanted[name] for name in ("overrides", "seeds", "checkpoint"))
    return exact and all(there[name] == here[name] for name in there.keys() & here.keys())


def fill(
    path: pathlib.Path,
    rows: Sequence[Row],
    run: Callable[[Any], Mapping[str, Any]],
    finish: Callable[[list[dict[str, Any]], list[dict[str, Any]]], Mapping[str, Any]],
    *,
    config,
    seeds: Sequence[int],
    weights: Mapping[str, Any] | None = None,
) -> list[dict[str, Any]]:
    """Give the fields of all `rows`; those that are not in the file are run, and the file is written after each.

    A row of the file with a row's name and another `identity` is run again and replaced, other rows stay. `finish(done, kept)` may
    add to the rows that are `done`, and gives the file's other fields; `kept` are all rows of the file that are results of the same
    seeds and weights, also those not asked for.
    """
    stored = {row["name"]: row for row in json.loads(path.read_text())["rows"]} if path.exists() else {}
    wanted = [identity(row, config, seeds, weights=weights) for row in rows]  # of all, before the first is run
    done = []
    for row, own in zip(rows, wanted, strict=True):
        found = stored.get(row.name)
        if found is None or not is_same(found, own):
            print(f"{row.name}: {row.label}", flush=True)
            begin, result, device = time.time(), run(row), jax.devices()[0].device_kind
            found = {"name": row.name, **result, "seconds": time.time() - begin, "device": device, **own}
        stored[row.name] = found | {"label": row.label}
        done.append(stored[row.name])
        kept = [one for one in stored.values() if all(one[name] == own[name] for name in ("seeds", "checkpoint"))]
        writers.write_json(path, {**finish(done, kept), "rows": list(stored.values())})
    return done


# Runs and scores


def shipped_config(flags: Mapping[str, Any]):
    """Give the config that ships for the task that `flags` name."""
    return options.load(f"configs/{options.check_choice('--task', flags['task'], tasks.names())}.py")


def train_seconds(workdir: pathlib.Path) -> float:
    """Sum up the time that a run's training steps took, as its curve says: compiling is in it, validation not."""
    taken = {row["step"]: row["seconds_per_step"] for row in writers.read_metrics(workdir / "metrics.jsonl") if "seconds_per_step" in row}
    return sum((step - before) * taken[step] for before, step in itertools.pairwise([0, *sorted(taken)]))


def train_and_score(config, directory: pathlib.Path) -> dict[str, Any]:
    """Train a run, or go on with it, and score it: the row's fields."""
    summary = train.train_and_evaluate(config, str(directory))
    return {**row_of(summary), "train_seconds": train_seconds(directory)}


def load_weights(path: str, config) -> tuple[Any, dict[str, Any]]:
    """Load the averaged parameters of a checkpoint, and say what identifies them."""
    params = scoring.check_checkpoint(path, config, build.build_policy(config))
    content = b"".join(np.asarray(leaf).tobytes() for _, leaf in sorted(checkpoint.named(params).items()))
    return params, {"step": pretrained.describe(path)["step"], "crc32": zlib.crc32(content)}


def score(config, params, seeds: Sequence[int]) -> dict[str, Any]:
    """Score weights in the world of the config: `rollout.summary`."""

    def told(done, total):
        print(f"  {done} of {total} episodes", flush=True)

    return scoring.evaluate(
        build.build_policy(config), params, build.observer(config), seeds=seeds, parallel=config.eval.parallel,
        threads=config.data.threads, seed=config.seed, progress=told,
    )[0]  # fmt: skip


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


def cells(row: Mapping[str, Any], against: str = "") -> list[str]:
    """Write a row's label, score and complete rate, and where `against` names it the field that compares it with the first row."""
    found = [row["label"], with_interval(row["score"], row["interval95"]), f"{row['complete_percent']:.0f}%"]
    if against:
        found.append(with_interval(row[against]["mean"], row[against]["interval95"], signed=True) if against in row else "")
    return found


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Write a Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, ["---"] * len(header), *lines))
