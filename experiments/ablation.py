"""What each part is worth: `python -m experiments.ablation --task=pallet --steps=250 --demos=500 --episodes=100 --seed=0`.

Each row of `ROWS` trains `configs/<task>.py` with one lever moved, all with the same budget, and is scored on val episodes. Writes
`ablation-<task>.json` (see `common`; each row's `difference` is its score less the first row's, `train_seconds` as the training curve
says) to `--out`, and prints a table. Runs lie in `--workdir`, runs/ablation/<task> unless told. Started again, it goes on with the
rows that are missing, and within a row where its training stopped; `--rows=refine,recolor` runs only these and the first. With
`--launcher=slurm` or `local` each row is a worker's (see `lala_jax.cluster`), after one recorded the demonstrations that rows share.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Sequence
from typing import Any

from experiments import common
from lala_jax import build, cluster, compiling, options


@dataclasses.dataclass(frozen=True)
class Lever(common.Row):
    """A row that trains its own weights, or takes the first row's."""

    trains: bool = True

    def beside(self, config) -> dict[str, Any]:
        """Give the revision of the first row, where its weights are taken, once there is one."""
        del config
        return {"first": ROWS[0].revision} if not self.trains and ROWS[0].revision else {}


PERFECT = ("augment.depth_noise=0.0", "augment.shift=0.0", "augment.turn=0.0", "augment.missing=0.0")
RECOVERIES = ("data.mistakes=0.15", "data.directory={config.data.directory}-mistakes")
ROWS = (
    Lever("default", "default"),
    Lever("default-again", "default, trained once more"),  # as far as the order of sums lets it differ: on one thread or two
    Lever("max-height", "max-height map instead of slices", ("model.max_height=true",)),
    Lever("one-hot", "one-hot labels", ("model.multi_action=false",), revision=2),
    Lever("matching", "no matching between the maps", ("model.matching=false",)),
    Lever("recolor", "no recolouring", ("augment.recolor=false",)),
    Lever("rigid", "no rigid motion", ("augment.rigid=false",)),
    Lever("refine", "no refinement", ("model.refine=false",)),
    Lever("sensors", "no camera errors in training", PERFECT),
    Lever("recoveries", "demonstrations with recoveries", RECOVERIES),
    Lever("average-turns", "test-time averaging over half a turn", ("model.average_turns=true",), needs=("default",), trains=False),
    Lever("slices", "28 slices of 1 cm", ("map.slices=28",)),
    Lever("average-decay", "no averaging of weights", ("optim.average_decay=0.0",)),
)
FLAGS = {
    "task": "pallet",
    "steps": 250,
    "demos": 500,
    "start": 100,
    "episodes": 100,
    "seed": 0,
    "rows": "",
    "out": "experiments/results/ablation",
    **cluster.FLAGS,
}
ITSELF = "the experiment, alike for all rows"
FIELDS = {"train.steps": "--steps", "data.demos": "--demos", "seed": "--seed", "eval.start": "--start", "eval.episodes": "--episodes"}
FIELDS |= dict.fromkeys(("eval.split", *common.CHOOSES), ITSELF)


def main(
    config, workdir, *, task: str, steps: int, demos: int, start: int, episodes: int, seed: int, rows: str, out: str,
    launcher: str, launcher_options: str,
) -> list[dict[str, Any]]:  # fmt: skip
    """Train and score a task's config with the levers of `ROWS`."""
    common.check_task(config, task)
    launch = cluster.launcher(launcher, launcher_options)
    base = budget(config, steps=steps, demos=demos, start=start, episodes=episodes, seed=seed)
    seeds, runs = build.split_seeds("val", start, episodes), pathlib.Path(build.workdir(config, workdir))
    chosen, spent = common.choose(ROWS, rows, task), {"steps": steps, "demos": demos, "seed": seed}

    def finish(done: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> dict[str, Any]:
        del kept
        for row in done[1:] if done[0]["name"] == chosen[0].name else ():
            row["difference"] = common.difference(row["scores"], done[0]["scores"], paired=True)
        return {"task": task, "split": "val", **spent, "reference": chosen[0].name}

    path = pathlib.Path(out) / f"ablation-{task}.json"
    common.check_held(path, spent)
    work, before = functools.partial(run, base=base, runs=runs, seeds=seeds), common.recordings([row for row in chosen if row.trains], base)
    done = common.fill(path, chosen, work, finish, config=base, seeds=seeds, launch=launch, before=before)
    print(f"\n{table(done)}\n\n{path}")
    return done


def budget(config, *, steps: int, demos: int, start: int, episodes: int, seed: int):
    """Give every row's config before its lever is moved: the last step is the one that is scored."""
    fields = {"train.steps": steps, "train.eval_every": steps, "train.eval_episodes": 1, "data.demos": demos, "seed": seed}
    fields |= {"eval.split": "val", "eval.start": start, "eval.episodes": episodes}
    return options.override(config, [f"{name}={value}" for name, value in fields.items()])


def run(row: Lever, *, base, runs: pathlib.Path, seeds: Sequence[int]) -> dict[str, Any]:
    """Train where the row has weights of its own, and score."""
    config = row.configs(base)[0]
    if row.trains:
        return common.train_and_score(config, runs / row.folder)
    first = str(runs / ROWS[0].folder / "checkpoints")
    common.check_run(first, ROWS[0].configs(base)[0])
    params, weights = common.load_weights(first, config)
    return {**common.row_of(common.score(config, params, seeds)), "train_seconds": 0.0, "weights": weights}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Write the rows as a Markdown table."""
    lines = [[*common.cells(row, "difference"), f"{row['train_seconds']:.0f}" if row["train_seconds"] else ""] for row in rows]
    return common.table(["", "score", "complete", "difference", "training, s"], lines)


def command(argv: Sequence[str] | None = None):
    """Run from the command line."""
    return options.run(
        main, flags=FLAGS, config_from=common.shipped_config, workdir="runs/ablation/<task>", owned=lambda _: FIELDS,
        user_errors=common.USER_ERRORS, argv=argv,
    )  # fmt: skip


if __name__ == "__main__":
    from experiments import ablation as module  # the name under which workers find what they are sent

    compiling.keep()
    module.command()
