"""Draw both tasks, start and goal, for the README: `python -m lala_jax.report --out=DIR`."""

from __future__ import annotations

import argparse
import pathlib

import jax
import numpy as np

from lala_jax import pictures, types, writers
from lala_jax.perception import topdown
from lala_jax.sim import render, scene, tasks


def draw_task(name: str, seed: int, *, height: int = 480, width: int = 640) -> np.ndarray:
    """Render start and goal of one seed of the task `name` and draw them."""
    task, spec = tasks.get(name), types.MapSpec()
    drawn = task.sample(seed)
    camera = scene.cameras("ring", height=height, width=width)
    template = scene.geom_template(task)

    @jax.jit
    def see(poses):
        placed = scene.place(*template, size=drawn.size, color=drawn.color, poses=poses, base=drawn.base)
        views = render.render(*placed, camera)
        return views, topdown.from_views(views, spec=spec)

    (start, start_map), (goal, goal_map) = see(drawn.start), see(drawn.goal)
    return pictures.task_picture(start, goal, start_map, goal_map, f"{name}, seed {seed}")


def main(argv=None) -> None:
    """Draw both tasks into files for the README."""
    parser = argparse.ArgumentParser(prog="python -m lala_jax.report", description=main.__doc__)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="directory for the pictures")
    parser.add_argument("--seed", type=int, default=1, help="seed of both scenes (test scenes start at 10001)")
    args = parser.parse_args(argv)
    drawn = [draw_task(name, args.seed) for name in tasks.names()]
    writers.write_image(args.out / "tasks.webp", pictures.grid(drawn, len(drawn)))


if __name__ == "__main__":
    main()
