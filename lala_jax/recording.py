"""Record the oracle's demonstrations, a shard at a time, going on where an earlier run stopped."""

from __future__ import annotations

import collections
import functools
import math
import pathlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rich import progress

from lala_jax import build, cluster, dataset, rollout, types
from lala_jax.sim.tasks import base

SHARD = 10  # demonstrations written at a time
PATIENCE = 8.0  # further actions granted for each spoiled one that is expected
MIN_SCORE = 99.0  # a demonstration below is not kept
HOPE = 30  # scenes, of which the oracle must solve one


def collect(config: Mapping[str, Any], *, quiet: bool = False, launch: cluster.Launcher | None = None) -> pathlib.Path:
    """Complete the dataset of the config to `data.demos` demonstrations of train seeds and give its directory.

    Goes on where an earlier run stopped, and waits for another that is at it; a directory that has enough is left alone. With `launch`
    workers record the shards, and the files are the same. Raises `dataset.DatasetError` where the directory holds another task and
    where the oracle solves none of the first `HOPE` scenes, `options.OptionsError` where `data` asks for what cannot be or the train split
    runs out of seeds.
    """
    build.check_data(config)
    directory, identity = pathlib.Path(config["data"]["directory"]), build.data_identity(config)
    done = dataset.seeds(directory)
    if done.size:
        dataset.load(directory, count=1, **identity)  # refuses another task before anything is written
    if len(done) < config["data"]["demos"]:
        with cluster.exclusive(directory):
            _complete(config, directory, identity, quiet=quiet, launch=launch)
    return directory


def _complete(config, directory: pathlib.Path, identity: Mapping[str, Any], *, quiet: bool, launch: cluster.Launcher | None) -> None:
    """Record what the directory lacks."""
    done, wanted = dataset.seeds(directory), config["data"]["demos"]
    kept, place = len(done), (int(done.max()) // 2 + 1 if done.size else 0)
    plan(place, wanted - kept)  # raises now, not after hours, where there are not so many seeds
    if 0 < kept < wanted and not quiet:
        print(f"{directory} holds {kept} demonstrations: recording {wanted - kept} more in simulation", flush=True)
    columns = (*progress.Progress.get_default_columns(), progress.MofNCompleteColumn())
    with progress.Progress(*columns, disable=quiet or launch is not None) as bar:
        shown = bar.add_task(f"demonstrations of {identity['task']}", total=wanted, completed=kept)
        while kept < wanted:
            shards = plan(place, wanted - kept if launch is not None else min(SHARD, wanted - kept))
            for seeds, demos in _record(config, shards, launch):
                if len(seeds) != min(SHARD, wanted - kept):
                    break  # fewer were kept than planned, so that this shard would be larger
                place += len(seeds)
                if demos:
                    dataset.append(directory, demos, **identity)
                kept += len(demos)
                bar.update(shown, completed=kept)
                if not kept and place >= HOPE:
                    raise dataset.DatasetError(_why(config, build.split_seeds("train", 0, SHARD)))
    if launch is not None:
        shutil.rmtree(_parts(directory), ignore_errors=True)


def _why(config, seeds: list[int]) -> str:
    """Say how the oracle fails on scenes of which it solves none."""
    task = build.task(config)
    text = f"the oracle solves none of the first {HOPE} scenes of task {task.name}"
    episodes = _attempt(task, seeds, threads=config["data"]["threads"], mistakes=build.mistakes(config))
    try:
        if not episodes:
            task.sample(seeds[0])  # says where there is no room
    except base.NoFreePose as error:
        return f"{text}: {error}"
    result = rollout.summary(episodes)
    counts = {name: count for field in ("actions_by_cause", "failures_by_reason") for name, count in result[field].items() if count}
    told = ", ".join(f"{name} {count}" for name, count in counts.items())
    return f"{text}: in {result['episodes']} of them it scores {result['score']:.0f}; its {result['actions']} actions were {told}"


def plan(place: int, count: int) -> list[list[int]]:
    """List the seeds of the shards for `count` more demonstrations from a place in the train split on, if all are kept."""
    return [build.split_seeds("train", place + done, min(SHARD, count - done)) for done in range(0, count, SHARD)]


def _record(config, shards, launch: cluster.Launcher | None) -> Iterator[tuple[list[int], list[types.Demo]]]:
    """Yield the shards' seeds and demonstrations in order."""
    if launch is None:
        yield from ((seeds, _demonstrations(config, seeds)) for seeds in shards)
        return
    folder, tasks, places, waiting = _parts(pathlib.Path(config["data"]["directory"])), [], {}, collections.deque(shards)
    key = build.data_identity(config)
    for group in np.array_split(np.arange(len(shards)), min(launch.workers, len(shards))):
        own = [shards[index] for index in group]
        name = f"{own[0][0]}-{own[-1][-1]}"
        call = functools.partial(record_shards, config, own, folder / name)
        tasks.append(cluster.Task(f"seeds {name}", call, folder / f"{name}.json", {**key, "shards": own}))
        places |= {seeds[0]: folder / name / str(seeds[0]) for seeds in own}
    counts: dict[int, int] = {}
    for _, found in cluster.run(launch, tasks, folder):
        counts |= {int(first): count for first, count in found.items()}
        while waiting and waiting[0][0] in counts:
            seeds = waiting.popleft()
            yield seeds, dataset.load(places[seeds[0]])[0] if counts[seeds[0]] else []


def record_shards(config: Mapping[str, Any], shards: Sequence[list[int]], folder: pathlib.Path) -> dict[int, int]:
    """Record shards in a worker, each as a dataset `<folder>/<first seed>`: the number of demonstrations in each, by first seed."""
    counts = {}
    for seeds in shards:
        shutil.rmtree(folder / str(seeds[0]), ignore_errors=True)  # of a worker that was killed
        demos = _demonstrations(config, seeds)
        if demos:
            dataset.save(folder / str(seeds[0]), demos, task=config["task"]["name"], task_options=build.task_options(config))
        counts[seeds[0]] = len(demos)
    return counts


def _parts(directory: pathlib.Path) -> pathlib.Path:
    return directory.with_name(directory.name + ".parts")


def _demonstrations(config: Mapping[str, Any], seeds: list[int]) -> list[types.Demo]:
    return demonstrate(build.task(config), seeds, threads=config["data"]["threads"], mistakes=build.mistakes(config))


def demonstrate(task: base.Task, seeds: list[int], *, threads: int, mistakes: float = 0.0) -> list:
    """Let the oracle solve the scenes of `seeds`, a share `mistakes` of its actions spoiled; give the demonstrations that reached the goal.

    Seeds whose scene has no free pose are passed over.
    """
    episodes = _attempt(task, seeds, threads=threads, mistakes=mistakes)
    return [episode.demo() for episode in episodes if episode.score > MIN_SCORE and np.isfinite(episode.poses).all()]


def _attempt(task: base.Task, seeds: list[int], *, threads: int, mistakes: float) -> list[rollout.Episode]:
    """Give the oracle's episodes in the scenes of `seeds` that have room for all objects."""
    usable, scenes = task.roomy_lists(seeds)
    if not usable:
        return []
    agent = rollout.erring_agent(task, scenes, usable, share=mistakes)
    budget = math.ceil(task.budget * (1.0 + PATIENCE * mistakes))
    return rollout.run(task, scenes, usable, agent, threads=threads, max_actions=budget)
