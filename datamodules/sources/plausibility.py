"""Checks by its numbers whether a recording can be of a task: D4RL's files do not name their environment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from datamodules.sources.source import FIT
from datamodules.validation import DataError
from dds_lightning.envs.kitchen import goal_vector
from dds_lightning.tasks import Task
from dds_lightning.tasks.bodies import body_of

IN_WALLS = 0.05
"""Share of positions that may lie in walls. None do, but maps may be drawn with a margin."""

SAMPLE = 100_000
"""Rows that are inspected."""


def refuse_other_task(where: str, observations: NDArray[np.float32], task: Task) -> None:
    """Refuse observations that no recording of `task` can contain.

    Args:
        where: The data set, as messages begin.
        observations: (N, O); their width has been checked.
        task: In mazes, positions must lie in its corridors; in the kitchen, the goal columns must match its
            subtasks; bodies with the same widths are distinguished by their height.

    Raises:
        DataError: For the data of another task.
    """
    rows = observations[:: max(1, len(observations) // SAMPLE)]
    if task.maze_map is not None:
        _refuse_other_maze(where, rows, task)
    if task.subtasks:
        _refuse_other_subtasks(where, rows, task)
    low, high = body_of(task).heights
    height = float(np.median(rows[:, 0]))
    if not low <= height <= high:
        raise DataError(
            f"{where}, observations: the body's median height is {height:.3g} m, but in task '{task.name}' it is "
            f"between {low:g} and {high:g}: the data are of another body; {FIT}"
        )


def _refuse_other_maze(where: str, rows: NDArray[np.float32], task: Task) -> None:
    walls = np.array([[value == "1" for value in row] for row in task.maze_map or ()])
    cells = task.xy_to_cell(rows[:, :2])
    outside = ((cells < 0) | (cells >= walls.shape)).any(axis=1)
    i, j = np.clip(cells, 0, np.array(walls.shape) - 1).T
    share = float((outside | walls[i, j]).mean())
    if share > IN_WALLS:
        raise DataError(
            f"{where}, observations: {share:.0%} of the positions lie outside the corridors of task '{task.name}': "
            f"the data are of another maze, or of other physics with other coordinates; {FIT}"
        )


def _refuse_other_subtasks(where: str, rows: NDArray[np.float32], task: Task) -> None:
    expected = goal_vector(task.subtasks)
    odd = np.argwhere(np.abs(rows[:, 30:] - expected) > 0.01)
    if len(odd):
        row, column = (int(index) for index in odd[0])
        raise DataError(
            f"{where}, observations: got {rows[row, 30 + column]:g} in column {30 + column}, but the goal of task "
            f"'{task.name}' ({', '.join(task.subtasks)}) has {expected[column]:g} there: they are "
            f"of another task; {FIT}"
        )
