"""The table of tasks: which environment, from where to where, how long, and how scores and rewards are read.

A task is one environment with one start and one goal. Facts are rows of `_ROWS`; a new task is a new row.
Environments are built from this table and nothing else, never from what a data set says about itself.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dds_lightning.errors import UserError

if TYPE_CHECKING:
    import pandas as pd

Cell = tuple[int, int]


@dataclass(frozen=True)
class Task:
    """One row of the task table.

    Attributes:
        name: What a user types, for example `pointmaze-large-diverse`.
        family: Tasks of one family share observations, actions and recipes.
        env_id: Gymnasium's name of the environment.
        observation_dim: O, the width of the flat observation. It never holds the goal: one task has one goal.
        action_dim: A.
        action_low: Lower bound of every action entry.
        action_high: Upper bound of every action entry.
        max_episode_steps: Steps after which an evaluation episode is truncated.
        maze_map: Rows of the maze, "1" wall and "0" free; None where there is no maze.
        cell_size: Side of a cell in metres.
        start_cell: (row, column) where evaluation episodes start.
        goal_cell: (row, column) of the one goal.
        goal_radius: Distance to the goal in metres that counts as success.
        reward_scale: The learner's reward is `reward_scale * (reward + reward_shift)`; scores never use it.
        reward_shift: See `reward_scale`.
        score_min: Return that scores 0.
        score_max: Return that scores 100.
        evaluation_episodes: Episodes behind a published score.
        data_ids: Source -> name of the data set in that source.
        data_env_ids: Environments whose recordings fit this task (same body, same walls); `env_id` always
            does.
        data_start_cells: Cells where collected episodes start; None means every free cell.
        data_goal_cells: Cells that collected episodes head for; None means every free cell.
        paper_score: Normalised score that the paper reports, if it does.
    """

    name: str
    family: str
    env_id: str
    observation_dim: int
    action_dim: int
    max_episode_steps: int
    action_low: float = -1.0
    action_high: float = 1.0
    maze_map: tuple[str, ...] | None = None
    cell_size: float = 1.0
    start_cell: Cell | None = None
    goal_cell: Cell | None = None
    goal_radius: float = 0.45
    reward_scale: float = 1.0
    reward_shift: float = 0.0
    score_min: float = 0.0
    score_max: float = 1.0
    evaluation_episodes: int = 100
    data_ids: Mapping[str, str] = field(default_factory=dict, hash=False)
    data_env_ids: tuple[str, ...] = ()
    data_start_cells: tuple[Cell, ...] | None = None
    data_goal_cells: tuple[Cell, ...] | None = None
    paper_score: float | None = None

    # ------------------------------------------------------------------ geometry

    def free_cells(self) -> tuple[Cell, ...]:
        """Every free (row, column) of the maze, row by row."""
        rows = self._maze()
        return tuple((i, j) for i, row in enumerate(rows) for j, value in enumerate(row) if value == "0")

    def cell_to_xy(self, cell: ArrayLike) -> NDArray[np.float64]:
        """Centre of a cell in the environment's coordinates: origin in the middle, y up, rows down.

        Args:
            cell: (..., 2) row and column.

        Returns:
            (..., 2) x and y in metres.
        """
        rows = self._maze()
        cell = np.asarray(cell, dtype=np.float64)
        x = (cell[..., 1] + 0.5 - len(rows[0]) / 2) * self.cell_size
        y = (len(rows) / 2 - cell[..., 0] - 0.5) * self.cell_size
        return np.stack([x, y], axis=-1)

    def xy_to_cell(self, xy: ArrayLike) -> NDArray[np.int64]:
        """The cell that holds a position; the inverse of `cell_to_xy`.

        Args:
            xy: (..., 2) x and y in metres.

        Returns:
            (..., 2) row and column; outside the maze the numbers run on past its edges.
        """
        rows = self._maze()
        xy = np.asarray(xy, dtype=np.float64)
        i = np.floor(len(rows) / 2 - xy[..., 1] / self.cell_size)
        j = np.floor(xy[..., 0] / self.cell_size + len(rows[0]) / 2)
        return np.stack([i, j], axis=-1).astype(np.int64)

    def start_xy(self) -> NDArray[np.float64]:
        """Centre of the start cell, (2,)."""
        if self.start_cell is None:
            raise UserError(f"task '{self.name}' has no start cell: only mazes have one")
        return self.cell_to_xy(self.start_cell)

    def goal_xy(self) -> NDArray[np.float64]:
        """Centre of the goal cell, (2,)."""
        if self.goal_cell is None:
            raise UserError(f"task '{self.name}' has no goal cell: only mazes have one")
        return self.cell_to_xy(self.goal_cell)

    def _maze(self) -> tuple[str, ...]:
        if self.maze_map is None:
            raise UserError(f"task '{self.name}' has no maze: cells mean nothing there")
        return self.maze_map

    # ------------------------------------------------------------------ scores

    def normalised_score(self, returns: ArrayLike) -> NDArray[np.float64]:
        """D4RL's normalised score, 0 to 100: `100 * (return - score_min) / (score_max - score_min)`."""
        returns = np.asarray(returns, dtype=np.float64)
        return 100.0 * (returns - self.score_min) / (self.score_max - self.score_min)

    # ------------------------------------------------------------------ environments

    def make_env(self, render_mode: str | None = None) -> gym.Env[NDArray[np.float32], NDArray[np.float32]]:
        """The evaluation environment: flat float32 observations, this task's start and goal at every reset.

        In mazes the body starts in `start_cell` with the environment's own noise, the goal is exactly the
        centre of `goal_cell`, and reaching it ends the episode. `info` holds `success` (bool) after every
        reset and step, and in mazes `position` (2,).

        Args:
            render_mode: Gymnasium's render mode, for example "rgb_array".
        """
        from dds_lightning.envs.build import MazeTask, TaskEnv, build_env  # gymnasium is slow to import

        options, maze = {}, None
        if self.maze_map is not None:
            options = {"continuing_task": False}
            maze = MazeTask(self.start_cell, self.goal_cell, self.goal_radius, self.cell_to_xy)
        cap = self.max_episode_steps
        env = build_env(self.env_id, max_episode_steps=cap, render_mode=render_mode, **options)
        return TaskEnv(env, self.observation_dim, maze)


# ---------------------------------------------------------------------- the table

_UMAZE = ("11111", "10001", "11101", "10001", "11111")
_MEDIUM = ("11111111", "10011001", "10010001", "11000111", "10010001", "10100101", "10001001", "11111111")
_LARGE = (
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


def _pointmaze(
    size: str, *, maze_map: tuple[str, ...], cap: int, start: Cell, goal: Cell, play: tuple[Cell, ...]
) -> tuple[Task, ...]:
    """Both data recipes of one PointMaze; `play` are the hand-picked cells between which `-play` data travel.

    Rewards are learnt as 0.1 * (r - 1): every step on the way costs the same, as IQL does for AntMaze, and a
    skill of ten steps costs about one.
    """
    camel = "UMaze" if size == "umaze" else size.capitalize()
    kinds = ("", "_Diverse_G", "_Diverse_GR", "Dense", "_Diverse_GDense", "_Diverse_GRDense")

    def row(recipe: str, cells: tuple[Cell, ...] | None) -> Task:
        return Task(
            name=f"pointmaze-{size}-{recipe}",
            family="pointmaze",
            env_id=f"PointMaze_{camel}-v3",
            observation_dim=4,
            action_dim=2,
            max_episode_steps=cap,
            maze_map=maze_map,
            start_cell=start,
            goal_cell=goal,
            reward_scale=0.1,
            reward_shift=-1.0,
            data_ids={"minari": f"pointmaze-{size}-{recipe}-v0"},
            data_env_ids=tuple(f"PointMaze_{camel}{kind}-v3" for kind in kinds),
            data_start_cells=cells,
            data_goal_cells=cells,
        )

    return row("play", play), row("diverse", None)


_ROWS: tuple[Task, ...] = (
    *_pointmaze("umaze", maze_map=_UMAZE, cap=300, start=(1, 1), goal=(3, 1), play=((1, 1), (1, 3), (3, 3), (3, 1))),
    *_pointmaze(
        "medium",
        maze_map=_MEDIUM,
        cap=600,
        start=(1, 1),
        goal=(6, 6),
        play=((1, 1), (1, 6), (4, 1), (4, 4), (6, 1), (6, 6)),
    ),
    *_pointmaze(
        "large",
        maze_map=_LARGE,
        cap=800,
        start=(7, 1),
        goal=(1, 10),
        play=((7, 1), (1, 1), (1, 4), (7, 4), (1, 6), (5, 6), (7, 10), (5, 10), (3, 8), (1, 10)),
    ),
)
_TABLE: dict[str, Task] = {task.name: task for task in _ROWS}


def task_names() -> tuple[str, ...]:
    """Names of all tasks, in the order of the table."""
    return tuple(_TABLE)


def get_task(name: str) -> Task:
    """Look a task up by name.

    Raises:
        UserError: When there is no such task; the message lists the nearest names.
    """
    if name in _TABLE:
        return _TABLE[name]
    near = difflib.get_close_matches(str(name), _TABLE, n=3, cutoff=0.5) or list(_TABLE)
    raise UserError(f"task: there is no task '{name}'; did you mean {', '.join(near)}? See `dds tasks`")


def known_env_ids() -> frozenset[str]:
    """Every environment whose recordings some task accepts."""
    return frozenset(env_id for task in _ROWS for env_id in (task.env_id, *task.data_env_ids))


def task_table() -> pd.DataFrame:
    """The table of tasks for people: one row a task."""
    import pandas as pd

    return pd.DataFrame(
        [
            {
                "task": task.name,
                "environment": task.env_id,
                "observations": task.observation_dim,
                "actions": task.action_dim,
                "start": task.start_cell,
                "goal": task.goal_cell,
                "steps": task.max_episode_steps,
                "score 0": task.score_min,
                "score 100": task.score_max,
                "paper": math.nan if task.paper_score is None else task.paper_score,
                "data": ", ".join(f"{source}:{name}" for source, name in task.data_ids.items()),
            }
            for task in _ROWS
        ]
    )
