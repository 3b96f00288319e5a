"""Stack five blocks on a stand to match a goal picture (the paper's stacking-tower), with the default goal-aware agent.

    python -m lala_jax.train --config=configs/tower.py                                   # 500 demonstrations, 2 CPU cores
    python -m lala_jax.train --config=configs/tower.py:smoke --workdir=runs/smoke        # every part, in minutes
    python -m lala_jax.train --config=configs/tower.py:paper --workdir=runs/tower-paper  # the paper's two-stream agent, for a GPU
    python -m lala_jax.train --config=configs/tower.py --config.task.num_objects=3 --config.data.directory=data/tower3 --workdir=runs/tower3

Hardware, time and scores of the runs reported are in the README. The paper: 15.8 with 500 demonstrations (two streams, max-height map).
"""

from lala_jax import defaults


def get_config(arg=""):
    """Give the config; `arg` is "", "smoke" or "paper"."""
    config = defaults.get(arg, task="tower")
    if arg == "":
        config.train.steps = 500
        config.train.eval_every = 250
    return config
