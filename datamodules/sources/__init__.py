"""Where trajectories come from: `d4rl:FILE`, `minari:ID`, `local:DIR`, `arrays:DIR`.

A new source is one `Source` record in a file of its own and one entry of `SOURCES`.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any, Literal

from datamodules.sources.arrays import ARRAYS
from datamodules.sources.d4rl import D4RL
from datamodules.sources.goal import cut_at_arrivals, relabel_to_goal
from datamodules.sources.minari import LOCAL, MINARI
from datamodules.sources.source import Source
from datamodules.sources.subtasks import relabel_subtasks
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task, is_own, remember, task_for_env

SOURCES: dict[str, Source] = {"local": LOCAL, "minari": MINARI, "arrays": ARRAYS, "d4rl": D4RL}
"""What stands before the colon -> the source."""


def parse_spec(spec: str) -> tuple[Source, str]:
    """The source of `NAME:REST`, and the `REST`.

    Raises:
        UserError: For an unknown source, or nothing after the colon; the message lists the known ones.
    """
    name, colon, rest = spec.partition(":")
    if not colon or name not in SOURCES or not rest:
        expected = ", ".join(f"{known}:{source.rest} ({source.about})" for known, source in SOURCES.items())
        raise UserError(f"data: got '{spec}', expected one of {expected}")
    return SOURCES[name], rest


@contextlib.contextmanager
def _remedy(source: Source) -> Iterator[None]:
    """Add to a refusal of data what helps, unless it has said so after a semicolon."""
    try:
        yield
    except DataError as error:
        if "; " in str(error):
            raise
        raise DataError(f"{error}; {source.again}") from error


def resolve_task(spec: str, task: Task | str) -> Task:
    """The variant of a task in which the data were recorded.

    Scores are valid only in the physics that the data come from: a task whose name leaves the variant open takes that
    of the data, if the data say it. A name with a variant (`hopper-medium@v4`) is kept.

    Raises:
        UserError: For an unknown source or task.
        DataError: For data of another task.
    """
    task = get_task(task)
    if is_own(task):
        remember(task)  # the reader accepts recordings of its environment
    source, rest = parse_spec(spec)
    with _remedy(source):
        env_id = source.recorded_in(rest)
    if env_id is None:
        return task
    found = task_for_env(task, env_id)
    if found is None:
        fitting = [one.env_id for one in (task, *map(task.variant, () if task.is_pinned else task.variants))]
        raise DataError(
            f"data '{spec}' were recorded in {env_id}, but task '{task.name}' needs "
            f"{' or '.join(dict.fromkeys(fitting))}; choose a task that fits the data, or other data"
        )
    return found


def load_trajectories(
    spec: str,
    task: Task | str | None = None,
    *,
    reward: Literal["task", "recorded"] = "task",
) -> Trajectories:
    """Read and check a data set.

    Args:
        spec: `local:DIR`, a folder with one Minari data set; `minari:ID`, a data set under MINARI_DATASETS_PATH or
            ~/.minari/datasets; `d4rl:FILE`, one of D4RL's files, by path or by name; `arrays:DIR`, a folder that
            `Trajectories.save` wrote.
        task: The task that the data must fit; None only checks that they are valid, and keeps the recorded rewards.
        reward: "task" gives what the task's `data_reward` names: in mazes the reward of its single goal
            (`relabel_to_goal`) or of the recording's goal (`cut_at_arrivals`), in the kitchen the number of subtasks
            done (`relabel_subtasks`), elsewhere the recorded rewards. "recorded" always keeps the recorded rewards.

    Returns:
        The data; their `task` is the variant that they were loaded for.

    Raises:
        UserError: For an unknown source.
        DataError: For data that are damaged, incomplete or of another task.
    """
    if reward not in ("task", "recorded"):
        raise UserError(f"reward: got '{reward}', expected 'task' or 'recorded'")
    source, rest = parse_spec(spec)
    task = resolve_task(spec, task) if task is not None else None
    with _remedy(source):
        trajectories = source.load(rest, task)
    if task is not None and reward == "task" and task.data_reward != "environment":
        to_goal = partial(relabel_to_goal, drawn=task.goal_noise > 0)
        relabel: Any = {"goal": to_goal, "arrival": cut_at_arrivals, "subtasks": relabel_subtasks}[task.data_reward]
        trajectories = relabel(trajectories, task)
        if "?" in task.name and not trajectories.terminations.any():
            warnings.warn(
                f"data '{spec}': no episode reaches the goal of {task.name}, so nothing rewards it; collect data "
                "that do, or choose another goal",
                stacklevel=2,
            )
    return trajectories.for_task(task)
