"""PointMaze data made on the spot: the real environment, a planner, a noisy controller, all cores."""

from __future__ import annotations

import copy
from importlib import metadata as installed
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from datamodules.collect.behaviour import QUIET, BehaviourNoise, Driver
from datamodules.collect.minari_writer import write_minari
from datamodules.collect.recording import Episode, Kept, record
from datamodules.storage import refuse_existing
from dds_lightning.envs.build import build_env, register_environments
from dds_lightning.errors import UserError
from dds_lightning.tasks import Task, get_task


def collect_pointmaze(
    task: Task | str,
    steps: int = 200_000,
    seed: int = 0,
    out: str | Path = "data",
    workers: int | None = None,
    *,
    episode_steps: int = 500,
    speed: float = 4.5,
    waypoint_offset: float = 0.35,
    action_noise: float = 0.2,
    burst_probability: float = 0.008,
    burst_steps: tuple[int, int] = (10, 50),
    rest_share: float = 0.4,
    start_offset: float = 0.38,
    dataset_id: str | None = None,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Collect a PointMaze data set and write it as a Minari data set.

    A shortest path over the maze's cells gives waypoints, a velocity controller drives to them, and a new
    goal is drawn whenever one is reached. `diverse` tasks start and head anywhere, `play` tasks between
    hand-picked cells. Each episode is a function of (seed, its number), so the arrays are the same for any
    number of workers. An interrupted call goes on where it stopped when it is made again.

    Args:
        task: A PointMaze task or its name.
        steps: Environment steps in all.
        seed: Same seed, same bytes of every array, whatever the workers and interruptions.
        out: Folder of data sets; the set becomes `out/<dataset_id>`, where MINARI_DATASETS_PATH=out finds it.
        workers: Processes; None takes every core, 1 stays in this process.
        episode_steps: Steps after which an episode is truncated (the last one may be shorter).
        speed: Cruising speed in metres a second; the environment stops at 5 on each axis.
        waypoint_offset: Waypoints lie up to this many cells from a cell's centre, on both axes.
        action_noise: Standard deviation of the Gaussian noise on actions.
        burst_probability: Chance a step that a burst of random action starts.
        burst_steps: Shortest and longest burst.
        rest_share: Share of the bursts in which the body brakes and stays at rest.
        start_offset: Episodes start at rest up to this many cells from a cell's centre.
        dataset_id: Name of the set; None takes the task's own, for example "pointmaze-large-diverse-v0".
        overwrite: Replace a set of the same name.
        progress: Show a progress bar on standard error.

    Returns:
        The data set's folder; `load_trajectories(f"local:{folder}", task)` reads it.

    Raises:
        UserError: For a task that is no PointMaze, a number out of range, or a folder that exists.
    """
    task = get_task(task) if isinstance(task, str) else task
    if task.family != "pointmaze":
        raise UserError(f"task: '{task.name}' is no PointMaze task, and this collector drives only those")
    for name, value in (("steps", steps), ("episode_steps", episode_steps)):
        if value < 1:
            raise UserError(f"{name}: found {value}, expected at least 1")
    if seed < 0:
        raise UserError(f"seed: found {seed}, expected at least 0")
    if not 0 < speed <= 5:
        raise UserError(f"speed: found {speed}, expected more than 0 and at most 5 metres a second")
    noise = BehaviourNoise(
        waypoint_offset=waypoint_offset,
        action_noise=action_noise,
        burst_probability=burst_probability,
        burst_steps=(burst_steps[0], burst_steps[1]),
        rest_share=rest_share,
        start_offset=start_offset,
    )
    name = dataset_id or task.data_ids["local"]
    refuse_existing(Path(out) / name, overwrite)

    recorder = _Recorder(task, seed, steps, episode_steps, speed, noise)
    drive = {"episode_steps": episode_steps, "speed": speed, **vars(noise)}
    collection = {"task": task.name, "seed": seed, "steps": steps, **drive}
    kept = Kept(Path(out) / name, collection)
    episodes = record(recorder, workers, kept=kept, title=f"collecting {name}" if progress else None)
    env = recorder.env()
    folder = write_minari(
        out,
        name,
        episodes,
        env_spec=collection_spec(task, episode_steps),
        observation_space=env.observation_space,
        action_space=env.action_space,
        overwrite=overwrite,
        metadata={
            "author": ["dds-lightning"],
            "algorithm_name": "shortest path over cells, velocity controller, random bursts",
            "description": _description(task, seed, speed, noise),
            "eval_env_spec": evaluation_spec(task).to_json(),
            "requirements": [f"{p}=={installed.version(p)}" for p in ("gymnasium-robotics", "mujoco")],
            "collection": collection,
        },
    )
    kept.remove()
    return folder


def collection_spec(task: Task, episode_steps: int) -> EnvSpec:
    """The environment that data are recorded in: goals change when reached, only the clock ends episodes."""
    options: dict[str, Any] = {"continuing_task": True, "reset_target": True}
    if task.data_start_cells or task.data_goal_cells:
        starts = set(task.data_start_cells or task.free_cells())
        options["maze_map"] = _lettered(task, starts, set(task.data_goal_cells or task.free_cells()))
    return _spec(task, episode_steps, options)


def evaluation_spec(task: Task) -> EnvSpec:
    """The task's evaluation as far as Gymnasium can spell it: the goal keeps the environment's own noise."""
    assert task.start_cell is not None
    assert task.goal_cell is not None
    options = {"continuing_task": False, "maze_map": _lettered(task, {task.start_cell}, {task.goal_cell})}
    return _spec(task, task.max_episode_steps, options)


def _lettered(task: Task, starts: set[tuple[int, int]], goals: set[tuple[int, int]]) -> list[list[int | str]]:
    """The maze in the environment's own notation: r starts, g goals, c both."""
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
    """Records round i of a data set, one episode; everything about it follows from (seed, i)."""

    def __init__(
        self, task: Task, seed: int, steps: int, episode_steps: int, speed: float, noise: BehaviourNoise
    ) -> None:
        self.task, self.seed, self.steps, self.episode_steps = task, seed, steps, episode_steps
        self.noise, self.driver = noise, Driver(task, speed=speed)
        self.rounds = -(-steps // episode_steps)
        self._env: gym.Env[Any, Any] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_env": None}  # each process makes its own

    def env(self) -> gym.Env[Any, Any]:
        if self._env is None:
            self._env = build_env(collection_spec(self.task, self.episode_steps))
        return self._env

    def __call__(self, number: int) -> list[Episode]:
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        length = min(self.episode_steps, self.steps - number * self.episode_steps)
        env, driver = self.env(), self.driver
        maze: Any = env.unwrapped
        env.reset(seed=int(rng.integers(2**31)))
        start = self._anywhere_in_cell(maze, rng)
        driver.start_episode(rng, length, self.noise)

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
        truncations[-1] = True  # the clock, or the end of the data set
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
        """Move the body from where the environment put it to anywhere in that cell, at rest."""
        cell = self.task.xy_to_cell(maze.reset_pos)
        offset = rng.uniform(-self.noise.start_offset, self.noise.start_offset, 2) * self.task.cell_size
        xy = self.task.cell_to_xy(cell) + offset
        maze.point_env.set_state(xy, np.zeros(2))
        return np.concatenate([xy, np.zeros(2)])


def _description(task: Task, seed: int, speed: float, noise: BehaviourNoise) -> str:
    where = "between hand-picked cells" if task.data_goal_cells else "from anywhere to anywhere"
    return (
        f"A point mass travels {where} in {task.env_id}; a new goal follows each one reached. A planner over "
        f"the maze's cells gives waypoints (up to {noise.waypoint_offset} cells off centre), a velocity "
        f"controller drives at {speed} m/s with action noise {noise.action_noise}; bursts of random action "
        f"last {noise.burst_steps[0]} to {noise.burst_steps[1]} steps. Episodes start at rest. Seed {seed}."
    )


class WaypointController:
    """The behaviour as an actor: drives every environment of a batch to the task's goal.

    `codes` is None: this actor chooses no skills.
    """

    def __init__(self, task: Task | str, noise: BehaviourNoise | None = None, *, speed: float = 4.5) -> None:
        """Prepare for `task`.

        Args:
            task: A PointMaze task or its name.
            noise: How far to stray; None is the behaviour at its best, `BehaviourNoise()` as in the data.
            speed: Cruising speed in metres a second.
        """
        self.task = get_task(task) if isinstance(task, str) else task
        self.noise, self.speed = noise or QUIET, speed
        self.codes: NDArray[np.int64] | None = None
        self.reset()

    def reset(self, num_envs: int = 1, seed: int | None = None) -> None:
        """Forget everything and prepare for `num_envs` environments; `seed` fixes the noise."""
        self._rng = np.random.default_rng(seed)
        self._drivers = [Driver(self.task, speed=self.speed) for _ in range(num_envs)]
        for driver in self._drivers:
            self._restart(driver)

    def _restart(self, driver: Driver) -> None:
        driver.start_episode(self._rng, self.task.max_episode_steps, self.noise)

    def act(self, observations: NDArray[np.float32], restarted: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Actions for a batch.

        Args:
            observations: (E, 4) positions and velocities.
            restarted: (E,) True where an episode has just begun.

        Returns:
            (E, 2) forces in the box.
        """
        goal_x, goal_y = self.task.goal_xy().tolist()
        actions = np.empty((len(self._drivers), 2), np.float32)
        for e, (driver, row) in enumerate(zip(self._drivers, observations.tolist(), strict=True)):
            if restarted is not None and restarted[e]:
                self._restart(driver)
            actions[e] = driver.act(row[0], row[1], row[2], row[3], (goal_x, goal_y))
        return actions
