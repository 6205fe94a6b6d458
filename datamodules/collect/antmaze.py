"""AntMaze data by D4RL's recipe: a planner over cells, a trained Ant that walks in a given direction, and noise.

Episodes of 1,000 steps: the ant walks to a goal, and once there to a new one. `diverse` tasks start and head anywhere,
`play` tasks start anywhere and head for hand-picked cells, `antmaze-umaze` always goes from the start to the goal.
Rewards are those of the evaluation goal: 1 where a step leads to within `Task.goal_radius` of it. In D4RL's physics it
is drawn anew for every episode, as the evaluation draws it; in gymnasium-robotics' it stands still.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from datamodules.behaviours.ant import SHIPPED, AntController
from datamodules.collect.collecting import Collector, DataSetPlan
from datamodules.collect.recording import Episode
from datamodules.collect.waypoints import Waypoints
from dds_lightning.envs.build import build_env
from dds_lightning.errors import UserError
from dds_lightning.saving.files import sha256
from dds_lightning.tasks import Cell, Task, get_task
from dds_lightning.tasks.env import ADAPTERS

BODIES = 16
"""Ants that walk side by side in one process; the data depend on it, as on the seed."""
FLIPPED_STEPS = 25
"""An ant that has lain on its back this long will not get up (rolling over a leg takes a few steps)."""


@dataclass(frozen=True)
class AntMazeRecipe:
    """How the data are made; the defaults are D4RL's (`generate_ant_maze_datasets.py`).

    Attributes:
        action_noise: Standard deviation of the Gaussian noise on every action entry.
        waypoint_noise: Waypoints lie up to this many metres beyond a cell's centre on both axes, always to one side.
        episode_steps: Steps after which an episode is truncated.
        end_when_flipped: End an episode (truncation) when the ant has lain on its back for `FLIPPED_STEPS`;
            D4RL's episodes run on.
    """

    action_noise: float = 0.2
    waypoint_noise: float = 1.0
    episode_steps: int = 1000
    end_when_flipped: bool = False

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if not 0.0 <= self.action_noise < math.inf:
            raise UserError(f"action_noise: got {self.action_noise}, expected a number of at least 0")
        if not 0.0 <= self.waypoint_noise <= 1.5:
            raise UserError(f"waypoint_noise: got {self.waypoint_noise}, expected 0 to 1.5 metres")
        if self.episode_steps < 1:
            raise UserError(f"episode_steps: got {self.episode_steps}, expected at least 1")


def _plan(task: Task, seed: int, steps: int, recipe: AntMazeRecipe) -> DataSetPlan:
    recorder = _Recorder(task, seed, steps, recipe)
    return DataSetPlan(
        recorder,
        recorder.env(),
        algorithm="shortest path over cells, heading-conditioned Ant controller",
        description=_description(task, seed, recipe),
        settings={"controller": sha256(SHIPPED / "ant" / f"{task.physics}.safetensors")},
    )


class _Recorder:
    """Records round i of a data set: bodies walk side by side, so that the controller acts in one batch.

    A round depends on (seed, i) alone.
    """

    def __init__(self, task: Task, seed: int, steps: int, recipe: AntMazeRecipe) -> None:
        self.task, self.seed, self.steps, self.recipe = task, seed, steps, recipe
        self.rounds = -(-steps // (BODIES * recipe.episode_steps))
        self.controller = AntController(task.physics)
        self._envs: list[gym.Env[Any, Any]] = []

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_envs": []}  # each process makes its own

    def env(self, body: int = 0) -> gym.Env[Any, Any]:
        while len(self._envs) <= body:
            ends = {"continuing_task": True} if self.task.adapter == "maze" else {}
            self._envs.append(build_env(self.task.env_id, max_episode_steps=self.recipe.episode_steps, **ends))
        return self._envs[body]

    def __call__(self, number: int) -> list[Episode]:
        each = self.recipe.episode_steps
        left = self.steps - number * BODIES * each
        walks = []
        for body in range(min(BODIES, -(-left // each))):
            rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number, body)))
            ant = _Ant(self.task, self.env(body))
            walks.append(_Walk(self.task, self.recipe, ant, rng, min(each, left - body * each)))
        while walking := [walk for walk in walks if walk.left]:
            states = np.stack([walk.state for walk in walking])
            headings = np.array([walk.heading() for walk in walking])
            for walk, action in zip(walking, self.controller.act(states, headings), strict=True):
                walk.step(action)
        return [episode for walk in walks for episode in walk.episodes]


class _Ant:
    """The body in a maze of either physics: D4RL's environment is its simulator, gymnasium-robotics' has one inside."""

    def __init__(self, task: Task, env: gym.Env[Any, Any]) -> None:
        self.task = task
        self.env: Any = ADAPTERS[task.adapter](env, task)  # which starts an episode as the evaluation does
        maze: Any = env.unwrapped
        self.simulator = getattr(maze, "ant_env", maze)
        self.nested = self.simulator is not maze

    def reset(self, seed: int) -> NDArray[np.float64]:
        """Stand at the task's start; return the goal by which an evaluation would reward, (2,)."""
        self.env.reset(seed=seed)
        return np.array(self.env.goal)

    def move_to(self, cell: Cell) -> NDArray[np.float64]:
        """Move from the start cell to another, keeping the noise of the reset; return the state."""
        data = self.simulator.data
        qpos = data.qpos.copy()
        qpos[:2] += self.task.cell_to_xy(cell) - self.task.start_xy()
        self.simulator.set_state(qpos, data.qvel.copy())
        return self.state()

    def step(self, action: NDArray[np.float32]) -> NDArray[np.float64]:
        """Act; return the state."""
        self.simulator.step(action)
        return self.state()

    def state(self) -> NDArray[np.float64]:
        """What the task observes, (29,)."""
        data = self.simulator.data
        return np.concatenate([data.qpos[:15], data.qvel[:14]])

    def observed(self, states: NDArray[np.float64], goals: NDArray[np.float64]) -> Any:
        """States (T + 1, 29) with the rewarded goals (T + 1, 2) as the environment's own observations."""
        if not self.nested:
            return states
        return {"observation": states[:, 2:], "achieved_goal": states[:, :2], "desired_goal": goals}


class _Walk:
    """One body that walks a number of steps, in one episode, or in more where some end early."""

    def __init__(self, task: Task, recipe: AntMazeRecipe, ant: _Ant, rng: np.random.Generator, steps: int) -> None:
        self.task, self.recipe, self.ant, self.rng, self.left = task, recipe, ant, rng, steps
        self.waypoints = Waypoints(task)
        # With a single goal there is no next one: the episode ends there, as in D4RL's `antmaze-umaze`.
        self.ends_at_goal = len(task.data_goal_cells or ()) == 1
        self.episodes: list[Episode] = []
        self._begin()

    def _begin(self) -> None:
        """Start an episode that may take all of the remaining steps."""
        task, recipe, length = self.task, self.recipe, self.left
        self.evaluation_goal = self.ant.reset(int(self.rng.integers(2**31)))
        self.state = self.ant.move_to(_draw(self.rng, task.data_start_cells or task.free_cells()))
        self.noise = recipe.action_noise * self.rng.standard_normal((length, task.action_dim))
        self.offsets = (self.rng.uniform(0.0, 1.0, (length, 2)) * recipe.waypoint_noise).tolist()
        self.observations = np.empty((length + 1, task.observation_dim))
        self.actions = np.empty((length, task.action_dim), np.float32)
        self.goals = np.empty((length + 1, 2), np.float32)
        self.t = self.on_back = 0
        self.waypoints.forget()
        self.goal = self._new_goal()
        self.observations[0], self.goals[0] = self.state, self.goal

    def heading(self) -> float:
        """Direction to walk in now, in radians."""
        x, y = float(self.state[0]), float(self.state[1])
        offset = self.offsets[self.t]
        target_x, target_y = self.waypoints.target(x, y, self.goal, (offset[0], offset[1]))
        return math.atan2(target_y - y, target_x - x)

    def step(self, action: NDArray[np.float64]) -> None:
        """Act once, with noise; begin the next episode where this one ends."""
        self.actions[self.t] = np.clip(action + self.noise[self.t], -1.0, 1.0)
        self.state = self.ant.step(self.actions[self.t])
        self.t, self.left = self.t + 1, self.left - 1
        there = math.hypot(self.state[0] - self.goal[0], self.state[1] - self.goal[1]) <= self.task.goal_radius
        if there and not self.ends_at_goal:
            self.goal = self._new_goal()
        self.observations[self.t], self.goals[self.t] = self.state, self.goal
        # The body's z axis in the world, from the quaternion (w, x, y, z).
        upright = 1.0 - 2.0 * (self.state[4] ** 2 + self.state[5] ** 2) > 0.0
        self.on_back = 0 if upright else self.on_back + 1
        fallen = self.recipe.end_when_flipped and self.on_back >= FLIPPED_STEPS
        if (there and self.ends_at_goal) or fallen or not self.left:
            self.episodes.append(self._episode())
            if self.left:
                self._begin()

    def _episode(self) -> Episode:
        length = self.t
        observations = self.observations[: length + 1].copy()
        near = np.linalg.norm(observations[1:, :2] - self.evaluation_goal, axis=1) <= self.task.goal_radius
        rewarded = np.tile(self.evaluation_goal, (length + 1, 1))
        return {
            "observations": self.ant.observed(observations, rewarded),
            "actions": self.actions[:length].copy(),
            "rewards": near.astype(np.float32),
            "terminations": np.zeros(length, bool),
            "truncations": np.arange(length) == length - 1,
            "infos": {
                "goal": self.goals[: length + 1].copy(),
                "evaluation_goal": rewarded,
            },
        }

    def _new_goal(self) -> tuple[float, float]:
        """A goal in a cell other than the body's, with the environment's noise."""
        here = tuple(self.task.xy_to_cell(self.state[:2]).tolist())
        cells = self.task.data_goal_cells or self.task.free_cells()
        elsewhere = [cell for cell in cells if self.ends_at_goal or cell != here]
        return _goal_near(self.task, _draw(self.rng, elsewhere), self.rng)


def _goal_near(task: Task, cell: Cell, rng: np.random.Generator) -> tuple[float, float]:
    """A goal in a cell, where the environment would draw it."""
    quarter = 0.25 * task.cell_size
    d4rl = task.physics == "d4rl"
    noise = rng.uniform(0.0, 1.0, 2) + rng.uniform(0.0, 0.5, 2) if d4rl else rng.uniform(-quarter, quarter, 2)
    x, y = (task.cell_to_xy(cell) + noise).tolist()
    return x, y


def _draw(rng: np.random.Generator, cells: Any) -> Cell:
    return cells[int(rng.integers(len(cells)))]


def _description(task: Task, seed: int, recipe: AntMazeRecipe) -> str:
    return (
        f"An ant walks through {task.env_id}; a new goal follows each one reached. A planner over "
        f"the maze's cells gives waypoints (up to {recipe.waypoint_noise} m beyond a cell's centre), a trained "
        f"controller walks towards them with action noise {recipe.action_noise}. Rewards are those of the evaluation "
        f"goal{', drawn once an episode' if task.goal_noise else ''}. Seed {seed}."
    )


class AntNavigator:
    """The behaviour as an actor: walks every ant of a batch to the task's goal cell, and around in it."""

    def __init__(self, task: Task | str, recipe: AntMazeRecipe | None = None) -> None:
        """Prepare for `task`; without a recipe the controller is at its best, without noise on actions."""
        self.task = get_task(task)
        self.recipe = recipe or AntMazeRecipe(action_noise=0.0)
        self.controller = AntController(self.task.physics)
        self.reset()

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Prepare for new episodes in `num_envs` environments; `seed` fixes the noise."""
        self._rng = np.random.default_rng(seed)
        # Goals are drawn whenever one is reached: a stream for each environment keeps the others' draws in place.
        self._goal_rngs = self._rng.spawn(num_envs)
        self._ways = [Waypoints(self.task) for _ in range(num_envs)]
        self._goals = [self._goal(rng) for rng in self._goal_rngs]

    def _goal(self, rng: np.random.Generator) -> tuple[float, float]:
        """A position among the evaluation's goals, of which an actor does not observe which one it is."""
        assert self.task.goal_cell is not None
        if not self.task.goal_noise:
            x, y = self.task.goal_xy().tolist()
            return x, y
        return _goal_near(self.task, self.task.goal_cell, rng)

    def act(
        self,
        observations: NDArray[np.float32],
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float32]:
        """As `Actor.act`.

        Args:
            observations: (n, 29).
            restarted: (n,) True where an episode has just begun; None means nowhere.
            rows: (n,) their environments; None means all of them.

        Returns:
            (n, 8) in the box.
        """
        every = len(self._ways)
        rows = np.arange(every) if rows is None else rows
        headings = np.empty(len(rows))
        offsets = self._rng.uniform(0.0, 1.0, (every, 2))[rows] * self.recipe.waypoint_noise
        for i, (row, (x, y)) in enumerate(zip(rows.tolist(), observations[:, :2].tolist(), strict=True)):
            if restarted is not None and restarted[i]:
                self._ways[row].forget()
            if math.hypot(x - self._goals[row][0], y - self._goals[row][1]) <= self.task.goal_radius:
                self._goals[row] = self._goal(self._goal_rngs[row])
            offset_x, offset_y = offsets[i].tolist()
            target_x, target_y = self._ways[row].target(x, y, self._goals[row], (offset_x, offset_y))
            headings[i] = math.atan2(target_y - y, target_x - x)
        actions = self.controller.act(observations, headings)
        noise = self.recipe.action_noise * self._rng.standard_normal((every, actions.shape[1]))[rows]
        return np.clip(actions + noise, -1.0, 1.0).astype(np.float32)


COLLECTOR = Collector("antmaze", ("d4rl", "robotics"), 1_000_000, AntMazeRecipe, _plan, AntNavigator)
collect_antmaze = COLLECTOR.collect
