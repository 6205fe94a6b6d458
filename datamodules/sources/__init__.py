"""Where trajectories come from: `local:DIR`, `minari:ID`, `arrays:DIR`; a new source is one more entry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

from datamodules.sources.arrays import load_arrays
from datamodules.sources.goal import relabel_to_goal
from datamodules.sources.minari import load_local, load_minari_id, local_env_id, minari_env_id
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
    reward: Literal["evaluation_goal", "recorded"] = "evaluation_goal",
) -> Trajectories:
    """Read and check a data set.

    Args:
        spec: `local:DIR`, a folder with one Minari data set; `minari:ID`, a data set under
            MINARI_DATASETS_PATH or ~/.minari/datasets; `arrays:DIR`, what `Trajectories.save` wrote.
        task: The task that the data must fit; None only checks that they are sound, and keeps recorded
            rewards.
        reward: In mazes, "evaluation_goal" gives the reward of the task's one goal (`relabel_to_goal`),
            whatever goals the recording had; "recorded" keeps what the environment gave. Other tasks keep
            theirs.

    Raises:
        UserError: For an unknown source.
        DataError: For data that are damaged, incomplete or another task's.
    """
    if reward not in ("evaluation_goal", "recorded"):
        raise UserError(f"reward: found '{reward}', expected 'evaluation_goal' or 'recorded'")
    source, rest = _parse(spec)
    task = resolve_task(spec, task) if task is not None else None
    trajectories = source.load(rest, task)
    if task is not None and task.data_reward == "goal" and reward == "evaluation_goal":
        trajectories = relabel_to_goal(trajectories, task)
    return trajectories
