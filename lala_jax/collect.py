"""Record the oracle's demonstrations: `python -m lala_jax.collect --config=configs/tower.py --config.data.demos=500`."""

from __future__ import annotations

from lala_jax import build, options, recording


def main(config, workdir) -> None:
    """Collect and say where."""
    del workdir
    print(f"demonstrations are in {recording.collect(config)}")


if __name__ == "__main__":
    options.run(main, workdir=build.WORKDIR, user_errors=build.USER_ERRORS)
