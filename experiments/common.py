"""What the experiments share: rows as data, a JSON file of finished rows to go on from, differences with intervals, Markdown tables.

Every file is `{"task", ..., "rows": [...]}`. A row has `name`, `label`, what identifies it (`overrides`, `revision`, `seeds`,
`checkpoint` or null, `config`, `beside`), its scores (`score`, `interval95`, `complete_percent`, `first_failures`, ..., `scores` by seed)
and `seconds`, how long its last start took.
Rows run one after the other in this process, or each in a worker of its own.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import math
import pathlib
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from lala_jax import build, checkpoint, cluster, loop, options, pretrained, recording, rollout, scoring, train, writers
from lala_jax.sim import tasks

USER_ERRORS = (*build.USER_ERRORS, loop.NonFiniteError)
ERRS = ("camera.shift", "camera.turn", "camera.depth_noise")  # how cameras err is drawn for as many episodes as are observed at once
CHOOSES = ("train.eval_every", "train.eval_episodes")  # fields by which the checkpoint that is scored is chosen


@dataclasses.dataclass(frozen=True)
class Row:
    """One row of a table: how its config differs. An override may name fields of the config that it changes, `{config.data.directory}`."""

    name: str
    label: str  # in the table
    overrides: tuple[str, ...] = ()
    parts: tuple[tuple[str, ...], ...] = ((),)  # further overrides, each for an equal share of the episodes
    tasks: tuple[str, ...] = ()  # () for all
    needs: tuple[str, ...] = ()  # rows whose weights it takes: they come before
    revision: int = 0  # raised when code changes what the row gives: its older results and runs then no longer count

    @property
    def folder(self) -> str:
        """Name the directory of its run."""
        return f"{self.name}-r{self.revision}" if self.revision else self.name

    def beside(self, config) -> dict[str, Any]:
        """Give what else its result depends on: settings of `config` that `build.run_settings` leaves out."""
        return {}

    def changes(self, config) -> list[list[str]]:
        """Give the overrides of each part."""
        return [[text.format(config=config) for text in (*self.overrides, *part)] for part in self.parts]

    def configs(self, config) -> list:
        """Give the config of each part."""
        return [options.override(config, texts) for texts in self.changes(config)]


@dataclasses.dataclass(frozen=True)
class Before:
    """What several rows share, and workers do first: in one process the first of the rows does it."""

    name: str
    call: Callable[[], Any]
    rows: tuple[str, ...]


def recordings(rows: Sequence[Row], config) -> list[Before]:
    """Give the recording of the demonstrations that several of `rows` learn from, as many as the most demanding takes."""
    users: dict[str, list[tuple[str, Any]]] = {}
    for row in rows:
        own = row.configs(config)[0]
        users.setdefault(own.data.directory, []).append((row.name, own))
    found = []
    for directory, pairs in users.items():
        if len(pairs) > 1:
            largest = max((own for _, own in pairs), key=lambda own: own.data.demos)
            names = tuple(name for name, _ in pairs)
            found.append(Before(f"demonstrations in {directory}", functools.partial(recording.collect, largest, quiet=True), names))
    return found


def choose(rows: Sequence, names: str, task: str, *, reference: bool = True) -> list:
    """Give the rows of `names` (comma-separated, "" for all) that apply to the task.

    With `reference` the first is always among them: the others are compared with it.
    """
    valid = [row for row in rows if task in (row.tasks or (task,))]
    wanted = [options.check_choice("--rows", name, [row.name for row in valid]) for name in names.split(",") if name]
    return [row for row in valid if not wanted or row.name in wanted or (reference and row is valid[0])]


def identity(row: Row, config, seeds: Sequence[int], *, weights: Mapping[str, Any] | None) -> dict[str, Any]:
    """Say what a row of changes to `config` is the result of; `weights` where it does not train its own."""
    own = options.to_dict(row.configs(config)[0])
    named = {"overrides": row.changes(config), "revision": row.revision, "seeds": [seeds[0], seeds[-1]]}
    return writers.plain({**named, "checkpoint": weights, "config": own, "beside": row.beside(config)})


def is_same(stored: Mapping[str, Any], wanted: Mapping[str, Any]) -> bool:
    """Say whether a stored row is the result of the wanted identity; what makes no difference may differ, and new fields may be missing."""
    stored = {"revision": 0, "beside": {}, **stored}
    exact = all(stored[name] == wanted[name] for name in ("overrides", "revision", "seeds", "checkpoint", "beside"))
    return exact and _alike(stored["config"], wanted["config"], trains=wanted["checkpoint"] is None)


def _alike(there: Mapping[str, Any], here: Mapping[str, Any], *, trains: bool) -> bool:
    """Say whether two configs, one of which may be older than some fields, give the same result.

    What `trains` may learn something else from another directory, also where as many demonstrations of the same task lie there.
    """

    def settings(config):
        fields = options.fields(config)
        more = CHOOSES if not any(fields[name] for name in ERRS if name in fields) else (*CHOOSES, "eval.parallel")
        more = (*more, "data.directory") if trains else more
        return build.run_settings(config) | {name: fields[name] for name in more if name in fields}

    first, second = settings(there), settings(here)
    return all(first[name] == second[name] for name in first.keys() & second.keys())


def belongs(stored: Mapping[str, Any], config, seeds: Sequence[int], weights: Mapping[str, Any] | None) -> bool:
    """Say whether a stored row, whatever its name, is a result of changes to `config`, of these seeds and weights."""
    try:
        own = writers.plain(options.to_dict(options.override(config, stored["overrides"][0])))
    except options.OptionsError:  # it changes a field that is no more
        return False
    named = writers.plain({"seeds": [seeds[0], seeds[-1]], "checkpoint": weights})
    return all(stored[name] == value for name, value in named.items()) and _alike(stored["config"], own, trains=weights is None)


def fill(
    path: pathlib.Path,
    rows: Sequence[Row],
    run: Callable[[Any], Mapping[str, Any]],
    finish: Callable[[list[dict[str, Any]], list[dict[str, Any]]], Mapping[str, Any]],
    *,
    config,
    seeds: Sequence[int],
    weights: Mapping[str, Any] | None = None,
    launch: cluster.Launcher | None = None,
    before: Sequence[Before] = (),
    known: Sequence[Row] = (),
) -> list[dict[str, Any]]:
    """Give the fields of all `rows`; those that are not in the file are run, and each is added to what the file holds by then.

    A row of the file with a row's name and another `identity` is run again and replaced, other rows stay. `finish(done, kept)` may
    add to the rows that are `done`, in the order of `rows`, and gives the file's other fields; `kept` are all rows of the file that
    belong to the same config, seeds and weights, also those not asked for, but for old revisions of `known` rows. With `launch` the
    rows are run by workers, after what they share, `before`. Where some fail, the file holds the others, and SystemExit is raised.
    """
    writers.make_directory(path.parent)
    stored = read(path)
    order = [*stored, *(row.name for row in rows)]
    wanted = {row.name: identity(row, config, seeds, weights=weights) for row in rows}  # of all, before the first is run
    found, done = {name: stored[name] for name, own in wanted.items() if name in stored and is_same(stored[name], own)}, {}
    if replaced := [name for name in wanted if name in stored and name not in found]:
        print(f"{path} holds {', '.join(replaced)} of other settings: replaced once they are run", flush=True)
    results = _here(rows, found, run, wanted) if launch is None else _fanned(launch, path, rows, found, run, wanted, before)
    for row, result in results:
        done[row.name] = result | {"label": row.label}
        finished = [done[one.name] for one in rows if one.name in done]
        with cluster.exclusive(path):
            stored = read(path) | done  # another command may have written to it
            kept = [one for one in stored.values() if belongs(one, config, seeds, weights) and not _is_old(one, known)]
            fields = finish(finished, kept)
            ordered = [stored[name] for name in dict.fromkeys([*order, *stored]) if name in stored]
            writers.write_json(path, {**fields, "rows": ordered})
    return [done[row.name] for row in rows]


def _is_old(stored: Mapping[str, Any], known: Sequence[Row]) -> bool:
    """Say whether a stored row is of another revision than the known one of its name."""
    return any(row.name == stored["name"] and row.revision != stored.get("revision", 0) for row in known)


def read(path: pathlib.Path) -> dict[str, dict[str, Any]]:
    """Read the rows of a file by name; none where there is no file. Raises OptionsError where it is something else."""
    return read_whole(path)[1]


def read_whole(path: pathlib.Path) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Read a file's own fields and its rows by name; as `read`."""
    if not path.exists():
        return {}, {}
    try:
        whole = json.loads(path.read_text())
        return whole, {row["name"]: row for row in whole["rows"]}
    except (ValueError, KeyError, TypeError) as error:
        text = f"{path} is damaged or no file of rows ({type(error).__name__} {error}): move it away, or give another --out"
        raise options.OptionsError(text) from error


def check_held(path: pathlib.Path, wanted: Mapping[str, Any]) -> None:
    """Raise OptionsError where a file holds rows that other values of the flags `wanted` made; an older file may not say."""
    held = read_whole(path)[0]
    if other := [f"--{name}={held[name]}" for name, value in wanted.items() if held.get(name, value) != value]:
        raise options.OptionsError(f"{path} holds rows of {' '.join(other)}: give another --out")


def outcome(row: Row, run: Callable[[Any], Mapping[str, Any]], own: Mapping[str, Any]) -> dict[str, Any]:
    """Run a row: all its fields but the label."""
    print(f"{row.name}: {row.label}", flush=True)
    begin, result, device = time.time(), run(row), jax.devices()[0].device_kind
    return {"name": row.name, **result, "seconds": time.time() - begin, "device": device, **own}


def _here(rows, found, run, wanted) -> Iterator[tuple[Row, dict[str, Any]]]:
    """Yield the rows in order, those that are not `found` after running them; where some fail, SystemExit after the last."""
    missing: dict[str, str] = {}
    for row in rows:
        if row.name in found:
            yield row, found[row.name]
        elif lost := [need for need in row.needs if need in missing]:
            missing[row.name] = f"it needs {lost[0]}, which is missing"
        else:
            try:
                result = outcome(row, run, wanted[row.name])
            except (*USER_ERRORS, jax.errors.JaxRuntimeError) as error:  # it diverges, or takes more memory than there is
                missing[row.name] = str(error)
                print(f"{row.name}: {error}", file=sys.stderr, flush=True)
                continue
            yield row, result
    if missing:
        told = "\n".join(f"  {name}: {reason.partition(chr(10))[0]}" for name, reason in missing.items())
        raise SystemExit(f"{len(missing)} of {len(rows)} rows are missing; the same command runs them again, the others are kept\n{told}")


def _fanned(launch, path, rows, found, run, wanted, before) -> Iterator[tuple[Row, dict[str, Any]]]:
    """Yield the rows that are `found`, then the others as workers finish them."""
    yield from ((row, found[row.name]) for row in rows if row.name in found)
    left, folder = {row.name: row for row in rows if row.name not in found}, path.with_suffix(".parts")
    shared = [one for one in before if left.keys() & set(one.rows)]
    tasks = [cluster.Task(one.name, one.call) for one in shared]
    for name, row in left.items():
        needs = (*row.needs, *(one.name for one in shared if name in one.rows))
        call = functools.partial(outcome, row, run, wanted[name])
        tasks.append(cluster.Task(name, call, folder / f"{name}.json", wanted[name], needs))
    for name, result in cluster.run(launch, tasks, folder):
        if name in left:
            yield left[name], result
            (folder / f"{name}.json").unlink(missing_ok=True)  # the file holds it now; another command may have been first
    cluster.sweep(folder)


# Runs and scores


def shipped_config(flags: Mapping[str, Any]):
    """Give the config that ships for the task that `flags` name."""
    return options.load(f"configs/{options.check_choice('--task', flags['task'], tasks.names())}.py")


def check_task(config, task: str) -> None:
    """Raise OptionsError where `--task`, of which the results are, is not the config's."""
    if config.task.name != task:
        raise options.OptionsError(f"--task={task}, but the config is of {config.task.name!r}: give --task={config.task.name}")


def train_seconds(workdir: pathlib.Path) -> float:
    """Sum up the time that a run's training steps took, as its curve says: compiling is in it, each time it was started, validation not."""
    rows = [row for row in writers.read_metrics(workdir / "metrics.jsonl") if "seconds_per_step" in row]
    if all("seconds" in row for row in rows):
        return sum(row["seconds"] for row in rows)
    taken = {row["step"]: row["seconds_per_step"] for row in rows}  # of an older run: it is not told how many steps a mean is of
    return sum((step - before) * taken[step] for before, step in itertools.pairwise([0, *sorted(taken)]))


def train_and_score(config, directory: pathlib.Path) -> dict[str, Any]:
    """Train a run, or go on with it, and score it: the row's fields."""
    summary = train.train_and_evaluate(config, str(directory))
    return {**row_of(summary), "train_seconds": train_seconds(directory)}


def load_weights(path: str, config) -> tuple[Any, dict[str, Any]]:
    """Load the averaged parameters of a checkpoint, and say what identifies them."""
    params = scoring.check_checkpoint(path, config, build.build_policy(config))
    return params, pretrained.fingerprint(path, params)


def check_run(path: str, config) -> None:
    """Raise CheckpointError where a checkpoint is not of the run that `config` makes."""
    there, here = (build.run_settings(one) for one in (pretrained.describe(path)["config"], writers.plain(options.to_dict(config))))
    if changed := options.differences(there, here):
        raise checkpoint.CheckpointError(f"{path} is of a run with another {', '.join(changed)}")


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
        down, up = rollout.reach([value - reference[seed] for seed, value in scores.items()], lowest=-100.0)
    else:
        (down, up), (other_down, other_up) = (rollout.reach(list(one.values())) for one in (scores, reference))
        down, up = math.hypot(down, other_up), math.hypot(up, other_down)  # Newcombe (1998), method 10
    mean = float(np.mean(list(scores.values())) - np.mean(list(reference.values())))
    return {"mean": mean, "interval95": [mean - down, mean + up], "paired": paired}


# Tables


def cells(row: Mapping[str, Any], against: str = "") -> list[str]:
    """Write a row's label, score and complete rate, and where `against` names it the field that compares it with the first row."""
    found = [row["label"], rollout.with_interval(row["score"], row["interval95"]), f"{row['complete_percent']:.0f}%"]
    if against:
        found.append(rollout.with_interval(row[against]["mean"], row[against]["interval95"], signed=True) if against in row else "")
    return found


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Write a Markdown table."""
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, ["---"] * len(header), *lines))
