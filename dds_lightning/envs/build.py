"""Building environments: the only place that does, so that every process does it safely."""

from __future__ import annotations

import contextlib
import io
import tempfile
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

_BUILD_LOCK = threading.Lock()


class MazeTask(NamedTuple):
    """Where in a maze an episode starts and ends."""

    start_cell: tuple[int, int] | None
    goal_cell: tuple[int, int] | None
    goal_radius: float
    cell_to_xy: Callable[[Any], NDArray[np.float64]]


class TaskEnv(gym.Wrapper[NDArray[np.float32], NDArray[np.float32], Any, Any]):
    """Flattens observations and pins start and goal; see `Task.make_env`."""

    def __init__(self, env: gym.Env[Any, Any], observation_dim: int, maze: MazeTask | None = None) -> None:
        """Wrap `env`, which must come from `build_env`."""
        super().__init__(env)
        self.maze = maze
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (observation_dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; `options` may override `reset_cell` and `goal_cell`."""
        if self.maze is None:
            observation, info = self.env.reset(seed=seed, options=options)
            return self._outside(observation, info)
        cells = {"reset_cell": self.maze.start_cell, "goal_cell": self.maze.goal_cell, **(options or {})}
        observation, info = self.env.reset(seed=seed, options=cells)
        inner: Any = self.env.unwrapped
        # The environment moves the goal by up to a quarter of a cell; one task has one goal, so put it back.
        inner.goal = self.maze.cell_to_xy(cells["goal_cell"])
        inner.update_target_site_pos()
        flat, info = self._outside(observation, info)
        info["success"] = bool(np.linalg.norm(info["position"] - inner.goal) <= self.maze.goal_radius)
        return flat, info

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        flat, info = self._outside(observation, info)
        return flat, float(reward), bool(terminated), bool(truncated), info

    def _outside(self, observation: Any, info: dict[str, Any]) -> tuple[NDArray[np.float32], dict[str, Any]]:
        info["success"] = bool(info.get("success", False))
        if self.maze is not None:
            info["position"] = np.array(observation["achieved_goal"], dtype=np.float64)
            observation = observation["observation"]
        return np.asarray(observation, dtype=np.float32), info


def register_environments() -> None:
    """Make gymnasium-robotics' environments known to Gymnasium; slow the first time, so done late."""
    with _BUILD_LOCK, contextlib.redirect_stderr(io.StringIO()):  # it prints a notice on others
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)


def build_env(env_id: str | EnvSpec, **kwargs: Any) -> gym.Env[Any, Any]:
    """`gymnasium.make` for any of our environments, safe to call from many processes at once.

    A maze writes its MuJoCo XML into the temporary directory under the time of day and never deletes it. Two
    processes can meet on one name, and every environment leaves a file behind. Here each environment gets a
    temporary directory of its own, which goes as soon as MuJoCo has read the file.

    Args:
        env_id: Gymnasium's name of the environment, or a specification of our own making.
        **kwargs: Passed on to `gymnasium.make`; None values are left out.
    """
    register_environments()
    kwargs = {key: value for key, value in kwargs.items() if value is not None}
    with _BUILD_LOCK, tempfile.TemporaryDirectory(prefix="dds-env-") as own:
        before, tempfile.tempdir = tempfile.tempdir, own
        try:
            return gym.make(env_id, disable_env_checker=True, **kwargs)
        finally:
            tempfile.tempdir = before
