"""Reads what `Trajectories.save` wrote, memory-mapped."""

from __future__ import annotations

from datamodules.trajectories import Trajectories
from datamodules.validation import DataError
from dds_lightning.tasks import Task


def load_arrays(directory: str, task: Task | None) -> Trajectories:
    """Map a folder of arrays and check that their widths fit `task`.

    Raises:
        DataError: When a file is damaged or a width is another task's.
    """
    trajectories = Trajectories.load(directory, mmap=True)
    if task is not None:
        for what, found, expected in (
            ("observations", trajectories.observation_dim, task.observation_dim),
            ("actions", trajectories.action_dim, task.action_dim),
        ):
            if found != expected:
                raise DataError(
                    f"data set '{trajectories.name}', {what}: found {found} columns, task '{task.name}' "
                    f"needs {expected}"
                )
    return trajectories
