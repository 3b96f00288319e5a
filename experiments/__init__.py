"""The experiments behind the README's tables, run from a checkout: `python -m experiments.robustness` and so on. Not in the wheel."""
