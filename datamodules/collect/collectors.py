"""Which collector makes the data of which family of tasks."""

from __future__ import annotations

import importlib
from pathlib import Path

from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

COLLECTORS = {
    ("pointmaze", ""): ("datamodules.collect.pointmaze", "collect_pointmaze"),
    ("antmaze", "d4rl"): ("datamodules.collect.antmaze", "collect_antmaze"),
    ("locomotion", "v4"): ("datamodules.collect.locomotion", "collect_locomotion"),
    ("kitchen", ""): ("datamodules.collect.kitchen", "collect_kitchen"),
}
"""Family and physics -> module and name of a function `(task, steps, seed, out, workers, *, dataset_id, overwrite)`."""


def can_collect(task: Task) -> bool:
    """Whether there is a collector for the task's family and physics."""
    return (task.family, task.physics) in COLLECTORS


def refuse_uncollectable(task: Task) -> None:
    """Say where data come from for a task that cannot be collected.

    Raises:
        UserError: There is no collector for the task's family and physics.
    """
    if not can_collect(task):
        known = ", ".join(f"{family}-...{f'@{physics}' if physics else ''}" for family, physics in COLLECTORS)
        raise UserError(
            f"data: nothing collects data for task '{task.name}' yet, only for {known}: give --data "
            f"d4rl:FILE or --data minari:ID, or get D4RL's own with `dds data fetch {task.base_name}`"
        )


def collect(
    task: Task | str,
    steps: int,
    seed: int = 0,
    out: str | Path = "data",
    workers: int | None = None,
    *,
    dataset_id: str | None = None,
    overwrite: bool = False,
) -> Path:
    """Make a data set with the collector of the task's family.

    Args:
        task: A task or its name.
        steps: Environment steps.
        seed: The same seed gives the same bytes of every array.
        out: Folder of data sets.
        workers: Processes; None takes every core.
        dataset_id: Name of the set; None takes the task's own.
        overwrite: Replace a set of the same name.

    Returns:
        The data set's folder, for `local:`.

    Raises:
        UserError: There is no collector for the task's family, or the collector refuses its arguments.
    """
    task = get_task(task) if isinstance(task, str) else task
    refuse_uncollectable(task)
    module, name = COLLECTORS[task.family, task.physics]
    collector = getattr(importlib.import_module(module), name)
    return collector(task, steps, seed, out, workers, dataset_id=dataset_id, overwrite=overwrite)
