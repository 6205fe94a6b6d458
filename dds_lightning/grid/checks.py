"""What a study file may say: mistakes are found when it is read, before anything runs."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from datamodules.relabelling import Relabelling
from dds_lightning.configs import run_defaults
from dds_lightning.console.refusals import did_you_mean
from dds_lightning.errors import GREATEST_SEED, UserError, refuse_seed
from dds_lightning.grid.cells import BASE, OURS, PLAYERS, Study, argument, label, shown
from dds_lightning.study.paper import LAYOUTS
from dds_lightning.tasks import get_task
from dds_lightning.training.options import options
from dds_lightning.training.stages import STAGES
from dds_lightning.training.typos import refuse_typos

SELECTIONS = ("greedy", "sample", "argmax_q", "random")
SETTINGS: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "data.steps": (lambda value: _is_whole(value) and value >= 1, "a whole number of at least 1"),
    "data.seed": (lambda value: _is_whole(value) and 0 <= value <= GREATEST_SEED, f"0 to {GREATEST_SEED}"),
    "evaluate.episodes": (lambda value: _is_whole(value) and value >= 1, "a whole number of at least 1"),
    "evaluate.selection": (lambda value: value in SELECTIONS, "greedy, sample, argmax_q or random"),
    "evaluate.temperature": (lambda value: _is_number(value) and value > 0, "a number above 0"),
    "evaluate.noise_scale": (lambda value: _is_number(value) and value >= 0, "a number of at least 0"),
    "evaluate.hold": (lambda value: _is_whole(value) and value >= 1, "a whole number of at least 1"),
}
"""Settings of the data and of the evaluation: what they may be, and how a sentence says it."""


def check(study: Study) -> None:
    """Refuse what cannot work.

    Raises:
        UserError: Names the first.
    """
    _check_lists(study)
    _check_tasks(study)
    if study.budget is not None and not (_is_number(study.budget) and study.budget > 0):
        raise UserError(f"budget is {study.budget}, expected core-minutes, more than 0, or no budget")
    if study.watch < 0:
        raise UserError(f"watch is {study.watch}, expected 0 (no evaluation while training) or more")
    if study.paper and study.paper not in LAYOUTS:
        near = did_you_mean(study.paper, LAYOUTS) or f": {', '.join(LAYOUTS)}"
        raise UserError(f"paper is {study.paper}, expected a table or figure of the paper{near}")
    for name, departure in study.variants.items():
        if not isinstance(departure, dict) or not departure or name == BASE:
            raise UserError(
                f"variants: {name} is {departure!r}, expected settings; {BASE} is added without being named"
            )
    trained = {stage for method in study.methods for stage in PLAYERS[method].stages}
    for key, values in _asked(study).items():
        for value in values:
            _check_setting(str(key), value, trained)
        if str(key).startswith("data.") and study.data is not None:
            raise UserError(f"{key} is for data that are collected, and data is {study.data}: leave one of them out")
    _check_names(study)


def _check_lists(study: Study) -> None:
    """Refuse lists that span no grid, or name the same twice."""
    lists = {"tasks": study.tasks, "methods": study.methods, "seeds": study.seeds, **study.grid}
    for name, values in lists.items():
        if not isinstance(values, list | tuple) or not values:
            raise UserError(f"{name} is {values!r}, expected a list with at least one value: the grid would be empty")
        if twice := [value for index, value in enumerate(values) if value in values[:index]]:
            raise UserError(f"{name} lists {twice[0]!r} twice: the same cells would run twice")
    for name, texts in {name: getattr(study, name) for name in ("tasks", "methods", "rows", "columns")}.items():
        for one in texts:
            if not isinstance(one, str):
                raise UserError(f"{name} lists {one!r}, expected names")
    for seed in study.seeds:
        if not _is_whole(seed):
            raise UserError(f"seeds lists {seed!r}, expected whole numbers")
        refuse_seed("seeds", seed)
    for method in study.methods:
        if method not in PLAYERS:
            near = did_you_mean(method, PLAYERS) or f", expected some of {', '.join(PLAYERS)}, or all"
            raise UserError(f"methods: there is no method {method}{near}")


def _check_tasks(study: Study) -> None:
    """Refuse tasks that there are not, or that have no data, and settings of other tasks."""
    for name in study.tasks:
        task = get_task(name)
        if study.data is None:
            from datamodules.collect.collectors import refuse_uncollectable

            refuse_uncollectable(task)
        run_defaults(study.preset or task.family)
    if study.data is not None and len(study.tasks) > 1:
        raise UserError(
            f"data is {study.data} for {len(study.tasks)} tasks, expected one task, or no data: they are collected"
        )
    for name, given in study.task_settings.items():
        if name not in study.tasks:
            near = did_you_mean(str(name), study.tasks) or f", expected some of {', '.join(study.tasks)}"
            raise UserError(f"task_settings: {name} is not a task of this study{near}")
        if not isinstance(given, dict) or not given:
            raise UserError(f"task_settings: {name} is {given!r}, expected settings, STAGE.KEY: value")


def _check_names(study: Study) -> None:
    """Refuse rows, columns, labels and a reference that mean nothing, and two things of the same name in the report."""
    values: dict[str, list[Any]] = {"task": list(study.tasks), "method": list(study.methods), **study.grid}
    values |= {"variant": [BASE, *study.variants]} if study.variants else {}
    known = {"rows": values, "columns": values, "reference": [*study.methods, *values.get("variant", [])]}
    known["labels"] = dict.fromkeys(shown(one) for axis, inside in values.items() for one in (axis, *inside))
    given = {"rows": study.rows, "columns": study.columns, "labels": study.labels}
    given["reference"] = [study.reference] if study.reference is not None else []
    for name, listed in given.items():
        for one in listed:
            if one not in known[name]:
                near = did_you_mean(one, known[name]) or f", expected some of {', '.join(known[name])}"
                raise UserError(f"{name} names {one}, which the study does not have{near}")
    placed = [*study.rows, *study.columns]
    if twice := [one for index, one in enumerate(placed) if one in placed[:index]]:
        raise UserError(f"rows and columns name {twice[0]} twice, expected each axis once")
    for axis, inside in {"the axes": list(values), **values}.items():
        called: dict[str, Any] = {}
        for one in inside:
            name = label(study.labels, one)
            if name in called:
                told = f"of {axis}, {shown(called[name])} and {shown(one)} are both called {name}"
                raise UserError(f"labels: {told}: the report could not tell them apart")
            called[name] = one


def _asked(study: Study) -> dict[str, list[Any]]:
    """Every setting that some cell is given, with its values."""
    asked: dict[str, list[Any]] = {}
    for settings in (study.settings, *study.task_settings.values(), *study.variants.values()):
        for key, value in settings.items():
            asked.setdefault(key, []).append(value)
    for key, values in study.grid.items():
        asked.setdefault(key, []).extend(values)
    return asked


def _check_setting(key: str, value: Any, trained: set[str]) -> None:
    """Refuse a setting that no stage of the study has, and a value that is of another type.

    Raises:
        UserError: It is misspelt, the study's own, or of a stage that nothing here trains.
    """
    room, _, name = key.partition(".")
    if room in ("data", "evaluate"):
        if key not in SETTINGS:
            near = did_you_mean(key, SETTINGS) or f", expected some of {', '.join(SETTINGS)}"
            raise UserError(f"{key} is not a setting of the data or the evaluation{near}")
        allowed, expected = SETTINGS[key]
        if not allowed(value):
            raise UserError(f"{key} is {value!r}, expected {expected}")
        return
    if room not in STAGES or not name:
        known = [f"{stage}.{one}" for stage in trained for one in options(STAGES[stage])]
        near = did_you_mean(key, known) or f": write STAGE.KEY with a stage of {', '.join(sorted(trained))}"
        raise UserError(f"{key} is not a setting{near}")
    if room not in trained:
        raise UserError(
            f"{key} is a setting of {room}, but the methods of this study train {', '.join(sorted(trained))}"
        )
    if name in OURS:
        raise UserError(f"{key} is set by the study itself: leave it out")
    refuse_typos(room, ["fit", argument(name, value)], prefix=f"{room}.")


def check_stage(stage: str, settings: Mapping[str, Any], task: str, skill: Mapping[str, Any]) -> None:
    """Refuse settings that a stage's own module or data would refuse when its training begins.

    The module is made without memory for its weights. Where a package is missing, only its settings are looked at.

    Args:
        stage: Its name.
        settings: All of its settings.
        task: Name of the task.
        skill: Settings of the skills that it reads; empty without.

    Raises:
        UserError: Names the first setting.
    """
    rooms: dict[str, dict[str, Any]] = {"model": {}, "data": {}}
    for key, value in settings.items():
        room, _, name = key.partition(".")
        if room in rooms and value != str(inspect.Parameter.empty):  # the class knows its default
            rooms[room][name] = value
    for room, refuse in {"data": _refuse_data, "model": _refuse_model}.items():
        try:
            refuse(stage, rooms, task, skill)
        except UserError as error:
            named = str(error).startswith(("model.", "data."))
            if room == "data" or named:  # else the module lacks a package, or weights to start from
                raise UserError(f"{stage}.{error}" if named else f"{stage}.data.{error}") from None
        except Exception:  # noqa: S110 - what no rule of the stage's forbids is left to the training
            pass


def _refuse_data(stage: str, rooms: Mapping[str, Mapping[str, Any]], task: str, skill: Mapping[str, Any]) -> None:
    """Ask the rules of a stage's data, as far as they need neither data nor checkpoints."""
    row, data = STAGES[stage], rooms["data"]
    if row.data == STAGES["skill"].data:
        row.data_class()(task=task, **data)
        return
    if "gamma" in data:
        Relabelling(**{one.name: data[one.name] for one in fields(Relabelling)})
    if refuse_settings := getattr(row.data_class(), "refuse_settings", None):
        refuse_settings({"data": None, **data})


def _refuse_model(stage: str, rooms: Mapping[str, Mapping[str, Any]], task: str, skill: Mapping[str, Any]) -> None:
    """Ask the rules of a stage's module by making it."""
    import torch

    row, (model, data), known = STAGES[stage], (rooms["model"], rooms["data"]), get_task(task)
    skills = {name.removeprefix("model."): value for name, value in skill.items() if name.startswith("model.")}
    links = {"observation_dim": known.observation_dim, "action_dim": known.action_dim, "horizon": data.get("horizon")}
    links |= {"num_skills": skills.get("num_skills"), "skill_dim": skills.get("skill_dim"), "skill_hash": None}
    if "space" in row.links:
        raw, discrete = data["actions"] == "raw", has_codes(skill)
        links["space"] = "raw" if raw else "discrete" if discrete else "continuous"
        links["choices"] = known.action_dim if raw else links["num_skills" if discrete else "skill_dim"]
        links["prior_unknown"] = data["prior_rewards"] == "unknown"
        shape = {"observation_dim": known.observation_dim, "action_dim": known.action_dim}
        links["skill_settings"] = None if raw else {**skills, **shape, "horizon": skill["data.horizon"]}
    if model.get("init_from") is None:
        with torch.device("meta"):
            row.module_class()(**{name: links[name] for name in row.links}, **model)


def has_codes(skill: Mapping[str, Any]) -> bool:
    """Whether skills of these settings have codes; without settings there are no skills."""
    from dds_lightning.skill import BOTTLENECKS

    return bool(skill) and BOTTLENECKS[skill["model.bottleneck"]].discrete


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)
