"""`arrays:DIR`: what `Trajectories.save` wrote, memory-mapped."""

from __future__ import annotations

from datamodules.sources.plausibility import refuse_other_task
from datamodules.sources.source import Source, check_width
from datamodules.trajectories import Trajectories
from datamodules.validation import SLICE, in_box
from dds_lightning.saving.files import expand
from dds_lightning.tasks import Task


def load_arrays(directory: str, task: Task | None) -> Trajectories:
    """Map a folder of arrays and check that widths, actions and observations fit `task`.

    Raises:
        DataError: When a file is damaged, or the data are another task's.
    """
    trajectories = Trajectories.load(directory, mmap=True)
    where = f"data set '{trajectories.name}'"
    check_width(where, task, trajectories.observation_dim, trajectories.action_dim)
    if task is not None:
        low, high = task.action_box()
        for first in range(0, trajectories.num_steps, SLICE):
            in_box(f"{where}, actions", trajectories.actions[first : first + SLICE], low, high, first=first)
        refuse_other_task(where, trajectories.observations, task)
    return trajectories


ARRAYS = Source(
    rest="DIR",
    about="a folder that `Trajectories.save` wrote",
    load=load_arrays,
    locate=expand,
    again="write the folder again with `Trajectories.save`",
)
