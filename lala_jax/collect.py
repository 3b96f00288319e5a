"""Record the oracle's demonstrations: `python -m lala_jax.collect --config=configs/tower.py --config.data.demos=500`.

With `--launcher=slurm` or `local` workers record the shards (see `cluster`), and the files are the same.
"""

from __future__ import annotations

from lala_jax import build, cluster, options, recording


def main(config, workdir, *, launcher: str, launcher_options: str) -> None:
    """Collect and say where."""
    del workdir
    print(f"demonstrations are in {recording.collect(config, launch=cluster.launcher(launcher, launcher_options))}")


if __name__ == "__main__":
    options.run(main, flags=cluster.FLAGS, workdir=build.WORKDIR, user_errors=build.USER_ERRORS)
