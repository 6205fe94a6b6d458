"""Which collector makes the data of which family of tasks."""

from __future__ import annotations

import importlib
import shlex
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dds_lightning.errors import UserError
from dds_lightning.saving.untrusted import mapping, read_json
from dds_lightning.tasks import Task, get_task, known_task

if TYPE_CHECKING:
    from datamodules.collect.collecting import Collector

COLLECTORS = {
    ("pointmaze", ""): "datamodules.collect.pointmaze",
    ("antmaze", "d4rl"): "datamodules.collect.antmaze",
    ("antmaze", "robotics"): "datamodules.collect.antmaze",
    ("locomotion", "v4"): "datamodules.collect.locomotion",
    ("kitchen", ""): "datamodules.collect.kitchen",
}
"""Family and physics -> the file whose `COLLECTOR` makes the data, imported when it is used. A new collector is one
file and one entry."""


def can_collect(task: Task) -> bool:
    """Whether there is a collector for the task's family and physics."""
    return (task.family, task.physics) in COLLECTORS


def collector_of(task: Task) -> Collector | None:
    """The collector for a task's family and physics; None where there is none."""
    module = COLLECTORS.get((task.family, task.physics))
    return importlib.import_module(module).COLLECTOR if module else None


def refuse_uncollectable(task: Task) -> None:
    """Say where data come from for a task that cannot be collected.

    Raises:
        UserError: When there is no collector for the task's family and physics.
    """
    if not can_collect(task):
        known = ", ".join(f"{family}-...{f'@{physics}' if physics else ''}" for family, physics in COLLECTORS)
        fetch = f", or get D4RL's own with `dds data fetch {task.base_name}`" if "d4rl" in task.data_ids else ""
        raise UserError(
            f"data: nothing collects data for task '{task.name}' yet, only for {known}: give --data arrays:DIR, "
            f"d4rl:FILE or minari:ID{fetch}"
        )


def collect(
    task: Task | str,
    steps: int,
    seed: int = 0,
    out: str | Path = "data",
    workers: int | None = None,
    *,
    recipe: Mapping[str, Any] | None = None,
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
        recipe: Settings of the behaviour that differ from the defaults, for example `{"action_noise": 0.1}`.
        dataset_id: Name of the set; None takes the task's own.
        overwrite: Replace a set of the same name.

    Returns:
        The data set's folder, for `local:`.

    Raises:
        UserError: When there is no collector for the task's family, or the collector refuses its arguments.
    """
    task = get_task(task)
    refuse_uncollectable(task)
    task = known_task(task.name.partition("?")[0])  # data are made for every start and goal alike
    collector, settings = collector_of(task), dict(recipe or {})
    assert collector is not None
    known = [one.name for one in fields(collector.recipe)]
    for name, value in settings.items():
        if name not in known:
            raise UserError(f"recipe.{name}: '{task.name}' has no such setting; it has {', '.join(known)}")
        if not isinstance(value, bool | int | float):
            raise UserError(f"recipe.{name}: got {value!r}, expected a number, true or false")
    return collector.collect(task, steps, seed, out, workers, dataset_id=dataset_id, overwrite=overwrite, **settings)


def collection_command(folder: str | Path) -> str | None:
    """The command that makes a collected data set again, from its metadata; None for a set made otherwise.

    Args:
        folder: Of the data set, as in `local:FOLDER`.
    """
    try:
        made = mapping(read_json(Path(folder) / "data" / "metadata.json"), folder)["collection"]
        task, steps, seed = known_task(str(made["task"])), int(made["steps"]), int(made["seed"])
    except (ValueError, KeyError, TypeError, OverflowError):
        return None
    collector = collector_of(task)
    if collector is None:
        return None
    arguments = ["dds", "data", "collect", task.name, f"--steps={steps}", f"--seed={seed}"]
    for setting in fields(collector.recipe):
        value = made.get(setting.name, setting.default)
        if value != setting.default and isinstance(value, bool | int | float):
            arguments.append(f"--recipe.{setting.name}={value}")
    return shlex.join(arguments)


def behaviour_actor(task: Task) -> Any:
    """The behaviour that makes a task's data, as an `Actor` with the noise that it has there; None if there is none."""
    collector = collector_of(task)
    return collector.controller(task, collector.recipe()) if collector else None
