"""PointMaze data: a point mass in the real environment, driven by a planner and a noisy controller.

A shortest path over the maze's cells gives waypoints, a velocity controller drives to them, and a new goal is drawn
whenever one is reached. `diverse` tasks start and head anywhere, `play` tasks between hand-picked cells. Each episode
depends on (seed, its number) alone, so the arrays are the same for any number of workers.
"""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from datamodules.collect.behaviour import QUIET, Driver, PointMazeRecipe
from datamodules.collect.collecting import Collector, DataSetPlan
from datamodules.collect.recording import Episode
from dds_lightning.envs.build import build_env, register_environments
from dds_lightning.tasks import Task, get_task


def _plan(task: Task, seed: int, steps: int, recipe: PointMazeRecipe) -> DataSetPlan:
    recorder = _Recorder(task, seed, steps, recipe)
    env = recorder.env()
    return DataSetPlan(
        recorder,
        env,
        algorithm="shortest path over cells, velocity controller, random bursts",
        description=_description(task, seed, recipe),
        env_spec=collection_spec(task, recipe.episode_steps),
        evaluation=evaluation_spec(task),
        packages=("gymnasium-robotics", "mujoco"),
        chunk=4,
    )


def collection_spec(task: Task, episode_steps: int) -> EnvSpec:
    """The environment that data are recorded in: goals change when reached, and only the time limit ends episodes."""
    options: dict[str, Any] = {"continuing_task": True, "reset_target": True}
    if task.data_start_cells or task.data_goal_cells:
        starts = set(task.data_start_cells or task.free_cells())
        options["maze_map"] = _lettered(task, starts, set(task.data_goal_cells or task.free_cells()))
    return _spec(task, episode_steps, options)


def evaluation_spec(task: Task) -> EnvSpec:
    """The task's evaluation as far as Gymnasium can express it: the goal keeps the environment's noise."""
    assert task.start_cell is not None
    assert task.goal_cell is not None
    options = {"continuing_task": False, "maze_map": _lettered(task, {task.start_cell}, {task.goal_cell})}
    return _spec(task, task.max_episode_steps, options)


def _lettered(task: Task, starts: set[tuple[int, int]], goals: set[tuple[int, int]]) -> list[list[int | str]]:
    """The maze in the environment's notation: r starts, g goals, c both."""
    rows: list[list[int | str]] = [[int(value) for value in row] for row in task._maze()]
    for cell in starts | goals:
        rows[cell[0]][cell[1]] = "c" if cell in starts and cell in goals else "r" if cell in starts else "g"
    return rows


def _spec(task: Task, cap: int, options: dict[str, Any]) -> EnvSpec:
    register_environments()
    spec = copy.deepcopy(gym.spec(task.env_id))
    spec.kwargs.update(options)
    spec.max_episode_steps = cap
    return spec


class _Recorder:
    """Records round i of a data set, one episode, which depends on (seed, i) alone."""

    def __init__(self, task: Task, seed: int, steps: int, recipe: PointMazeRecipe) -> None:
        self.task, self.seed, self.steps, self.recipe = task, seed, steps, recipe
        self.driver = Driver(task, speed=recipe.speed)
        self.rounds = -(-steps // recipe.episode_steps)
        self._env: gym.Env[Any, Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_env": None}  # each process makes its own

    def env(self) -> gym.Env[Any, Any]:
        if self._env is None:
            self._env = build_env(collection_spec(self.task, self.recipe.episode_steps))
        return self._env

    def __call__(self, number: int) -> list[Episode]:
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        each = self.recipe.episode_steps
        length = min(each, self.steps - number * each)
        env, driver = self.env(), self.driver
        maze: Any = env.unwrapped
        env.reset(seed=int(rng.integers(2**31)))
        start = self._anywhere_in_cell(maze, rng)
        driver.start_episode(rng, length, self.recipe)

        observations = np.empty((length + 1, 4))
        goals = np.empty((length + 1, 2))
        actions = np.empty((length, 2), np.float32)
        rewards = np.empty(length)
        terminations, truncations = np.zeros(length, bool), np.zeros(length, bool)
        success = np.empty(length + 1, bool)
        observations[0], goals[0] = start, maze.goal
        success[0] = np.linalg.norm(start[:2] - maze.goal) <= self.task.goal_radius
        x, y, vx, vy = start.tolist()
        goal = tuple(goals[0].tolist())
        for t in range(length):
            actions[t] = driver.act(x, y, vx, vy, goal)
            seen, rewards[t], terminations[t], truncations[t], info = env.step(actions[t])
            observations[t + 1], goals[t + 1], success[t + 1] = (
                seen["observation"], seen["desired_goal"], info["success"]
            )  # fmt: skip
            x, y, vx, vy = observations[t + 1].tolist()
            if rewards[t] > 0:
                goal = tuple(maze.goal.tolist())  # the environment has drawn a new one
        truncations[-1] = True  # the time limit, or the end of the data set
        episode = {
            "observations": {
                "observation": observations, "achieved_goal": observations[:, :2], "desired_goal": goals
            },
            "actions": actions,
            "rewards": rewards,
            "terminations": terminations,
            "truncations": truncations,
            "infos": {"success": success},
        }  # fmt: skip
        return [episode]

    def _anywhere_in_cell(self, maze: Any, rng: np.random.Generator) -> NDArray[np.float64]:
        """Move the body from where the environment placed it to anywhere in that cell, at rest."""
        cell = self.task.xy_to_cell(maze.reset_pos)
        offset = rng.uniform(-self.recipe.start_offset, self.recipe.start_offset, 2) * self.task.cell_size
        xy = self.task.cell_to_xy(cell) + offset
        maze.point_env.set_state(xy, np.zeros(2))
        return np.concatenate([xy, np.zeros(2)])


def _description(task: Task, seed: int, recipe: PointMazeRecipe) -> str:
    where = "between hand-picked cells" if task.data_goal_cells else "from anywhere to anywhere"
    return (
        f"A point mass travels {where} in {task.env_id}; a new goal follows each one reached. A planner over "
        f"the maze's cells gives waypoints (up to {recipe.waypoint_offset} cells off centre), a velocity "
        f"controller drives at {recipe.speed} m/s with action noise {recipe.action_noise}; bursts of random action "
        f"last {recipe.burst_steps[0]} to {recipe.burst_steps[1]} steps. Episodes start at rest. Seed {seed}."
    )


class WaypointController:
    """The behaviour as an actor: drives every environment of a batch to the task's goal."""

    def __init__(self, task: Task | str, recipe: PointMazeRecipe | None = None, *, speed: float | None = None) -> None:
        """Prepare for `task`.

        Args:
            task: A PointMaze task or its name.
            recipe: How far to stray; None is the behaviour at its best, `PointMazeRecipe()` as in the data.
            speed: Cruising speed in metres a second; None takes the recipe's.
        """
        self.task, self.recipe = get_task(task), recipe or QUIET
        self.speed = self.recipe.speed if speed is None else speed
        self.reset()

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Prepare for new episodes in `num_envs` environments; `seed` fixes the noise."""
        self._rng = np.random.default_rng(seed)
        self._drivers = [Driver(self.task, speed=self.speed) for _ in range(num_envs)]
        for driver in self._drivers:
            self._restart(driver)

    def _restart(self, driver: Driver) -> None:
        driver.start_episode(self._rng, self.task.max_episode_steps, self.recipe)

    def act(
        self,
        observations: NDArray[np.float32],
        restarted: NDArray[np.bool_] | None = None,
        rows: NDArray[np.intp] | None = None,
    ) -> NDArray[np.float32]:
        """As `Actor.act`.

        Args:
            observations: (n, 4) positions and velocities.
            restarted: (n,) True where an episode has just begun; None means nowhere.
            rows: (n,) their environments; None means all of them.

        Returns:
            (n, 2) forces in the box.
        """
        goal_x, goal_y = self.task.goal_xy().tolist()
        drivers = [self._drivers[row] for row in (range(len(self._drivers)) if rows is None else rows)]
        actions = np.empty((len(drivers), 2), np.float32)
        for i, (driver, (x, y, vx, vy)) in enumerate(zip(drivers, observations.tolist(), strict=True)):
            if restarted is not None and restarted[i]:
                self._restart(driver)
            actions[i] = driver.act(x, y, vx, vy, (goal_x, goal_y))
        return actions


COLLECTOR = Collector("pointmaze", None, 200_000, PointMazeRecipe, _plan, WaypointController)
collect_pointmaze = COLLECTOR.collect
