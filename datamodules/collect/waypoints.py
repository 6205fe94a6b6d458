"""The next waypoint on the way through a maze."""

from __future__ import annotations

import math

import numpy as np

from datamodules.collect.planner import planner_for
from dds_lightning.tasks import Task

XY = tuple[float, float]


class Waypoints:
    """Follows shortest paths over a maze's cells, one body and one goal at a time.

    It uses plain Python floats: it runs once per step of the simulator, where NumPy on two numbers would be slower.
    """

    def __init__(self, task: Task) -> None:
        """Plan on the maze of `task`."""
        maze = task._maze()
        self.rows, self.columns, self.size = len(maze), len(maze[0]), task.cell_size
        self._row0, self._column0, self._down = task._frame()
        cells = np.array([divmod(i, self.columns) for i in range(self.rows * self.columns)])
        self._centres: list[list[float]] = task.cell_to_xy(cells).tolist()
        self._next: list[list[int]] = planner_for(maze).next_cell.tolist()
        self.forget()

    def forget(self) -> None:
        """Begin a new episode: the next call draws a new waypoint."""
        self._cell = self._goal = -1
        self._target = (0.0, 0.0)

    def index(self, x: float, y: float) -> int:
        """Number of the cell of a position, row by row; a position outside belongs to the nearest edge."""
        row = math.floor(self._down * y / self.size + self._row0 + 0.5)
        column = math.floor(x / self.size + self._column0 + 0.5)
        return min(max(row, 0), self.rows - 1) * self.columns + min(max(column, 0), self.columns - 1)

    def target(self, x: float, y: float, goal: XY, offset: XY) -> XY:
        """Where a body at (x, y) should head.

        Args:
            x: Metres.
            y: Metres.
            goal: Final position.
            offset: Metres from the next cell's centre; used when the body enters a cell or gets a new goal.

        Returns:
            The goal in the goal's cell, else a point in the next cell of a shortest path.
        """
        cell, aim = self.index(x, y), self.index(*goal)
        if cell != self._cell or aim != self._goal:
            self._cell, self._goal = cell, aim
            centre = self._centres[self._next[aim][cell]]
            self._target = (centre[0] + offset[0], centre[1] + offset[1])
        return goal if cell == aim else self._target
