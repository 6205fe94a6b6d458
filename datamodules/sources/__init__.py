"""Where trajectories come from: `local:DIR`, `minari:ID`, `arrays:DIR`; a new source is one more entry."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from datamodules.sources.arrays import load_arrays
from datamodules.sources.goal import relabel_to_goal
from datamodules.sources.minari import load_local, load_minari_id
from datamodules.trajectories import Trajectories
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task

SOURCES: dict[str, Callable[[str, Task | None], Trajectories]] = {
    "local": load_local,
    "minari": load_minari_id,
    "arrays": load_arrays,
}


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
    task = get_task(task) if isinstance(task, str) else task
    source, colon, rest = spec.partition(":")
    if not colon or source not in SOURCES or not rest:
        expected = ", ".join(f"{name}:..." for name in SOURCES)
        raise UserError(f"data: found '{spec}', expected one of {expected}")
    trajectories = SOURCES[source](rest, task)
    if task is not None and task.maze_map is not None and reward == "evaluation_goal":
        trajectories = relabel_to_goal(trajectories, task)
    return trajectories
