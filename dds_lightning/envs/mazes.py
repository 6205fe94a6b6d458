"""The mazes: their maps, and D4RL's three AntMazes, which this package registers with Gymnasium."""

from __future__ import annotations

from typing import NamedTuple

UMAZE = ("11111", "10001", "11101", "10001", "11111")
MEDIUM = ("11111111", "10011001", "10010001", "11000111", "10010001", "10100101", "10001001", "11111111")
LARGE = (
    "111111111111",
    "100001000001",
    "101101010101",
    "100000010001",
    "101111011101",
    "100101000001",
    "110101010111",
    "100100010001",
    "111111111111",
)  # fmt: skip


class AntMaze(NamedTuple):
    """One AntMaze in D4RL's physics.

    Attributes:
        maze_map: Rows of the maze, "1" wall and "0" free.
        cap: Maximum number of steps of an evaluation episode.
        goal_cell: (row, column) around which goals are drawn.
        start_cell: (row, column) where episodes start; the origin of the coordinates.
        cell_size: Side of a cell in metres.
        goal_radius: Distance in metres that counts as reaching the goal.
    """

    maze_map: tuple[str, ...]
    cap: int
    goal_cell: tuple[int, int]
    start_cell: tuple[int, int] = (1, 1)
    cell_size: float = 4.0
    goal_radius: float = 0.5


D4RL_ANTMAZES = {
    "UMaze": AntMaze(UMAZE, 700, (3, 1)),
    "Medium": AntMaze(MEDIUM, 1000, (6, 6)),
    "Large": AntMaze(LARGE, 1000, (7, 9)),
}
"""Size, as in the environment's id, -> the maze."""


def d4rl_antmaze_id(size: str) -> str:
    """Return Gymnasium's name of an AntMaze in D4RL's physics."""
    return f"dds/AntMazeD4RL_{size}-v0"
