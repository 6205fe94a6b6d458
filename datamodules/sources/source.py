"""What a source of trajectories is: one record, which loading, hashing and reading of rows ask."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from datamodules.trajectories import Trajectories
from datamodules.validation import DataError
from dds_lightning.tasks import Task

FIT = "choose a task that fits the data (`dds tasks`), or other data"
"""What helps where data are of another task."""


class Recording(Protocol):
    """Episodes whose rows can be read one by one.

    Attributes:
        where: The data set, as messages begin.
        width: W, columns of its observations.
        steps: (E,) steps of each episode.
        known: (E,) how many of those steps lead to a recorded state.
        ended: (E,) whether the last step terminated the episode.
    """

    where: str
    width: int
    steps: NDArray[np.int64]
    known: NDArray[np.int64]
    ended: NDArray[np.bool_]

    def states(self, episode: int, start: int, stop: int) -> NDArray[Any]:
        """Rows of observations, (stop - start, W)."""
        ...

    def taken(self, episode: int, start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        """Actions (stop - start, A) and rewards (stop - start,)."""
        ...

    def inner(self, episode: int, step: int) -> tuple[NDArray[Any], NDArray[Any]] | None:
        """The simulator's own qpos and qvel, if they are recorded."""
        ...


def check_width(where: str, task: Task | None, observations: int, actions: int) -> None:
    """Refuse arrays whose widths are not those of `task`; None accepts any.

    Raises:
        DataError: For a width of another task.
    """
    if task is None:
        return
    for name, found, expected in (
        ("observations", observations, task.observation_dim),
        ("actions", actions, task.action_dim),
    ):
        if found != expected:
            raise DataError(f"{where}, {name}: got {found} columns, task '{task.name}' needs {expected}; {FIT}")


@dataclass(frozen=True)
class Source:
    """One kind of source, `NAME:REST`; every function gets the `REST`.

    Attributes:
        rest: What stands for `REST` in help and messages, for example "FILE".
        about: What such a data set is, in a few words.
        load: Reads the data for a task that `resolve_task` returned; None accepts any task.
        locate: The file or folder of the data set. It need not exist.
        open_rows: Opens the data set of a task for reading single rows, where that is cheaper than to load all of it.
            The generator draws the episodes where the source offers only some of them. None loads all.
        again: What helps where the data are damaged or incomplete and the message does not say more.
        recorded_in: The id of the environment that the data say they were recorded in, without reading their arrays;
            None where the format does not say.
    """

    rest: str
    about: str
    load: Callable[[str, Task | None], Trajectories]
    locate: Callable[[str], Path]
    open_rows: Callable[[str, Task, np.random.Generator], AbstractContextManager[Recording]] | None = None
    again: str = "mend the data, or take others"
    recorded_in: Callable[[str], str | None] = lambda rest: None
