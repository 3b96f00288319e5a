"""Record the oracle's demonstrations, a shard at a time, going on where an earlier run stopped."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich import progress

from lala_jax import build, dataset, rollout
from lala_jax.sim.tasks import base

SHARD = 10  # demonstrations written at a time
PATIENCE = 8.0  # further actions granted for each spoiled one that is expected
MIN_SCORE = 99.0  # a demonstration below is not kept


def collect(config: Mapping[str, Any], *, quiet: bool = False) -> pathlib.Path:
    """Complete the dataset of the config to `data.demos` demonstrations of train seeds and give its directory.

    Goes on where an earlier run stopped; a directory that has enough is left alone. Raises `dataset.DatasetError` where the
    directory holds another task, `options.OptionsError` where the train split runs out of seeds.
    """
    task, wanted = build.task(config), config["data"]["demos"]
    directory = pathlib.Path(config["data"]["directory"])
    identity = {"task": task.name, "task_options": build.task_options(config)}
    done = dataset.seeds(directory)
    if done.size:
        dataset.load(directory, count=1, **identity)  # refuses another task before anything is written
    kept, place = len(done), (int(done.max()) // 2 + 1 if done.size else 0)
    if kept >= wanted:
        return directory
    columns = (*progress.Progress.get_default_columns(), progress.MofNCompleteColumn())
    with progress.Progress(*columns, disable=quiet) as bar:
        shown = bar.add_task(f"demonstrations of {task.name}", total=wanted, completed=kept)
        while kept < wanted:
            seeds = build.split_seeds("train", place, min(SHARD, wanted - kept))
            place += len(seeds)
            demos = demonstrate(task, seeds, threads=config["data"]["threads"], mistakes=build.mistakes(config))
            if demos:
                dataset.append(directory, demos, **identity)
            kept += len(demos)
            bar.update(shown, completed=kept)
    return directory


def demonstrate(task: base.Task, seeds: list[int], *, threads: int, mistakes: float = 0.0) -> list:
    """Let the oracle solve the scenes of `seeds`, a share `mistakes` of its actions spoiled; give the demonstrations that reached the goal.

    Seeds whose scene has no free pose are passed over.
    """
    scenes, usable = [], []
    for seed in seeds:
        try:
            scenes.append(task.sample(seed))
        except base.NoFreePose:
            continue
        usable.append(seed)
    if not usable:
        return []
    agent = rollout.erring_agent(task, scenes, usable, share=mistakes)
    budget = math.ceil((task.max_actions or task.default_max_actions()) * (1.0 + PATIENCE * mistakes))
    episodes = rollout.run(task, scenes, usable, agent, threads=threads, max_actions=budget)
    return [episode.demo() for episode in episodes if episode.score > MIN_SCORE and np.isfinite(episode.poses).all()]
