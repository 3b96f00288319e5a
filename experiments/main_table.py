"""The main results: `python -m experiments.main_table --task=tower --demos=500,50,10 --seeds=0,1,2`.

Trains `configs/<task>.py` as it ships, the first number of demonstrations with every seed, the others with the first seed, and scores each
run on the test split. Fewer demonstrations are the first ones recorded. Writes `main.json` (see `common`; `means` holds the mean over
the seeds of each number of demonstrations) to `--out`, experiments/results/<task> unless told, and prints a table. Runs lie in
`--workdir`, each in <workdir>-<demos>-<seed>. Started again, it goes on with the runs that are missing, and within a run where its
training stopped. With `--launcher=slurm` or `local` each run is a worker's (see `lala_jax.cluster`), after one recorded the demonstrations.
"""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from experiments import common
from lala_jax import build, cluster, compiling, options

FLAGS = {"task": "tower", "demos": "500,50,10", "seeds": "0,1,2", "split": "test", "start": 0, "episodes": 100, "out": "", **cluster.FLAGS}
FIELDS = {"data.demos": "--demos", "seed": "--seeds"} | {f"eval.{name}": f"--{name}" for name in ("split", "start", "episodes")}


def main(
    config, workdir, *, task: str, demos: str, seeds: str, split: str, start: int, episodes: int, out: str,
    launcher: str, launcher_options: str,
) -> list[dict[str, Any]]:  # fmt: skip
    """Train a task's config for each number of demonstrations and seed, and score on the test split."""
    common.check_task(config, task)
    launch = cluster.launcher(launcher, launcher_options)
    base = options.override(config, [f"eval.split={split}", f"eval.start={start}", f"eval.episodes={episodes}"])
    scored = build.split_seeds(split, start, episodes)
    rows = plan(numbers("--demos", demos), numbers("--seeds", seeds))

    def finish(done: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> dict[str, Any]:
        del done
        return {"task": task, "split": split, "means": means(kept)}

    path = pathlib.Path(out or f"experiments/results/{task}") / "main.json"
    common.check_held(path, {"task": task, "split": split})
    work, before = functools.partial(run, base=base, runs=build.workdir(config, workdir)), common.recordings(rows, base)
    done = common.fill(path, rows, work, finish, config=base, seeds=scored, launch=launch, before=before)
    print(f"\n{table(done)}\n\n{path}")
    return done


def numbers(name: str, text: str) -> list[int]:
    """Read a flag of comma-separated whole numbers."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise options.OptionsError(f"{name} must be whole numbers like 500,50,10, got {text!r}") from None


def plan(demos: Sequence[int], seeds: Sequence[int]) -> list[common.Row]:
    """List the runs: the first number of demonstrations with every seed, the others with the first."""
    pairs = [(count, seed) for count in demos for seed in (seeds if count == demos[0] else seeds[:1])]
    return [common.Row(f"{n}-{seed}", f"{n} demonstrations, seed {seed}", (f"data.demos={n}", f"seed={seed}")) for n, seed in pairs]


def run(row: common.Row, *, base, runs: str) -> dict[str, Any]:
    """Train one run and score it."""
    config = row.configs(base)[0]
    fields = common.train_and_score(config, pathlib.Path(f"{runs}-{row.folder}"))
    return {**fields, "demos": config.data.demos, "train_seed": config.seed}


def means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give the mean over the seeds, the extremes and the standard deviation (null for one seed) for each number of demonstrations."""
    found = []
    for demos in dict.fromkeys(row["demos"] for row in rows):
        own = [row for row in rows if row["demos"] == demos]
        scores = [row["score"] for row in own]
        found.append(
            {
                "demos": demos,
                "train_seeds": [row["train_seed"] for row in own],
                "score": float(np.mean(scores)),
                "lowest": min(scores),
                "highest": max(scores),
                "deviation": float(np.std(scores, ddof=1)) if len(scores) > 1 else None,
                "complete_percent": float(np.mean([row["complete_percent"] for row in own])),
                "train_seconds": float(np.mean([row["train_seconds"] for row in own])),
            }
        )
    return found


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Write the runs, and the means where there are several seeds, as a Markdown table."""
    lines = [[*common.cells(row), f"{row['train_seconds']:.0f}"] for row in rows]
    for mean in means(rows):
        if mean["deviation"] is not None:
            label = f"{mean['demos']} demonstrations, mean of {len(mean['train_seeds'])} seeds"
            spread = f"{mean['score']:.1f} (deviation {mean['deviation']:.1f})"
            lines.append([label, spread, f"{mean['complete_percent']:.0f}%", f"{mean['train_seconds']:.0f}"])
    return common.table(["", "score", "complete", "training, s"], lines)


def command(argv: Sequence[str] | None = None):
    """Run from the command line."""
    return options.run(
        main, flags=FLAGS, config_from=common.shipped_config, workdir=build.WORKDIR, owned=lambda _: FIELDS,
        user_errors=common.USER_ERRORS, argv=argv,
    )  # fmt: skip


if __name__ == "__main__":
    from experiments import main_table as module  # the name under which workers find what they are sent

    compiling.keep()
    module.command()
