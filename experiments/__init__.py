"""Series of runs, some behind the README's tables, from a checkout: `python -m experiments.robustness` and so on. Not in the wheel."""
