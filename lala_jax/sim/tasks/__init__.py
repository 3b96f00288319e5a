"""The tasks: one file each, registered here."""

from __future__ import annotations

import dataclasses

from lala_jax.sim.tasks import base, pallet, tower

_TASKS: dict[str, type[base.Task]] = {"tower": tower.TowerTask, "pallet": pallet.PalletTask}


def names() -> tuple[str, ...]:
    """Name the tasks that `get` knows."""
    return tuple(sorted(_TASKS))


def get(name: str, **options) -> base.Task:
    """Build the task called `name`; `options` are its fields. Raises ValueError naming the valid names or fields."""
    if name not in _TASKS:
        raise ValueError(f"unknown task {name!r}, choose one of {', '.join(names())}")
    fields = sorted(field.name for field in dataclasses.fields(_TASKS[name]))
    unknown = sorted(set(options) - set(fields))
    if unknown:
        raise ValueError(f"task {name} has no option {', '.join(unknown)}; its options are {', '.join(fields)}")
    return _TASKS[name](**options)
