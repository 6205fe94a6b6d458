"""Reads single rows of a recording's episodes, whatever its source, without loading the rest where the source can."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datamodules.sources import parse_spec
from datamodules.sources.source import Recording as Recording
from datamodules.trajectories import Trajectories
from dds_lightning.tasks import Task


def open_recording(spec: str, task: Task, rng: np.random.Generator) -> AbstractContextManager[Recording]:
    """Open a data set for reading single rows.

    Args:
        spec: As in `load_trajectories`.
        task: From `resolve_task`; the recording must have its observations and actions.
        rng: Draws the episodes of a Minari set, of which at most `datamodules.sources.minari.EPISODES` are read.

    Raises:
        UserError: For an unknown source.
        DataError: For data that are damaged or of another task, also while rows are read.
    """
    source, rest = parse_spec(spec)
    if source.open_rows is None:
        return nullcontext(_LoadedRows(source.load(rest, task)))
    return source.open_rows(rest, task, rng)


class _LoadedRows:
    """Trajectories in memory or in a memory map."""

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
