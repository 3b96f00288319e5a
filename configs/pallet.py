"""Palletize eight boxes to match a goal picture (the paper's palletizing-boxes), with the default goal-aware agent.

    python -m lala_jax.train --config=configs/pallet.py                                    # 500 demonstrations, 2 CPU cores
    python -m lala_jax.train --config=configs/pallet.py:smoke --workdir=runs/smoke         # every part, in minutes
    python -m lala_jax.train --config=configs/pallet.py:paper --workdir=runs/pallet-paper  # the paper's two-stream agent, for a GPU
    python -m lala_jax.train --config=configs/pallet.py --config.train.steps=9000 --config.data.demos=50 --workdir=runs/pallet-50

Hardware, time and scores of the runs reported are in the README. The paper: 6.3 with 500 demonstrations (two streams, max-height map).
"""

from lala_jax import defaults


def get_config(arg=""):
    """Give the config; `arg` is "", "smoke" or "paper"."""
    config = defaults.get(arg, task="pallet")
    if arg == "":
        config.train.steps = 1000
        config.train.eval_every = 500
    return config
