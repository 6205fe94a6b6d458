"""Wrappers that turn an environment into that of a task: flat observations, one start, one goal."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from dds_lightning.envs.build import build_env
from dds_lightning.envs.flatten import flatten
from dds_lightning.envs.interface import answer_of
from dds_lightning.envs.kitchen import goal_vector, kitchen_layout
from dds_lightning.errors import UserError
from dds_lightning.tasks.bodies import body_of

if TYPE_CHECKING:
    from dds_lightning.tasks import Task

Flat = NDArray[np.float32]


def make_task_env(task: Task, render_mode: str | None = None) -> gym.Env[Flat, Flat]:
    """Build what `Task.make_env` promises."""
    options = {"continuing_task": False} if task.adapter == "maze" else {}
    env = build_env(
        task.env_id,
        max_episode_steps=task.max_episode_steps,
        render_mode=render_mode,
        **options,
        **task.env_options,
    )
    return ADAPTERS[task.adapter](env, task)


@contextlib.contextmanager
def open_env(task: Task) -> Iterator[gym.Env[Flat, Flat]]:
    """Yield a task's environment after a reset; it is closed at the end."""
    env = make_task_env(task)
    try:
        env.reset(seed=0)
        yield env
    finally:
        env.close()


class TaskEnv(gym.Wrapper[Flat, Flat, Any, Any], gym.utils.RecordConstructorArgs):
    """An environment whose observations are one array or a dictionary of them, with or without `success` in `info`."""

    def __init__(self, env: gym.Env[Any, Any], task: Task) -> None:
        """Wrap `env`, which must come from `build_env`."""
        gym.utils.RecordConstructorArgs.__init__(self, task=task, _disable_deepcopy=True)  # `spec` makes it again
        self.task = task
        gym.Wrapper.__init__(self, env)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (task.observation_dim,), np.float32)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # an attribute of `Env`, a property of `Wrapper`
        """From which Gymnasium makes this environment again, also from JSON (`EnvSpec.from_json`)."""
        spec = super().spec
        if spec is not None:
            *others, own = spec.additional_wrappers
            spec.additional_wrappers = (*others, replace(own, entry_point="dds_lightning.tasks.again:wrapped"))
        return spec

    @property
    def unwrapped(self) -> gym.Env[Any, Any]:
        """The simulator's environment; this one where that takes goals, for this one does not.

        Whoever looks for `compute_reward` to recognise an environment with goals (stable-baselines3's HER) would
        expect a goal in the observations. All other attributes of the simulator's environment are read and set here.
        """
        inner = self.env.unwrapped
        return self if hasattr(inner, "compute_reward") else inner

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the simulator's environment, see `unwrapped`."""
        if name in ("compute_reward", "env") or name.startswith("__"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.env.unwrapped, name)

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, of the simulator's environment if that has it and this one does not."""
        inner = self.env.unwrapped if "env" in vars(self) else self
        own = name in vars(self) or hasattr(type(self), name) or not hasattr(inner, name)
        object.__setattr__(self if own else inner, name, value)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Flat, dict[str, Any]]:
        """Start an episode."""
        observation, info = answer_of(self.env, "reset", seed=seed, options=options)
        return self._outside(observation, info)

    def step(self, action: Flat) -> tuple[Flat, float, bool, bool, dict[str, Any]]:
        """Take one step in the environment."""
        observation, reward, terminated, truncated, info = answer_of(self.env, "step", action)
        flat, info = self._outside(observation, info)
        try:
            paid = float(reward)
        except (TypeError, ValueError):
            paid = math.nan
        if not math.isfinite(paid):
            raise UserError(
                f"{self._who()} pays a reward of {reward}, expected a finite number: no score has a meaning"
            )
        return flat, paid, bool(terminated), bool(truncated), info

    def _who(self) -> str:
        return f"the environment of {self.task.name} ({self.task.env_id})"

    def _outside(self, observation: Any, info: dict[str, Any]) -> tuple[Flat, dict[str, Any]]:
        """Return the observation for the agent and the `info` for the caller."""
        info["success"] = bool(info.get("success", info.get("is_success", False)))
        try:
            flat = np.asarray(self.flatten(observation), dtype=np.float32)
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{self._who()} gives an observation that is no array of numbers: {error}") from None
        if flat.shape != (self.task.observation_dim,):
            expected = f"expected {(self.task.observation_dim,)}, as its observation_space says"
            raise UserError(
                f"{self._who()} gives an observation of shape {flat.shape}, {expected}: mend step and reset"
            )
        if not np.isfinite(flat).all():
            column = int(np.argmin(np.isfinite(flat)))
            raise UserError(
                f"{self._who()} gives an observation with {flat[column]} in column {column}, expected finite numbers: "
                "end the episode before it gets there, or mend the simulation"
            )
        return flat, info

    def flatten(self, observation: Any) -> Any:
        """The task's flat observation, (O,)."""
        keys = self.task.observation_keys
        return flatten(observation, keys) if keys else observation


class MazeEnv(TaskEnv):
    """A maze of gymnasium-robotics: pins start and goal."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Flat, dict[str, Any]]:
        """Start an episode; `options` may override `reset_cell` and `goal_cell`."""
        task = self.task
        cells = {"reset_cell": task.start_cell, "goal_cell": task.goal_cell, **(options or {})}
        cells = {name: np.asarray(cell) for name, cell in cells.items()}
        observation, info = self.env.reset(seed=seed, options=cells)
        inner: Any = self.env.unwrapped
        # The environment moves the goal by up to a quarter of a cell; one task has one goal, so put it back.
        inner.goal = task.cell_to_xy(cells["goal_cell"])
        inner.update_target_site_pos()
        flat, info = self._outside(observation, info)
        info["success"] = bool(np.linalg.norm(info["position"] - inner.goal) <= task.goal_radius)
        return flat, info

    def _outside(self, observation: Any, info: dict[str, Any]) -> tuple[Flat, dict[str, Any]]:
        info["position"] = np.array(observation["achieved_goal"], dtype=np.float64)
        return super()._outside(observation, info)

    def flatten(self, observation: Any) -> Any:
        """The parts that the robot's row names: the ant's observation lacks its position."""
        parts = body_of(self.task).parts.items()
        return np.concatenate([observation[name][: part.columns] for name, part in parts])


class KitchenEnv(TaskEnv):
    """FrankaKitchen-v1 with D4RL's 60 numbers; `info["subtasks_done"]` counts what is done so far."""

    def _outside(self, observation: Any, info: dict[str, Any]) -> tuple[Flat, dict[str, Any]]:
        info["subtasks_done"] = len(info["episode_task_completions"])
        info["success"] = info["subtasks_done"] == len(self.task.subtasks)
        return super()._outside(observation, info)

    def flatten(self, observation: Any) -> Any:
        """Robot positions (9), object positions (21), goal (30)."""
        return np.concatenate([kitchen_layout(observation["observation"]), goal_vector(self.task.subtasks)], axis=-1)


ADAPTERS = {"flat": TaskEnv, "maze": MazeEnv, "kitchen": KitchenEnv}
"""`Task.adapter` -> its wrapper."""
