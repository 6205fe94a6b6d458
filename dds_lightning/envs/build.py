"""The only place where environments are built, so that every process does it safely."""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import threading
import warnings
from importlib import import_module
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from dds_lightning.envs.mazes import D4RL_ANTMAZES, d4rl_antmaze_id

_BUILD_LOCK = threading.Lock()


def register_environments() -> None:
    """Register gymnasium-robotics' environments and ours with Gymnasium; slow the first time, so done late."""
    with _BUILD_LOCK, contextlib.redirect_stderr(io.StringIO()):  # it prints a notice on others
        import_module("dds_lightning.envs.physics")  # before Gymnasium imports MuJoCo, which would need graphics
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
        for size, maze in D4RL_ANTMAZES.items():
            if d4rl_antmaze_id(size) not in gym.registry:
                gym.register(
                    d4rl_antmaze_id(size),
                    entry_point="dds_lightning.envs.antmaze:D4RLAntMazeEnv",
                    max_episode_steps=maze.cap,
                    kwargs={
                        "maze_map": maze.maze_map,
                        "start_cell": maze.start_cell,
                        "goal_cell": maze.goal_cell,
                        "cell_size": maze.cell_size,
                        "goal_radius": maze.goal_radius,
                    },
                )


def find_modules_here() -> None:
    """Let imports find modules of the current folder, as `python -m` does."""
    if "" not in sys.path:
        sys.path.insert(0, "")


def build_env(env_id: str | EnvSpec, **kwargs: Any) -> gym.Env[Any, Any]:
    """`gymnasium.make` for any of our environments, safe to call from many processes at once.

    A maze writes its MuJoCo XML into the temporary directory, names it after the time of day and never deletes it. Two
    processes can choose the same name, and every environment leaves a file behind. Here each environment gets its own
    temporary directory, which is removed as soon as MuJoCo has read the file.

    Args:
        env_id: Gymnasium's name of the environment, or a specification created here.
        **kwargs: Passed on to `gymnasium.make`; None values are left out.
    """
    register_environments()
    if isinstance(env_id, str) and ":" in env_id:
        find_modules_here()
    kwargs = {key: value for key, value in kwargs.items() if value is not None}
    with _BUILD_LOCK, tempfile.TemporaryDirectory(prefix="dds-env-") as folder, warnings.catch_warnings():
        # The table names versions on purpose: a score belongs to the physics that its data come from.
        warnings.filterwarnings("ignore", message=".*is out of date.*")
        before, tempfile.tempdir = tempfile.tempdir, folder
        try:
            return gym.make(env_id, disable_env_checker=True, **kwargs)
        finally:
            tempfile.tempdir = before
