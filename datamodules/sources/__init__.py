"""Where trajectories come from: `d4rl:FILE`, `minari:ID`, `local:DIR`, `arrays:DIR`; a new source is one more entry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from datamodules.sources.arrays import load_arrays
from datamodules.sources.d4rl import load_d4rl
from datamodules.sources.goal import cut_at_arrivals, relabel_to_goal
from datamodules.sources.minari import load_local, load_minari_id, local_env_id, minari_env_id
from datamodules.sources.subtasks import relabel_subtasks
from datamodules.trajectories import DataError, Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task, task_for_env


class Source(NamedTuple):
    """One kind of source.

    Attributes:
        load: Reads what follows the colon, for a task that `resolve_task` has found.
        recorded_in: Which environment the data say they were recorded in, without reading their arrays; None
            where the format does not say.
    """

    load: Callable[[str, Task | None], Trajectories]
    recorded_in: Callable[[str], str | None]


SOURCES: dict[str, Source] = {
    "local": Source(load_local, local_env_id),
    "minari": Source(load_minari_id, minari_env_id),
    "arrays": Source(load_arrays, lambda directory: None),
    "d4rl": Source(load_d4rl, lambda file: None),
}


def resolve_task(spec: str, task: Task | str) -> Task:
    """The variant of a task in which the data were recorded.

    Scores are honest only in the physics that the data come from: a task whose name leaves the variant open
    takes that of the data, as far as the data say it. A name with its variant (`hopper-medium@v4`) stands.

    Raises:
        UserError: For an unknown source or task.
        DataError: For data of another task.
    """
    task = get_task(task) if isinstance(task, str) else task
    source, rest = _parse(spec)
    env_id = source.recorded_in(rest)
    if env_id is None:
        return task
    found = task_for_env(task, env_id)
    if found is None:
        fitting = [one.env_id for one in (task, *map(task.variant, () if task.is_pinned else task.variants))]
        raise DataError(
            f"data '{spec}' were recorded in {env_id}, but task '{task.name}' needs "
            f"{' or '.join(dict.fromkeys(fitting))}; choose the task that fits the data, or other data"
        )
    return found


def _parse(spec: str) -> tuple[Source, str]:
    source, colon, rest = spec.partition(":")
    if not colon or source not in SOURCES or not rest:
        expected = ", ".join(f"{name}:..." for name in SOURCES)
        raise UserError(f"data: found '{spec}', expected one of {expected}")
    return SOURCES[source], rest


def load_trajectories(
    spec: str,
    task: Task | str | None = None,
    *,
    reward: Literal["task", "recorded"] = "task",
) -> Trajectories:
    """Read and check a data set.

    Args:
        spec: `local:DIR`, a folder with one Minari data set; `minari:ID`, a data set under
            MINARI_DATASETS_PATH or ~/.minari/datasets; `d4rl:FILE`, a file of D4RL's, by path or by name;
            `arrays:DIR`, what `Trajectories.save` wrote.
        task: The task that the data must fit; None only checks that they are sound, and keeps recorded
            rewards.
        reward: "task" gives what the task's `data_reward` names: in mazes the reward of its one goal
            (`relabel_to_goal`) or of the recording's (`cut_at_arrivals`), in the kitchen the number of subtasks
            done (`relabel_subtasks`), elsewhere what was recorded. "recorded" keeps that everywhere.

    Raises:
        UserError: For an unknown source.
        DataError: For data that are damaged, incomplete or another task's.
    """
    if reward not in ("task", "recorded"):
        raise UserError(f"reward: found '{reward}', expected 'task' or 'recorded'")
    source, rest = _parse(spec)
    task = resolve_task(spec, task) if task is not None else None
    trajectories = source.load(rest, task)
    if task is None or reward == "recorded" or task.data_reward == "environment":
        return trajectories
    relabel = {"goal": relabel_to_goal, "arrival": cut_at_arrivals, "subtasks": relabel_subtasks}[task.data_reward]
    return relabel(trajectories, task)
