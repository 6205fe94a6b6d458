"""Reads single rows of a recording's episodes, whatever its source, without loading the rest."""

from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np

from datamodules.sources import parse_spec
from datamodules.sources.source import Recording as Recording
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
    return source.open_rows(rest, task, rng)
