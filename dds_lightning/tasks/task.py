"""The definition of a task: one environment, one start and one goal, and how its scores and rewards are computed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dds_lightning.errors import UserError

Cell = tuple[int, int]


def bounds_text(bound: ArrayLike) -> str:
    """A bound of all actions, or one for each entry, for people: `-1`, or `(-2, -1)`."""
    numbers = [f"{number:g}" for number in np.ravel(bound)]
    return numbers[0] if len(set(numbers)) == 1 else f"({', '.join(numbers)})"


@dataclass(frozen=True)
class Task:
    """One row of the task table.

    A body may be simulated in more than one way: D4RL's AntMaze files were recorded with different torques and a
    different time step from gymnasium-robotics. Such a row has `variants`: `NAME` is the physics that the published
    scores belong to, `NAME@VARIANT` another one. A variant is a task like any other; it never changes the widths of
    observations and actions.

    Attributes:
        name: What a user types, for example `pointmaze-large-diverse` or `hopper-medium@v5`.
        family: Tasks of one family share observations, actions and recipes.
        env_id: Gymnasium's name of the environment.
        observation_dim: O, the width of the flat observation. In mazes it never holds the goal: one task has
            one goal.
        observation_layout: Description of the numbers in an observation, in order.
        action_dim: A.
        action_low: Lower bound of every action entry, or of each, A numbers.
        action_high: Upper bound, likewise.
        max_episode_steps: Steps after which an evaluation episode is truncated.
        step_seconds: Simulated seconds per step.
        env_options: Further arguments to the environment's constructor.
        observation_keys: Entries of a dictionary observation that are put end to end, in this order; one of them may
            be the goal. Empty where the observation is one array.
        adapter: How the environment's observations are flattened: "flat" takes them as they are, "maze" and
            "kitchen" read gymnasium-robotics' dictionaries.
        physics: Name of this variant; "" if there is only one.
        variants: Name of a physics -> its values of the attributes in which the physics differ, including this
            row's `physics`.
        maze_map: Rows of the maze, "1" wall and "0" free; None if there is no maze.
        cell_size: Side of a cell in metres.
        origin: Where (0, 0) lies: in the maze's "centre" with y up (gymnasium-robotics), or in the middle of
            the "start" cell with y growing down the map (D4RL).
        origin_cell: The cell in whose middle (0, 0) lies where `origin` is "start"; None takes `start_cell`.
        start_cell: (row, column) where evaluation episodes start.
        goal_cell: (row, column) of the one goal.
        goal_radius: Distance to the goal in metres that counts as success.
        goal_noise: Mean distance in metres, on both axes, of evaluation goals from the goal cell's centre.
            D4RL's AntMaze draws each episode's goal from a one-sided range; elsewhere this is 0.
        subtasks: The subtasks of the kitchen, in the order of the published task.
        measures_success: Whether an episode can succeed; a runner only scores.
        data_reward: Source of the learner's rewards: "environment", as recorded; "goal", 1 if the step reaches the
            task's goal; "arrival", the same as judged by the recording, whose goal is one of many; "subtasks", the
            number of subtasks that are done in the state reached, at every step.
        reward_scale: The learner's reward is `reward_scale * (reward + reward_shift)`; scores never use it.
        reward_shift: See `reward_scale`.
        score_min: Return, in the environment's rewards, that scores 0.
        score_max: Return that scores 100.
        evaluation_episodes: Episodes behind a published score.
        data_ids: Source -> name of the data set in that source.
        data_env_ids: Further environments whose recordings fit this task (same body, same walls).
        data_start_cells: Cells where collected episodes start; None means every free cell.
        data_goal_cells: Cells that collected episodes head for; None means every free cell.
        paper_score: Normalised score that the paper reports in its table 1, if it does.
        body: Name of the robot in `tasks.bodies`; "" takes the first part of the task's name.
    """

    name: str
    family: str
    env_id: str
    observation_dim: int
    action_dim: int
    max_episode_steps: int
    step_seconds: float
    observation_layout: str = ""
    action_low: float | tuple[float, ...] = -1.0
    action_high: float | tuple[float, ...] = 1.0
    env_options: Mapping[str, Any] = field(default_factory=dict, hash=False)
    observation_keys: tuple[str, ...] = ()
    adapter: Literal["flat", "maze", "kitchen"] = "flat"
    physics: str = ""
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, hash=False, repr=False)
    maze_map: tuple[str, ...] | None = None
    cell_size: float = 1.0
    origin: Literal["centre", "start"] = "centre"
    origin_cell: Cell | None = None
    start_cell: Cell | None = None
    goal_cell: Cell | None = None
    goal_radius: float = 0.45
    goal_noise: float = 0.0
    subtasks: tuple[str, ...] = ()
    measures_success: bool = True
    data_reward: Literal["environment", "goal", "arrival", "subtasks"] = "environment"
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
    body: str = ""

    # ------------------------------------------------------------------ variants

    def variant(self, physics: str) -> Task:
        """The same task in another physics, named `NAME@PHYSICS`.

        Raises:
            UserError: This task has no such physics.
        """
        if physics not in self.variants:
            known = ", ".join(f"{self.base_name}@{name}" for name in self.variants) or "no variants"
            raise UserError(f"task: '{self.base_name}' has no physics '{physics}'; it has {known}")
        changes = {"physics": physics, **self.variants[physics]}
        _, mark, cells = self.name.partition("?")
        return replace(self, name=f"{self.base_name}@{physics}{mark}{cells}", **changes)

    @property
    def base_name(self) -> str:
        """The name without `@VARIANT` and `?CELLS`."""
        return re.split("[@?]", self.name, maxsplit=1)[0]

    @property
    def file_name(self) -> str:
        """The name without characters that shells or other programs take for something else."""
        return re.sub("[?&=,]", "-", self.name)

    @property
    def is_pinned(self) -> bool:
        """Whether the name says which physics is meant; otherwise the data may choose."""
        return "@" in self.name

    def moved(self, name: str, start: Cell | None, goal: Cell | None) -> Task:
        """Return the same maze from another start cell or to another goal cell.

        The data are the same, but whatever goal they were recorded with, their rewards become those of the new one.

        Args:
            name: Of the new task.
            start: (row, column) where episodes start; None leaves it.
            goal: (row, column) of the goal; None leaves it.

        Raises:
            UserError: There is no maze, or a cell is a wall or outside.
        """
        cells = {"start": start or self.start_cell, "goal": goal or self.goal_cell}
        for which, cell in cells.items():
            if cell not in self.free_cells():
                raise UserError(
                    f"task: {which} is {cell}, a wall or outside the maze of '{self.name}', expected row,column of a "
                    f"free cell; `dds tasks {self.base_name}` draws them"
                )
        if cells["start"] == cells["goal"]:
            raise UserError(f"task: start and goal of '{self.name}' are both {cells['goal']}, expected two cells")
        changes: dict[str, Any] = {"data_reward": "goal"} if goal else {}
        # D4RL's environments draw goal and pose themselves, around the cells that they were made with.
        options = {"reset_cell": cells["start"], "goal_cell": cells["goal"]}
        variants = {
            physics: {**differing, **changes, "env_options": {} if differing.get("adapter") == "maze" else options}
            for physics, differing in self.variants.items()
        }
        if variants:
            changes = {key: variants[self.physics][key] for key in ("env_options", *changes)}
        return replace(
            self,
            name=name,
            variants=variants,
            origin_cell=self.origin_cell or self.start_cell,
            start_cell=cells["start"],
            goal_cell=cells["goal"],
            paper_score=None,
            **changes,
        )

    def action_box(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lower and upper bounds of actions, (A,) each."""
        size = (self.action_dim,)
        return np.full(size, self.action_low, np.float32), np.full(size, self.action_high, np.float32)

    def accepts(self, env_id: str) -> bool:
        """Whether recordings from an environment fit this task without changes."""
        return env_id == self.env_id.rpartition(":")[2] or env_id in self.data_env_ids

    # ------------------------------------------------------------------ geometry

    def free_cells(self) -> tuple[Cell, ...]:
        """Every free (row, column) of the maze, row by row."""
        rows = self._maze()
        return tuple((i, j) for i, row in enumerate(rows) for j, value in enumerate(row) if value == "0")

    def cell_to_xy(self, cell: ArrayLike) -> NDArray[np.float64]:
        """Centre of a cell in the environment's coordinates, see `origin`.

        Args:
            cell: (..., 2) row and column.

        Returns:
            (..., 2) x and y in metres.
        """
        row0, column0, down = self._frame()
        cell = np.asarray(cell, dtype=np.float64)
        x = (cell[..., 1] - column0) * self.cell_size
        y = (cell[..., 0] - row0) * down * self.cell_size
        return np.stack([x, y], axis=-1)

    def xy_to_cell(self, xy: ArrayLike) -> NDArray[np.int64]:
        """The cell that holds a position; the inverse of `cell_to_xy`.

        Args:
            xy: (..., 2) x and y in metres.

        Returns:
            (..., 2) row and column; outside the maze the numbering continues.
        """
        row0, column0, down = self._frame()
        xy = np.asarray(xy, dtype=np.float64)
        i = np.floor(down * xy[..., 1] / self.cell_size + row0 + 0.5)
        j = np.floor(xy[..., 0] / self.cell_size + column0 + 0.5)
        return np.stack([i, j], axis=-1).astype(np.int64)

    def start_xy(self) -> NDArray[np.float64]:
        """Centre of the start cell, (2,)."""
        if self.start_cell is None:
            raise UserError(f"task '{self.name}' has no start cell: only mazes have one")
        return self.cell_to_xy(self.start_cell)

    def goal_xy(self) -> NDArray[np.float64]:
        """The goal, (2,): the goal cell's centre, or the mean of the goals that episodes draw around it."""
        if self.goal_cell is None:
            raise UserError(f"task '{self.name}' has no goal cell: only mazes have one")
        return self.cell_to_xy(self.goal_cell) + self.goal_noise

    def _frame(self) -> tuple[float, float, int]:
        """Row and column (with fractions) of the origin, and the sign of y down the map."""
        rows = self._maze()
        if self.origin == "centre":
            return (len(rows) - 1) / 2, (len(rows[0]) - 1) / 2, -1
        home = self.origin_cell or self.start_cell
        assert home is not None, "a frame at the start cell needs one"
        return float(home[0]), float(home[1]), 1

    def _maze(self) -> tuple[str, ...]:
        if self.maze_map is None:
            raise UserError(f"task '{self.name}' has no maze: cells are undefined there")
        return self.maze_map

    # ------------------------------------------------------------------ scores

    def normalised_score(self, returns: ArrayLike) -> NDArray[np.float64]:
        """D4RL's normalised score, 0 to 100: `100 * (return - score_min) / (score_max - score_min)`.

        Args:
            returns: Sums of the environment's rewards.
        """
        returns = np.asarray(returns, dtype=np.float64)
        return 100.0 * (returns - self.score_min) / (self.score_max - self.score_min)

    # ------------------------------------------------------------------ environments

    def make_env(self, render_mode: str | None = None) -> gym.Env[NDArray[np.float32], NDArray[np.float32]]:
        """The evaluation environment: flat float32 observations, this task's start and goal at every reset.

        In mazes the body starts in `start_cell` with the environment's noise, and reaching the goal ends the
        episode. The goal is exactly the centre of `goal_cell` unless the task has `goal_noise`. `info` holds `success`
        (bool) after every reset and step, in mazes `position` (2,), in the kitchen `subtasks_done` (int).

        Args:
            render_mode: Gymnasium's render mode, for example "rgb_array".
        """
        from dds_lightning.tasks.env import make_task_env  # gymnasium is slow to import

        return make_task_env(self, render_mode)
