"""The table of tasks: which environment, from where to where, how long, and how scores and rewards are read.

Facts are rows of `rows.py`; a new task is a new row. Environments are built from this table and nothing else,
never from what a data set says about itself.
"""

from __future__ import annotations

import difflib
import math
from typing import TYPE_CHECKING

from dds_lightning.errors import UserError
from dds_lightning.tasks.rows import ROWS
from dds_lightning.tasks.task import Cell as Cell
from dds_lightning.tasks.task import Task as Task

if TYPE_CHECKING:
    import pandas as pd

_TABLE: dict[str, Task] = {task.name: task for task in ROWS}


def task_names() -> tuple[str, ...]:
    """Names of all tasks, in the order of the table, without variants."""
    return tuple(_TABLE)


def get_task(name: str | Task) -> Task:
    """Look a task up by name, `NAME` or `NAME@VARIANT`; a task stands for itself.

    Raises:
        UserError: When there is no such task; the message lists the nearest names.
    """
    if isinstance(name, Task):
        return name
    base, at, physics = str(name).partition("@")
    if base not in _TABLE:
        near = difflib.get_close_matches(base, _TABLE, n=3, cutoff=0.5) or list(_TABLE)
        raise UserError(f"task: there is no task '{base}'; did you mean {', '.join(near)}? See `dds tasks`")
    return _TABLE[base].variant(physics) if at else _TABLE[base]


def task_for_env(task: Task, env_id: str) -> Task | None:
    """The variant of a task in which recordings of an environment belong; None where none fits.

    A task whose name says its variant stands for itself alone.
    """
    if task.accepts(env_id):
        return task
    if task.is_pinned:
        return None
    return next((found for name in task.variants if (found := task.variant(name)).accepts(env_id)), None)


def known_env_ids() -> frozenset[str]:
    """Every environment whose recordings some task accepts, in any variant."""
    everything = [one for task in ROWS for one in (task, *map(task.variant, task.variants))]
    return frozenset(env_id for task in everything for env_id in (task.env_id, *task.data_env_ids))


def task_table() -> pd.DataFrame:
    """The table of tasks for people: one row a task; `facts.task_facts` has everything about one."""
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
