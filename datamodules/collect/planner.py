"""Shortest paths through the cells of any maze that is drawn with 0 and 1."""

from __future__ import annotations

from collections import deque
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dds_lightning.errors import UserError

Cell = tuple[int, int]


class MazePlanner:
    """Breadth-first search from every free cell, once; afterwards every query is one look-up.

    Cells are numbered row by row: `index = row * columns + column`.

    Attributes:
        next_cell: (cells, cells) int64; `next_cell[goal, cell]` is the neighbour of `cell` nearest to `goal`,
            the goal itself at the goal. A wall cell points at the nearest free cell, so that a body whose
            centre slips over an edge finds its way back.
        distance: (cells, cells) int64; steps between cells, -1 where there is no path.
    """

    def __init__(self, maze_map: tuple[str, ...]) -> None:
        """Plan on `maze_map`: rows of "0" (free) and "1" (wall), all of one length."""
        self.rows, self.columns = len(maze_map), len(maze_map[0])
        if any(len(row) != self.columns or set(row) - {"0", "1"} for row in maze_map):
            raise UserError(f"maze_map: expected equally long rows of 0 and 1, got {maze_map}")
        self.free = np.array([value == "0" for row in maze_map for value in row])
        cells = self.rows * self.columns
        self.next_cell = np.tile(np.arange(cells), (cells, 1))
        self.distance = np.full((cells, cells), -1, dtype=np.int64)
        for goal in np.flatnonzero(self.free):
            self._search(int(goal))
        rows, columns = np.divmod(np.arange(cells), self.columns)
        free = np.flatnonzero(self.free)
        for wall in np.flatnonzero(~self.free):
            away = np.abs(rows[free] - rows[wall]) + np.abs(columns[free] - columns[wall])
            self.next_cell[:, wall] = free[np.argmin(away)]

    def _search(self, goal: int) -> None:
        self.distance[goal, goal] = 0
        queue = deque([goal])
        while queue:
            cell = queue.popleft()
            for neighbour in self._neighbours(cell):
                if self.distance[goal, neighbour] < 0:
                    self.distance[goal, neighbour] = self.distance[goal, cell] + 1
                    self.next_cell[goal, neighbour] = cell
                    queue.append(neighbour)

    def _neighbours(self, cell: int) -> list[int]:
        row, column = divmod(cell, self.columns)
        around = ((row - 1, column), (row, column - 1), (row, column + 1), (row + 1, column))
        return [
            i * self.columns + j
            for i, j in around
            if 0 <= i < self.rows and 0 <= j < self.columns and self.free[i * self.columns + j]
        ]

    def index(self, cell: Cell) -> int:
        """Number of a (row, column) cell."""
        return int(cell[0]) * self.columns + int(cell[1])

    def path(self, start: Cell, goal: Cell) -> list[Cell]:
        """Cells of a shortest path, both ends included.

        Raises:
            UserError: When an end is a wall or there is no path.
        """
        cell, end = self.index(start), self.index(goal)
        if self.distance[end, cell] < 0:
            raise UserError(f"maze: there is no path from cell {start} to cell {goal}")
        cells = [cell]
        while cell != end:
            cell = int(self.next_cell[end, cell])
            cells.append(cell)
        return [divmod(cell, self.columns) for cell in cells]

    def distances_to(self, goal: Cell) -> NDArray[np.int64]:
        """(rows, columns) steps to `goal`, -1 for walls and cut-off cells."""
        return self.distance[self.index(goal)].reshape(self.rows, self.columns)


@lru_cache(maxsize=32)
def planner_for(maze_map: tuple[str, ...]) -> MazePlanner:
    """The planner of a maze, created once per process."""
    return MazePlanner(maze_map)
