"""One policy in changed worlds: `python -m experiments.robustness --checkpoint=runs/tower/checkpoints --split=test --episodes=100`.

Each row of `ROWS` is scored with the same weights (in one row rounded) on the same seeds and compared with the first. Writes
`robustness-<split>.json` to `--out`, experiments/results/<task> unless told, and prints a table. The file is as `common` says; each
row's `drop` is the first row's score less its own, and `conditions` is what `lala_jax.publish --robustness` reads. Started again, it
goes on with the rows that are missing; `--rows=moved,noise` runs only these and the first. With `--launcher=slurm` or `local` each row is
a worker's (see `lala_jax.cluster`).
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import common
from lala_jax import build, cluster, compiling, evaluate, options, publish, rollout, types
from lala_jax import checkpoint as checkpoints
from lala_jax.sim import oracle, scene


@dataclasses.dataclass(frozen=True)
class World(common.Row):
    """A row: a world, or the trained one and weights that are `stored` in another format."""

    stored: str = "float32"


def missing(count: int) -> World:
    """Give the row in which one of `count` cameras is missing, each in its share of the episodes."""
    told, share = {2: ("two", "half"), 3: ("three", "third"), 4: ("four", "quarter")}.get(count, (f"{count}", f"share of 1/{count}"))
    parts = tuple((f"camera.missing={k}",) for k in range(count))
    return World("missing", f"one camera of {told} missing, each in a {share}", parts=parts)


MOVED = ("camera.shift=0.03", "camera.turn=3.0")
ROWS = (
    World("nominal", "as trained"),
    World("moved", "cameras moved up to 3 cm and 3 degrees, calibrated by themselves", (*MOVED, "camera.calibrate=true")),
    World("moved-uncalibrated", "the same, not calibrated", (*MOVED, "camera.calibrate=false")),
    World("noise", "depth noise like a RealSense D415's", ("camera.depth_noise=true",)),
    World("colors", "colours never seen", ("task.colors=uniform",)),
    missing(4),  # as many as there are: `worlds`
    World("distractors", "two objects that the goal does not show", ("task.distractors=2",)),
    *(World(f"tower-{n}", f"towers of {n}", (f"task.num_objects={n}",), tasks=("tower",)) for n in (3, 4, 6)),
    World("bfloat16", "as trained, weights rounded to bfloat16", stored="bfloat16"),
)
FLAGS = {"checkpoint": "", "split": "test", "start": 0, "episodes": 100, "rows": "", "out": "", **cluster.FLAGS}


def main(
    config, workdir, *, checkpoint: str, split: str, start: int, episodes: int, rows: str, out: str, launcher: str, launcher_options: str
) -> list[dict[str, Any]]:
    """Score a checkpoint in the worlds of `ROWS`."""
    del workdir
    launch, name, seeds = cluster.launcher(launcher, launcher_options), config.task.name, build.split_seeds(split, start, episodes)
    params, weights = common.load_weights(checkpoint, config)
    known = worlds(config)
    chosen = [row for row in common.choose(known, rows, name) if can_be_built(row, config)]
    paired = {row.name: same_scenes(config, row.configs(config)[0], seeds) for row in chosen}

    def finish(done: Sequence[dict[str, Any]], kept: Sequence[dict[str, Any]]) -> dict[str, Any]:
        for row in done[1:] if done[0]["name"] == chosen[0].name else ():
            row["drop"] = common.difference(done[0]["scores"], row["scores"], paired=paired[row["name"]])
        conditions = {row["label"]: {field: row[field] for field in publish.SCORE} for row in kept}
        facts = {"task": name, "split": split, "checkpoint": checkpoint, "weights": weights}
        return {**facts, "reference": chosen[0].name, "conditions": conditions}

    path = pathlib.Path(out or f"experiments/results/{name}") / f"robustness-{split}.json"
    common.check_held(path, {"task": name})
    loaded = params if launch is None else None
    work = functools.partial(run, base=config, checkpoint=checkpoint, weights=weights, seeds=seeds, params=loaded)
    done = common.fill(path, chosen, work, finish, config=config, seeds=seeds, weights=weights, launch=launch, known=known)
    print(f"\n{table(done)}\n\n{path}")
    return done


def worlds(config) -> list[World]:
    """Give `ROWS` for the cameras that the config's preset has."""
    preset = options.check_choice("camera.preset", config.camera.preset, scene.PRESETS)
    return [missing(len(scene.PRESETS[preset][0])) if row.name == "missing" else row for row in ROWS]


def can_be_built(row: World, config) -> bool:
    """Say whether the task can be as a row wants it, and print why where not: a user's need not have all that the shipped ones have."""
    build.task(config)
    try:
        for one in row.configs(config):
            build.task(one)
    except options.OptionsError as error:
        print(f"{row.name} is left out: {error}", flush=True)
        return False
    return True


def run(row: World, *, base, checkpoint: str, weights: Mapping[str, Any], seeds: Sequence[int], params: Any = None) -> dict[str, Any]:
    """Score one row, each part on its share of the seeds.

    Without `params` reads the checkpoint, and raises CheckpointError where it no longer holds the `weights`.
    """
    if params is None:
        params, found = common.load_weights(checkpoint, base)
        if found != weights:
            raise checkpoints.CheckpointError(f"{checkpoint} changed meanwhile: it holds {found}, the other rows scored {weights}")
    params = jax.tree.map(lambda leaf: jnp.asarray(leaf, row.stored).astype(leaf.dtype), params)
    parts = zip(row.configs(base), shares(seeds, len(row.parts)), strict=False)  # fewer seeds than parts: the first parts
    return common.row_of(rollout.merged([common.score(one, params, share) for one, share in parts]))


def shares(seeds: Sequence[int], count: int) -> list[list[int]]:
    """Deal seeds in order to `count` parts as equal as can be."""
    return [part.tolist() for part in np.array_split(np.asarray(seeds), count) if part.size]


def same_scenes(config, other, seeds: Sequence[int]) -> bool:
    """Say whether the wanted objects of two configs' scenes are the same for every seed, and the same scenes are passed over."""
    first, second = build.task(config), build.task(other)
    if first == second:
        return True
    there, here = ({seed: _wanted(drawn) for seed, drawn in task.roomy(seeds)} for task in (first, second))
    return there.keys() == here.keys() and jax.tree.all(jax.tree.map(np.array_equal, there, here))


def _wanted(drawn: types.Scene):
    kept = oracle.wanted(drawn)
    return drawn.base, [leaf[kept] for leaf in (drawn.size, drawn.color, drawn.start, drawn.goal)]


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Write the rows as a Markdown table."""
    lines = [[*common.cells(row, "drop"), rollout.counted(row["first_failures"])] for row in rows]
    return common.table(["world", "score", "complete", "drop", "first to go wrong, episodes"], lines)


def stored_config(flags):
    """Give the config of the checkpoint."""
    if not flags["checkpoint"]:
        raise options.OptionsError("give --checkpoint=PATH")
    return evaluate.stored_config(flags)


def command(argv: Sequence[str] | None = None):
    """Run from the command line."""
    owned = {f"eval.{name}": f"--{name}" for name in ("split", "start", "episodes")}
    return options.run(
        main, flags=FLAGS, config_from=stored_config, workdir=".", owned=lambda _: owned, user_errors=common.USER_ERRORS, argv=argv
    )


if __name__ == "__main__":
    from experiments import robustness as module  # the name under which workers find what they are sent

    compiling.keep()
    module.command()
