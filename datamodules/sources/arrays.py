"""`arrays:DIR`: what `Trajectories.save` wrote, memory-mapped."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.sources.plausibility import refuse_other_task
from datamodules.sources.source import Recording, Source, check_width
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


@contextlib.contextmanager
def open_arrays(directory: str, task: Task, rng: np.random.Generator) -> Iterator[Recording]:
    """Open a folder of arrays for reading single rows; see `Source.open_rows`."""
    yield _ArraysRows(load_arrays(directory, task))


class _ArraysRows:
    def __init__(self, data: Trajectories) -> None:
        self.data, self.where, self.width = data, f"data set '{data.name}'", data.observation_dim
        self.steps = self.known = data.lengths
        self.ended = data.terminations[data.step_offsets[1:] - 1]

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        first = self.data.observation_offsets[episode]
        return self.data.observations[first + start : first + stop]

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        rows = slice(self.data.step_offsets[episode] + start, self.data.step_offsets[episode] + stop)
        return self.data.actions[rows], self.data.rewards[rows]

    def inner(self, episode: int, step: int) -> None:
        return None


ARRAYS = Source(
    rest="DIR",
    about="a folder that `Trajectories.save` wrote",
    load=load_arrays,
    locate=lambda directory: expand(directory),
    open_rows=open_arrays,
    again="write the folder again with `Trajectories.save`",
)
