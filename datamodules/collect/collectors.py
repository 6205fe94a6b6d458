"""Which collector makes the data of which family of tasks."""

from __future__ import annotations

import importlib
import inspect
import json
import shlex
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

COLLECTORS = {
    ("pointmaze", ""): ("datamodules.collect.pointmaze", "collect_pointmaze", None),
    ("antmaze", "d4rl"): ("datamodules.collect.antmaze", "collect_antmaze", "AntMazeRecipe"),
    ("locomotion", "v4"): ("datamodules.collect.locomotion", "collect_locomotion", "LocomotionRecipe"),
    ("kitchen", ""): ("datamodules.collect.kitchen", "collect_kitchen", "KitchenRecipe"),
}
"""Family and physics -> module, function `(task, steps, seed, out, workers, *, dataset_id, overwrite)`, and the class
of its `recipe`; None where what a recipe would hold are the function's own keywords."""


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
        recipe: What the behaviour shall do otherwise than by default, for example `{"action_noise": 0.1}`.
        dataset_id: Name of the set; None takes the task's own.
        overwrite: Replace a set of the same name.

    Returns:
        The data set's folder, for `local:`.

    Raises:
        UserError: There is no collector for the task's family, or the collector refuses its arguments.
    """
    task = get_task(task) if isinstance(task, str) else task
    refuse_uncollectable(task)
    collector, recipe_class, known = _collector(task)
    for name, value in (recipe or {}).items():
        if name not in known:
            raise UserError(f"recipe.{name}: '{task.name}' has no such setting; it has {', '.join(known)}")
        if not isinstance(value, bool | int | float):
            raise UserError(f"recipe.{name}: found {value!r}, expected a number, true or false")
    options = dict(recipe or {})
    if recipe and recipe_class:
        options = {"recipe": recipe_class(**recipe)}
    return collector(task, steps, seed, out, workers, **options, dataset_id=dataset_id, overwrite=overwrite)


def _collector(task: Task) -> tuple[Callable[..., Path], Any, dict[str, Any]]:
    """A task's collector, the class of its recipe or None, and the settings of its behaviour with their defaults."""
    module_name, name, recipe_name = COLLECTORS[task.family, task.physics]
    module = importlib.import_module(module_name)
    collector, recipe_class = getattr(module, name), getattr(module, recipe_name) if recipe_name else None
    if recipe_class:
        return collector, recipe_class, {field.name: field.default for field in fields(recipe_class)}
    about_the_set = ("dataset_id", "overwrite", "progress")
    keywords = [p for p in inspect.signature(collector).parameters.values() if p.kind is p.KEYWORD_ONLY]
    return collector, None, {p.name: p.default for p in keywords if p.name not in about_the_set}


def collection_command(folder: str | Path) -> str | None:
    """The command that makes a collected data set again, as its metadata tell; None for a set made otherwise.

    Args:
        folder: Of the data set, as in `local:FOLDER`.
    """
    try:
        told = json.loads((Path(folder) / "data" / "metadata.json").read_text(encoding="utf-8"))["collection"]
        task, steps, seed = get_task(told["task"]), int(told["steps"]), int(told["seed"])
        _, _, settings = _collector(task)
    except (OSError, ValueError, KeyError, TypeError, UserError):
        return None
    words = ["dds", "data", "collect", task.name, f"--steps={steps}", f"--seed={seed}"]
    for name, default in settings.items():
        value = told.get(name, default)
        if value != default and isinstance(value, bool | int | float):
            words.append(f"--recipe.{name}={value}")
    return shlex.join(words)
