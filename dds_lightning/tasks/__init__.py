"""The table of tasks: which environment, from where to where, how long, and how scores and rewards are computed.

Facts are rows of `rows.py`; a new task is a new row. Environments are built from this table and nothing else,
never from the metadata of a data set.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dds_lightning.errors import UserError
from dds_lightning.tasks.own import build_task, definition, is_address, load_task
from dds_lightning.tasks.rows import ROWS
from dds_lightning.tasks.task import Cell as Cell
from dds_lightning.tasks.task import Task as Task

if TYPE_CHECKING:
    import pandas as pd

_TABLE: dict[str, Task] = {task.name: task for task in ROWS}
_OWN: dict[str, Task] = {}
"""Custom tasks that this process has read."""


def task_names() -> tuple[str, ...]:
    """Names of all tasks, in the order of the table, without variants."""
    return tuple(_TABLE)


def get_task(name: str | Task) -> Task:
    """Look up a task.

    Args:
        name: `NAME` or `NAME@VARIANT` of the table, the path of a task file, `package.module:NAME` of a `Task`, or the
            name of a custom task that this process has read before. In mazes `?goal=ROW,COLUMN`, `?start=ROW,COLUMN`
            or `?start=ROW,COLUMN&goal=ROW,COLUMN` may follow. A `Task` is returned as it is.

    Raises:
        UserError: There is no such task; the message lists the nearest names.
    """
    if not isinstance(name, str):
        return name
    address, _, cells = name.partition("?")
    if not is_address(address):
        return known_task(name)
    found = load_task(address)
    task = known_task(found) if isinstance(found, str) else remember(found)
    return _moved(task, cells)


def known_task(name: str) -> Task:
    """Look up a name found in a file: in the table, or among the tasks read before; nothing is opened or executed.

    Raises:
        UserError: There is no such task; the message lists the nearest names.
    """
    whole, _, cells = name.partition("?")
    base, at, physics = whole.partition("@")
    if base in _OWN and not at:
        return _moved(_OWN[base], cells)
    if base not in _TABLE:
        near = difflib.get_close_matches(base, _TABLE, n=3, cutoff=0.5)
        hint = f"; did you mean {', '.join(near)}? See `dds tasks`" if near else ": `dds tasks` lists them"
        raise UserError(f"task: there is no task '{base}'{hint}")
    return _moved(_TABLE[base].variant(physics) if at else _TABLE[base], cells)


def _moved(task: Task, cells: str) -> Task:
    """Return a task with the start and goal of `start=ROW,COLUMN&goal=ROW,COLUMN`, either of which may be missing.

    Raises:
        UserError: It says something else, or names no free cell.
    """
    if not cells:
        return task
    given: dict[str, tuple[int, int]] = {}
    for part in cells.split("&"):
        match = re.fullmatch(r"(start|goal)=(\d+),(\d+)", part)
        if match is None or match[1] in given:
            raise UserError(
                f"task: '{part}' follows the ? of '{task.name}?{cells}', expected goal=ROW,COLUMN, start=ROW,COLUMN or "
                "both, joined by &"
            )
        given[match[1]] = (int(match[2]), int(match[3]))
    start, goal = (given.get(which) for which in ("start", "goal"))
    changed = {"start": start if start != task.start_cell else None, "goal": goal if goal != task.goal_cell else None}
    text = "&".join(f"{which}={cell[0]},{cell[1]}" for which, cell in changed.items() if cell)
    return task.moved(f"{task.name}?{text}", changed["start"], changed["goal"]) if text else task


def remember(task: Task) -> Task:
    """Register a custom task, so that `get_task` finds it by name in this process.

    Raises:
        UserError: The table has a task of that name.
    """
    if task.base_name in _TABLE and task != known_task(task.name):
        raise UserError(f"task: name is {task.name}, which is already in the table; choose another name")
    if task.base_name not in _TABLE:
        _OWN[task.name] = task
    return task


def is_own(task: Task) -> bool:
    """Whether a task is not in the table, so that its definition has to be stored along with its name."""
    return task.base_name not in _TABLE


def restore_task(facts: Mapping[str, Any], where: str | Path) -> Task | None:
    """Return the task that an agent or a run was trained for.

    Args:
        facts: `task`, its name, and `task_definition` if it is not in the table; see `facts_to_keep`.
        where: The file, for messages.

    Returns:
        The task; None if no name is stored.

    Raises:
        UserError: There is no such task, or its definition is invalid.
    """
    kept = facts.get("task_definition")
    if kept is not None:
        if not isinstance(kept, Mapping):
            raise UserError(f"{where}: task_definition is {kept!r}, expected a mapping of names to values")
        return remember(build_task(kept, f"{where}, task_definition", trusted=False))
    return None if facts.get("task") is None else known_task(str(facts["task"]))


def facts_to_keep(task: Task) -> dict[str, Any]:
    """Return what an agent or a run has to store so that `restore_task` finds its task anywhere."""
    return {"task": task.name, **({"task_definition": definition(task)} if is_own(task) else {})}


def task_for_env(task: Task, env_id: str) -> Task | None:
    """Return the variant of a task that recordings from an environment fit; None if no variant does.

    If the name of the task includes its variant, no other variant is considered.
    """
    if task.accepts(env_id):
        return task
    if task.is_pinned:
        return None
    return next((found for name in task.variants if (found := task.variant(name)).accepts(env_id)), None)


def known_env_ids() -> frozenset[str]:
    """Every environment whose recordings some task accepts, in any variant; custom tasks that were read included."""
    everything = [one for task in (*ROWS, *_OWN.values()) for one in (task, *map(task.variant, task.variants))]
    return frozenset(name for task in everything for name in (task.env_id.rpartition(":")[2], *task.data_env_ids))


def task_table() -> pd.DataFrame:
    """Return the table of tasks for people, one row per task; `facts.task_facts` has everything about one."""
    import pandas as pd

    return pd.DataFrame(
        [
            {
                "family": task.family,
                "variants": ", ".join(f"@{name}" for name in task.variants if name != task.physics),
                "task": task.name,
                "environment": task.env_id,
                "O/A": f"{task.observation_dim}/{task.action_dim}",
                "steps": task.max_episode_steps,
                "episodes": task.evaluation_episodes,
                "score range": f"{task.score_min:.4g} to {task.score_max:g}",
                "paper": math.nan if task.paper_score is None else task.paper_score,
            }
            for task in ROWS
        ]
    )
